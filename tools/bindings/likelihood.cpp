// The likelihood of a record under any small state model: the diagnosis tries models here before the bank gets them.
//
// y_i = h x_i + sum_k c_k z_ik + v_i,  x_(i+1) = F x_i + w_i,  w ~ N(0, Q),  v_i ~ N(0, R r_i),  x_0 ~ N(0, P0).
// One Kalman filter runs over the record and over every column z_k (de Jong 1991): with the whitened innovations
// nu_y and u_k, the Gram matrix G = sum [nu_y, u]' [nu_y, u] and D = sum ln s are all that the likelihood of any
// coefficients needs: the least squares estimate is c = G_uu^-1 G_uy.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstddef>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;

constexpr int states_max = 12;
constexpr int columns_max = 40;
// The covariance counts as settled after this many samples in a row that change s by less than `settled` of itself.
constexpr int settled_samples = 8;
constexpr double settled = 1e-12;

struct Input {
    const double *y, *z, *r; // z: [p, n]
    std::size_t n;
    int columns; // 1 + p
    const double *F, *Q, *h, *P0;
    double R;
    const std::size_t *marks;
    std::size_t mark_count;
};

struct Sums {
    double *G;       // [marks, columns, columns]
    double *D;       // [marks]
    double *counted; // [marks] samples present
    double *x;       // [marks, columns, states] predicted states at each mark
    double *white;   // [n, columns] or null: whitened innovations, NaN where y is missing
    double *s;       // [n] or null: variance of each innovation
};

// Sums are folded every so many samples: plain double would lose digits over 10^7.
constexpr std::size_t fold = 512;

template <int D> struct Filter {
    const Input &in;
    const Sums &out;
    double P[D][D], x[columns_max][D] = {}, FK[D] = {}, M[D][D] = {};
    double s = 0.0, s_before = -1.0, scale = 0.0, ln_now = 0.0;
    int quiet = 0;
    double nu[columns_max][fold]; // whitened innovations of the samples since `start`
    std::size_t start = 0;
    double G[columns_max][columns_max] = {}, ln_s = 0.0;
    std::size_t counted = 0;

    Filter(const Input &input, const Sums &output) : in(input), out(output) {
        for (int i = 0; i < D; i++)
            for (int j = 0; j < D; j++)
                P[i][j] = in.P0[i * D + j];
    }

    bool plain(std::size_t i) const { return std::isfinite(in.y[i]) && in.r[i] == 1.0; }

    // Covariance, gain and s of sample i; the covariance goes on to the next one.
    void covariance(std::size_t i) {
        const bool present = std::isfinite(in.y[i]);
        double Ph[D], K[D], A[D][D], FA[D][D];
        s = in.R * in.r[i];
        for (int a = 0; a < D; a++) {
            Ph[a] = 0.0;
            for (int b = 0; b < D; b++)
                Ph[a] += P[a][b] * in.h[b];
            s += in.h[a] * Ph[a];
        }
        for (int a = 0; a < D; a++)
            K[a] = present ? Ph[a] / s : 0.0;
        for (int a = 0; a < D; a++)
            for (int b = 0; b < D; b++)
                A[a][b] = P[a][b] - K[a] * Ph[b];
        for (int a = 0; a < D; a++)
            for (int b = 0; b < D; b++) {
                FA[a][b] = 0.0;
                for (int k = 0; k < D; k++)
                    FA[a][b] += in.F[a * D + k] * A[k][b];
            }
        for (int a = 0; a < D; a++) {
            FK[a] = 0.0;
            for (int b = 0; b < D; b++)
                FK[a] += in.F[a * D + b] * K[b];
            for (int b = 0; b < D; b++)
                M[a][b] = in.F[a * D + b] - FK[a] * in.h[b];
            for (int b = a; b < D; b++) {
                double sum = in.Q[a * D + b];
                for (int k = 0; k < D; k++)
                    sum += FA[a][k] * in.F[b * D + k];
                P[a][b] = P[b][a] = sum;
            }
        }
        scale = 1.0 / std::sqrt(s);
        ln_now = std::log(s);
        quiet = plain(i) && std::fabs(s - s_before) <= settled * s ? quiet + 1 : 0;
        s_before = plain(i) ? s : -1.0;
    }

    // Innovations of column k over the samples from `from` to `to`, all with one gain.
    void column(int k, std::size_t from, std::size_t to) {
        const double *value = k == 0 ? in.y : in.z + static_cast<std::size_t>(k - 1) * in.n;
        double X[D];
        for (int a = 0; a < D; a++)
            X[a] = x[k][a];
        for (std::size_t i = from; i < to; i++) {
            const double v = k == 0 && !std::isfinite(value[i]) ? 0.0 : value[i];
            double predicted = 0.0, next[D];
            for (int a = 0; a < D; a++)
                predicted += in.h[a] * X[a];
            nu[k][i - start] = (v - predicted) * scale;
            for (int a = 0; a < D; a++) {
                next[a] = FK[a] * v;
                for (int b = 0; b < D; b++)
                    next[a] += M[a][b] * X[b];
            }
            for (int a = 0; a < D; a++)
                X[a] = next[a];
        }
        for (int a = 0; a < D; a++) // no denormals: they cost a hundred times as much
            x[k][a] = std::fabs(X[a]) < 1e-250 ? 0.0 : X[a];
    }

    void flush(std::size_t end) {
        for (int a = 0; a < in.columns; a++)
            for (int b = 0; b <= a; b++) {
                double sum[4] = {};
                std::size_t i = 0;
                for (; i + 4 <= end - start; i += 4)
                    for (int k = 0; k < 4; k++)
                        sum[k] += nu[a][i + k] * nu[b][i + k];
                for (; i < end - start; i++)
                    sum[0] += nu[a][i] * nu[b][i];
                G[a][b] += sum[0] + sum[1] + sum[2] + sum[3];
                G[b][a] = G[a][b];
            }
        start = end;
    }

    void run() {
        std::size_t mark = 0, i = 0;
        for (;;) {
            while (mark < in.mark_count && in.marks[mark] == i) {
                flush(i);
                for (int a = 0; a < in.columns; a++)
                    for (int b = 0; b < in.columns; b++)
                        out.G[(mark * in.columns + a) * in.columns + b] = G[a][b];
                for (int k = 0; k < in.columns; k++)
                    for (int a = 0; a < D; a++)
                        out.x[(mark * in.columns + k) * D + a] = x[k][a];
                out.D[mark] = ln_s;
                out.counted[mark++] = static_cast<double>(counted);
            }
            if (i == in.n)
                return;
            std::size_t end = i + 1;
            const bool present = std::isfinite(in.y[i]);
            if (quiet >= settled_samples && plain(i)) {
                const std::size_t stop = mark < in.mark_count ? in.marks[mark] : in.n;
                while (end < stop && end < start + fold && plain(end))
                    end++;
            } else {
                covariance(i);
            }
            for (int k = 0; k < in.columns; k++)
                column(k, i, end);
            for (std::size_t j = i; j < end; j++)
                for (int k = 0; k < in.columns; k++) {
                    if (out.white != nullptr)
                        out.white[j * in.columns + k] = present ? nu[k][j - start] : std::nan("");
                    if (!present)
                        nu[k][j - start] = 0.0;
                }
            if (out.s != nullptr)
                for (std::size_t j = i; j < end; j++)
                    out.s[j] = s;
            if (present) {
                ln_s += ln_now * static_cast<double>(end - i);
                counted += end - i;
            }
            i = end;
            if (i == start + fold)
                flush(i);
        }
    }
};

template <int D> void filter(const Input &in, const Sums &out) { Filter<D>(in, out).run(); }

double *fresh(std::size_t size) { return new double[size > 0 ? size : 1]; }

Out array(double *data, std::vector<std::size_t> shape) {
    nb::capsule owner(data, [](void *p) noexcept { delete[] static_cast<double *>(p); });
    return {data, shape.size(), shape.data(), owner};
}

nb::tuple run(const Vector &y, const Matrix &z, const Vector &r, const Matrix &F, const Matrix &Q, const Vector &h,
              const Matrix &P0, double R, const std::vector<std::size_t> &marks, bool innovations) {
    const std::size_t n = y.shape(0), d = h.shape(0), p = z.shape(0);
    if (d < 1 || d > states_max || p + 1 > columns_max)
        throw std::invalid_argument("1 to 12 states and at most 39 columns");
    if (z.shape(1) != n || r.shape(0) != n || F.shape(0) != d || F.shape(1) != d || Q.shape(0) != d ||
        Q.shape(1) != d || P0.shape(0) != d || P0.shape(1) != d)
        throw std::invalid_argument("shapes do not fit");
    for (std::size_t k = 0; k < marks.size(); k++)
        if (marks[k] > n || (k > 0 && marks[k] < marks[k - 1]))
            throw std::invalid_argument("marks must rise, up to the length of y");
    const int c = static_cast<int>(p) + 1;
    const std::size_t m = marks.size();
    Sums out{fresh(m * c * c), fresh(m), fresh(m), fresh(m * c * d), innovations ? fresh(n * c) : nullptr, innovations ? fresh(n) : nullptr};
    Out G = array(out.G, {m, std::size_t(c), std::size_t(c)}), D = array(out.D, {m}), counted = array(out.counted, {m});
    Out x = array(out.x, {m, std::size_t(c), d});
    Out white = array(innovations ? out.white : fresh(0), {innovations ? n : 0, std::size_t(c)});
    Out s = array(innovations ? out.s : fresh(0), {innovations ? n : 0});
    const Input in{y.data(), z.data(), r.data(), n, c, F.data(), Q.data(), h.data(), P0.data(), R, marks.data(), m};
    {
        nb::gil_scoped_release released;
        switch (d) {
        case 1: filter<1>(in, out); break;
        case 2: filter<2>(in, out); break;
        case 3: filter<3>(in, out); break;
        case 4: filter<4>(in, out); break;
        case 5: filter<5>(in, out); break;
        case 6: filter<6>(in, out); break;
        case 7: filter<7>(in, out); break;
        case 8: filter<8>(in, out); break;
        case 9: filter<9>(in, out); break;
        case 10: filter<10>(in, out); break;
        case 11: filter<11>(in, out); break;
        default: filter<12>(in, out); break;
        }
    }
    return nb::make_tuple(G, D, counted, x, white, s);
}

} // namespace

NB_MODULE(_likelihood, m) {
    using namespace nb::literals;
    m.def("run", &run, "y"_a, "z"_a, "r"_a, "F"_a, "Q"_a, "h"_a, "P0"_a, "R"_a, "marks"_a, "innovations"_a);
    m.attr("STATES_MAX") = states_max;
    m.attr("COLUMNS_MAX") = columns_max;
}
