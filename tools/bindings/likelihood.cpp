// The likelihood of likelihood.hpp as Python sees it.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <cstddef>
#include <stdexcept>
#include <type_traits>
#include <vector>

#include "likelihood.hpp"

namespace nb = nanobind;
using namespace likelihood;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Cube = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;

// The part that has models of d states: `of` gets its fewest and most (CMakeLists.txt).
template <class Of> void part(std::size_t d, const Of &of) {
    if (d <= 6)
        of(std::integral_constant<int, 1>(), std::integral_constant<int, 6>());
    else if (d <= 14)
        of(std::integral_constant<int, 7>(), std::integral_constant<int, 14>());
    else
        of(std::integral_constant<int, 15>(), std::integral_constant<int, states_max>());
}

double *fresh(std::size_t size) {
    return new double[size > 0 ? size : 1];
}

Out array(double *data, std::vector<std::size_t> shape) {
    nb::capsule owner(data, [](void *p) noexcept { delete[] static_cast<double *>(p); });
    return {data, shape.size(), shape.data(), owner};
}

// Whether F is diagonal. Throws where sizes or the form of F do not fit.
bool check(const Vector &y, const Matrix &z, const Vector &r, const Matrix &F, const Matrix &Q, const Vector &h,
           const Matrix &P0, int driver) {
    const std::size_t n = y.shape(0), d = h.shape(0), p = z.shape(0);
    if (d < 1 || d > states_max || p + 1 > columns_max)
        throw std::invalid_argument("1 to 24 states and at most 39 columns");
    if (z.shape(1) != n || r.shape(0) != n || F.shape(0) != d || F.shape(1) != d || Q.shape(0) != d ||
        Q.shape(1) != d || P0.shape(0) != d || P0.shape(1) != d)
        throw std::invalid_argument("shapes do not fit");
    if (driver < -1 || driver >= static_cast<int>(d))
        throw std::invalid_argument("driver must be a state, or -1");
    bool diagonal = true;
    for (std::size_t a = 0; a < d; a++)
        for (std::size_t b = 0; b < d; b++)
            if (a != b && F.data()[a * d + b] != 0.0) {
                diagonal = false;
                if ((a + d) / 2 != (b + d) / 2) // pairs counted from the end
                    throw std::invalid_argument("F must be diagonal, with blocks of two states at its end");
            }
    return diagonal;
}

nb::tuple run(const Vector &y, const Matrix &z, const Vector &r, const Matrix &F, const Matrix &Q, const Vector &h,
              const Matrix &P0, double R, double lost, int driver, const std::vector<std::size_t> &marks,
              bool innovations) {
    const bool diagonal = check(y, z, r, F, Q, h, P0, driver);
    const std::size_t n = y.shape(0), d = h.shape(0), p = z.shape(0);
    for (std::size_t k = 0; k < marks.size(); k++)
        if (marks[k] > n || (k > 0 && marks[k] < marks[k - 1]))
            throw std::invalid_argument("marks must rise, up to the length of y");
    const int c = static_cast<int>(p) + 1;
    const std::size_t m = marks.size();
    Sums out{fresh(m * c * c),
             fresh(m),
             fresh(m),
             fresh(m * c * d),
             innovations ? fresh(n * c) : nullptr,
             innovations ? fresh(n) : nullptr};
    Out G = array(out.G, {m, std::size_t(c), std::size_t(c)}), D = array(out.D, {m}), counted = array(out.counted, {m});
    Out x = array(out.x, {m, std::size_t(c), d});
    Out white = array(innovations ? out.white : fresh(0), {innovations ? n : 0, std::size_t(c)});
    Out s = array(innovations ? out.s : fresh(0), {innovations ? n : 0});
    const Matrices model{F.data(), Q.data(), h.data(), P0.data(), &R, &lost};
    const Input in{y.data(), z.data(), r.data(), n, c, model, {}, d, 0, driver, marks.data(), m};
    {
        nb::gil_scoped_release released;
        part(d, [&](auto first, auto last) { filtered<first, last>(diagonal, in, out); });
    }
    return nb::make_tuple(G, D, counted, x, white, s);
}

nb::tuple shifts(const Vector &y, const Matrix &z, const Vector &r, const Matrix &F, const Matrix &Q, const Vector &h,
                 const Matrix &P0, double R, double lost, int driver) {
    check(y, z, r, F, Q, h, P0, driver);
    const std::size_t n = y.shape(0), d = h.shape(0), c = z.shape(0) + 1;
    std::vector<double> D(1), counted(1), x(c * d), white(n * c);
    const std::size_t end = n;
    Out G = array(fresh(c * c), {c, c}), A = array(fresh(n), {n}), B = array(fresh(n * c), {n, c});
    Out impulse = array(fresh(n), {n});
    const Sums out{G.data(), D.data(), counted.data(), x.data(), white.data(), nullptr};
    const Shifts made{A.data(), B.data(), impulse.data()};
    const Matrices model{F.data(), Q.data(), h.data(), P0.data(), &R, &lost};
    const Input in{y.data(), z.data(), r.data(), n, static_cast<int>(c), model, {}, d, 0, driver, &end, 1};
    {
        nb::gil_scoped_release released;
        part(d, [&](auto first, auto last) { shifted<first, last>(in, out, made); });
    }
    return nb::make_tuple(G, D[0], A, B, impulse);
}

// Sums over y alone, a record less its columns, with their derivatives by each parameter. `F_by` and so on are the
// matrices' derivatives.
nb::tuple slopes(const Vector &y, const Vector &r, const Matrix &F, const Matrix &Q, const Vector &h, const Matrix &P0,
                 double R, double lost, const Cube &F_by, const Cube &Q_by, const Matrix &h_by, const Cube &P0_by,
                 const Vector &R_by, const Vector &lost_by, int driver) {
    const std::size_t n = y.shape(0), d = h.shape(0), count = h_by.shape(0);
    const Matrix none(nullptr, {0, n});
    const bool diagonal = check(y, none, r, F, Q, h, P0, driver);
    if (count < 1 || count > width)
        throw std::invalid_argument("1 to 4 parameters");
    for (const Cube &by : {F_by, Q_by, P0_by})
        if (by.shape(0) != count || by.shape(1) != d || by.shape(2) != d)
            throw std::invalid_argument("shapes of the derivatives do not fit");
    if (h_by.shape(1) != d || R_by.shape(0) != count || lost_by.shape(0) != count)
        throw std::invalid_argument("shapes of the derivatives do not fit");
    std::vector<double> x(states_max);
    double G = 0.0, D = 0.0, counted = 0.0;
    const Sums out{&G, &D, &counted, x.data(), nullptr, nullptr};
    const Slopes by{fresh(count), fresh(count), fresh(count * count), fresh(count * count)};
    Out G_by = array(by.G, {count}), D_by = array(by.D, {count});
    Out innovations = array(by.innovations, {count, count}), spread = array(by.spread, {count, count});
    const Matrices model{F.data(), Q.data(), h.data(), P0.data(), &R, &lost};
    const Matrices model_by{F_by.data(), Q_by.data(), h_by.data(), P0_by.data(), R_by.data(), lost_by.data()};
    const Input in{y.data(), nullptr, r.data(), n, 1, model, model_by, d, count, driver, &n, 1};
    {
        nb::gil_scoped_release released;
        differentiated<1, states_max>(diagonal, in, out, by);
    }
    return nb::make_tuple(G, D, counted, G_by, D_by, innovations, spread);
}

} // namespace

NB_MODULE(MODULE_NAME, m) {
    using namespace nb::literals;
    m.def("run", &run, "y"_a, "z"_a, "r"_a, "F"_a, "Q"_a, "h"_a, "P0"_a, "R"_a, "lost"_a, "driver"_a, "marks"_a,
          "innovations"_a);
    m.def("shifts", &shifts, "y"_a, "z"_a, "r"_a, "F"_a, "Q"_a, "h"_a, "P0"_a, "R"_a, "lost"_a, "driver"_a);
    m.def("slopes", &slopes, "y"_a, "r"_a, "F"_a, "Q"_a, "h"_a, "P0"_a, "R"_a, "lost"_a, "F_by"_a, "Q_by"_a, "h_by"_a,
          "P0_by"_a, "R_by"_a, "lost_by"_a, "driver"_a);
    m.attr("COLUMNS_MAX") = columns_max;
    m.attr("SLOPES_MAX") = width;
}
