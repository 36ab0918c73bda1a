// The Kalman filter of several axes, its smoother, and columns through it. selfcal/_joint.pyi describes the arrays.
//
// Axis i reads loading[i] f + walk[i] + drift[i] + white noise. States: f, then walk and drift of each axis. Axes that
// have no reading are nothing: the rows of their innovation, gain and inverse root are 0.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <deque>
#include <limits>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <vector>

namespace nb = nanobind;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;

constexpr std::size_t width = 4, axes_max = 16;
typedef double Lanes __attribute__((vector_size(width * sizeof(double))));

// The covariance has settled when a step changes it by less than this share.
constexpr double settled = 1e-7;
// What has decayed to `nothing` is 0: denormals cost a hundred times as much. It is looked for every so many samples.
constexpr double nothing = 1e-200;
constexpr std::size_t looked_for = 32;
constexpr double missing = std::numeric_limits<double>::quiet_NaN();

// x(t + 1) = decay x(t) + noise; white noise of covariance R [m, m]; `first`: variance of x(0).
struct Model {
    const double *decay, *noise, *loading, *R, *first;
    std::size_t m, d;
};

Model model_of(const Matrix &y, const Vector &decay, const Vector &noise, const Vector &loading, const Matrix &R,
               const Vector &first) {
    const std::size_t m = loading.shape(0), d = 2 * m + 1;
    if (m < 1 || m > axes_max)
        throw std::invalid_argument("1 to 16 axes");
    if (y.shape(0) != m || decay.shape(0) != d || noise.shape(0) != d || first.shape(0) != d || R.shape(0) != m ||
        R.shape(1) != m)
        throw std::invalid_argument("shapes do not fit");
    return {decay.data(), noise.data(), loading.data(), R.data(), first.data(), m, d};
}

double &at(Lanes *row, std::size_t i) {
    return reinterpret_cast<double *>(row)[i];
}
double at(const Lanes *row, std::size_t i) {
    return reinterpret_cast<const double *>(row)[i];
}

// Numbers by axis and by state of up to 4 G axes.
template <int G> struct Sizes {
    static constexpr std::size_t axes = width * G, groups = 2 * G + 1, states = width * groups;
};

// The largest of the numbers, without their signs.
double most_of(const Lanes *rows, std::size_t count) {
    Lanes most = {};
    for (std::size_t k = 0; k < count; k++) {
        const Lanes size = rows[k] < 0.0 ? -rows[k] : rows[k];
        most = size > most ? size : most;
    }
    return std::max(std::max(most[0], most[1]), std::max(most[2], most[3]));
}

// The filter at one sample: covariance of f and the states before it, gain K by axis, lower inverse root of the
// innovations' covariance by its columns, their variances and ln determinant.
template <int G> struct Gain {
    using S = Sizes<G>;
    Lanes of_f[S::groups] = {}, K[S::axes][S::groups] = {}, root[S::axes][G] = {};
    double variances[S::axes] = {}, ln_det = 0.0;
    bool there[S::axes] = {};
};

template <int G> struct Filter {
    using S = Sizes<G>;
    using Now = Gain<G>;
    const Model model;
    const double *const y;
    const std::size_t n;
    std::deque<Now> gains;
    std::vector<std::size_t> place; // of the gain of each sample
    Lanes decay[S::groups] = {};

    Filter(const Model &of, const Matrix &record) : model(of), y(record.data()), n(record.shape(1)), place(n) {
        for (std::size_t s = 0; s < model.d; s++)
            at(decay, s) = model.decay[s];
        Lanes P[S::states][S::groups] = {};
        for (std::size_t s = 0; s < model.d; s++)
            at(P[s], s) = model.first[s];
        bool steady = false; // the last gain without a gap stays
        std::size_t last = 0;
        for (std::size_t t = 0; t < n; t++) {
            bool whole = true;
            for (std::size_t i = 0; i < model.m; i++)
                whole = whole && std::isfinite(reading(i, t));
            if (!whole || !steady) {
                gains.emplace_back();
                steady = covariance(gains.back(), t, P) && whole;
                last = gains.size() - 1;
            }
            place[t] = last;
        }
    }

    double reading(std::size_t i, std::size_t t) const { return y[i * n + t]; }

    // Gain of sample t, and P of the next one. Whether that hardly changes.
    bool covariance(Now &now, std::size_t t, Lanes (&P)[S::states][S::groups]) {
        const std::size_t m = model.m, d = model.d;
        Lanes hP[S::axes][S::groups] = {};
        double C[S::axes][S::axes], inverse[S::axes][S::axes], volume = 1.0;
        for (std::size_t i = 0; i < m; i++) {
            now.there[i] = std::isfinite(reading(i, t));
            for (std::size_t g = 0; g < S::groups; g++)
                hP[i][g] = model.loading[i] * P[0][g] + P[1 + i][g] + P[1 + m + i][g];
        }
        for (std::size_t i = 0; i < m; i++)
            for (std::size_t j = 0; j <= i; j++) {
                double sum =
                    model.R[i * m + j] + model.loading[j] * at(hP[i], 0) + at(hP[i], 1 + j) + at(hP[i], 1 + m + j);
                if (i == j)
                    now.variances[i] = sum;
                for (std::size_t k = 0; k < j; k++)
                    sum -= C[i][k] * C[j][k];
                if (!now.there[i] || !now.there[j])
                    C[i][j] = i == j ? 1.0 : 0.0;
                else if (i != j)
                    C[i][j] = sum / C[j][j];
                else if (!(sum > 0.0))
                    throw std::domain_error("a covariance is not positive definite");
                else
                    C[i][i] = std::sqrt(sum);
            }
        for (std::size_t j = 0; j < m; j++) {
            volume *= C[j][j];
            for (std::size_t i = j; i < m; i++) {
                double sum = i == j ? 1.0 : 0.0;
                for (std::size_t k = j; k < i; k++)
                    sum -= C[i][k] * inverse[k][j];
                inverse[i][j] = now.there[i] && now.there[j] ? sum / C[i][i] : 0.0;
                at(now.root[j], i) = inverse[i][j];
            }
        }
        Lanes W[S::axes][S::groups] = {}; // the inverse root times h P
        for (std::size_t i = 0; i < m; i++)
            for (std::size_t j = 0; j <= i; j++)
                for (std::size_t g = 0; g < S::groups; g++)
                    W[i][g] += inverse[i][j] * hP[j][g];
        for (std::size_t j = 0; j < m; j++)
            for (std::size_t i = j; i < m; i++)
                for (std::size_t g = 0; g < S::groups; g++)
                    now.K[j][g] += inverse[i][j] * W[i][g];
        now.ln_det = 2.0 * std::log(volume);
        std::copy(P[0], P[0] + S::groups, now.of_f);
        double change = 0.0, most = 0.0;
        for (std::size_t s = 0; s < d; s++) {
            Lanes next[S::groups];
            std::copy(P[s], P[s] + S::groups, next);
            for (std::size_t i = 0; i < m; i++)
                for (std::size_t g = 0; g < S::groups; g++)
                    next[g] -= at(W[i], s) * W[i][g];
            for (std::size_t g = 0; g < S::groups; g++)
                next[g] *= model.decay[s] * decay[g];
            at(next, s) += model.noise[s];
            most = std::max(most, std::fabs(at(next, s)));
            for (std::size_t g = 0; g < S::groups; g++)
                std::swap(P[s][g], next[g]), next[g] -= P[s][g];
            change = std::max(change, most_of(next, S::groups));
        }
        return change < settled * most;
    }

    // sum := the inverse root times v
    static void whiten(const Now &gain, const double *v, std::size_t m, Lanes (&sum)[G]) {
        for (int g = 0; g < G; g++)
            sum[g] = Lanes{};
        for (std::size_t j = 0; j < m; j++)
            for (int g = 0; g < G; g++)
                sum[g] += v[j] * gain.root[j][g];
    }
};

struct Array {
    std::vector<std::size_t> shape;
    double *data;

    explicit Array(std::vector<std::size_t> sizes, double value = 0.0) : shape(std::move(sizes)) {
        std::size_t size = 1;
        for (const std::size_t one : shape)
            size *= one;
        data = new double[size > 0 ? size : 1];
        std::fill(data, data + size, value);
    }

    Out out() const {
        nb::capsule owner(data, [](void *p) noexcept { delete[] static_cast<double *>(p); });
        return {data, shape.size(), shape.data(), owner};
    }

    double *row(std::size_t t) const { return data + t * shape[1]; }
};

struct Course {
    Array innovations, spread, predicted, f, weights, of_f, known;
};

template <int G> void filtered(const Filter<G> &filter, const Course &out, double &ln_likelihood) {
    using S = Sizes<G>;
    const Model &model = filter.model;
    const std::size_t m = model.m;
    bool seen[S::axes] = {};
    std::size_t unseen = m;
    Lanes x[S::groups] = {}, u[G];
    for (std::size_t t = 0; t < filter.n; t++) {
        const Gain<G> &gain = filter.gains[filter.place[t]];
        std::copy_n(reinterpret_cast<const double *>(x), model.d, out.predicted.row(t));
        double v[S::axes] = {}, square = 0.0;
        for (std::size_t i = 0; i < m; i++)
            if (gain.there[i])
                v[i] = filter.reading(i, t) - (model.loading[i] * at(x, 0) + at(x, 1 + i) + at(x, 1 + m + i));
        Filter<G>::whiten(gain, v, m, u);
        for (std::size_t i = 0; i < m; i++)
            square += at(u, i) * at(u, i);
        if (unseen == 0)
            ln_likelihood -= 0.5 * (square + gain.ln_det);
        for (std::size_t i = 0; i < m; i++) {
            out.spread.row(t)[i] = gain.variances[i];
            if (!gain.there[i])
                continue;
            out.innovations.row(t)[i] = v[i];
            if (!seen[i]) // the first reading of an axis sets its level
                seen[i] = true, unseen--;
            for (std::size_t g = 0; g < S::groups; g++)
                x[g] += v[i] * gain.K[i][g];
        }
        for (std::size_t g = 0; g < S::groups; g++)
            x[g] *= filter.decay[g];
    }
}

// Backwards r' = h' S^-1 v + L' r with L = decay (1 - K h), so r' = decay r + h' (S^-1 v - K' decay r) (de Jong,
// Biometrika 75, 1988): the score of a jump of each state. Its information N runs likewise (Harvey & Koopman, J. Bus.
// Econ. Stat. 10, 1992).
template <int G> struct Smoother {
    using S = Sizes<G>;
    const Filter<G> &filter;
    const Course &out;
    Lanes r[S::groups] = {}, N[S::states][S::groups] = {};

    // h' b to the rows of a, of states
    template <class T> void spread(const T &b, std::size_t i, T &f, T &walk, T &drift) const {
        f += filter.model.loading[i] * b;
        walk += b, drift += b;
    }

    // N := h' S^-1 h + L' N L. Whether it hardly changes.
    bool information(const Gain<G> &gain) {
        const std::size_t m = filter.model.m, d = filter.model.d;
        Lanes back[S::axes][S::groups], by_state[S::states][G] = {}, inverse[S::axes][G] = {}; // K' decay; S^-1
        for (std::size_t i = 0; i < m; i++) {
            for (std::size_t g = 0; g < S::groups; g++)
                back[i][g] = gain.K[i][g] * filter.decay[g];
            for (std::size_t s = 0; s < d; s++)
                at(by_state[s], i) = at(back[i], s);
        }
        for (std::size_t i = 0; i < m; i++)
            for (std::size_t j = 0; j < m; j++)
                for (std::size_t k = std::max(i, j); k < m; k++)
                    at(inverse[i], j) += at(gain.root[i], k) * at(gain.root[j], k);
        // N L = decay N - N back' h, by rows; then L' (N L), by its columns.
        Lanes NL[S::states][S::groups] = {}, next[S::states][S::groups] = {};
        for (std::size_t s = 0; s < d; s++) {
            for (std::size_t g = 0; g < S::groups; g++)
                NL[s][g] = N[s][g] * filter.decay[g];
            Lanes b[G] = {};
            for (std::size_t k = 0; k < d; k++)
                for (int g = 0; g < G; g++)
                    b[g] -= at(N[s], k) * by_state[k][g];
            for (std::size_t i = 0; i < m; i++)
                spread(at(b, i), i, at(NL[s], 0), at(NL[s], 1 + i), at(NL[s], 1 + m + i));
        }
        for (std::size_t s = 0; s < d; s++)
            for (std::size_t g = 0; g < S::groups; g++)
                next[s][g] = at(filter.decay, s) * NL[s][g];
        for (std::size_t i = 0; i < m; i++) {
            Lanes row[S::groups] = {}; // of S^-1 h - back N L
            for (std::size_t j = 0; j < m; j++)
                spread(at(inverse[i], j), j, at(row, 0), at(row, 1 + j), at(row, 1 + m + j));
            for (std::size_t s = 0; s < d; s++)
                for (std::size_t g = 0; g < S::groups; g++)
                    row[g] -= at(back[i], s) * NL[s][g];
            for (std::size_t g = 0; g < S::groups; g++)
                spread(row[g], i, next[0][g], next[1 + i][g], next[1 + m + i][g]);
        }
        const double most = most_of(next[0], S::states * S::groups);
        for (std::size_t s = 0; s < S::states; s++)
            for (std::size_t g = 0; g < S::groups; g++)
                std::swap(N[s][g], next[s][g]), next[s][g] -= N[s][g];
        return most_of(next[0], S::states * S::groups) < settled * most;
    }

    void run() {
        const std::size_t m = filter.model.m;
        bool constant = false;
        for (std::size_t t = filter.n; t-- > 0;) {
            const Gain<G> &gain = filter.gains[filter.place[t]];
            const bool same = t + 1 < filter.n && filter.place[t + 1] == filter.place[t];
            double v[S::axes] = {};
            for (std::size_t i = 0; i < m; i++)
                if (gain.there[i])
                    v[i] = out.innovations.row(t)[i];
            Lanes u[G], ahead[S::groups];
            Filter<G>::whiten(gain, v, m, u);
            for (std::size_t g = 0; g < S::groups; g++)
                ahead[g] = filter.decay[g] * r[g];
            for (std::size_t i = 0; i < m; i++) {
                if (!gain.there[i])
                    continue;
                Lanes e = {}, product = {};
                for (int g = 0; g < G; g++)
                    e += gain.root[i][g] * u[g];
                for (std::size_t g = 0; g < S::groups; g++)
                    product += gain.K[i][g] * filter.decay[g] * r[g];
                e -= product;
                const double weight = (e[0] + e[1]) + (e[2] + e[3]);
                out.weights.row(t)[i] = weight;
                spread(weight, i, at(ahead, 0), at(ahead, 1 + i), at(ahead, 1 + m + i));
            }
            std::copy(ahead, ahead + S::groups, r);
            if (!(constant && same))
                constant = information(gain) && same;
            double f = out.predicted.row(t)[0];
            for (std::size_t s = 0; s < filter.model.d; s++)
                f += at(gain.of_f, s) * at(r, s);
            out.f.data[t] = f;
            out.of_f.row(t)[0] = at(r, 0), out.of_f.row(t)[1] = at(N[0], 0);
            for (std::size_t i = 0; i < m; i++)
                std::copy_n(reinterpret_cast<const double *>(N[1 + i]) + 1, m, out.known.data + (t * m + i) * m);
        }
    }
};

// Each of the columns on every axis, beside each other: total [k, m, m].
template <int G> void informed(const Filter<G> &filter, const Matrix &columns, const Array &total) {
    using S = Sizes<G>;
    const Model &model = filter.model;
    const std::size_t m = model.m, n = filter.n;
    for (std::size_t k = 0; k < columns.shape(0); k++) {
        Lanes X[S::states][G] = {}, sum[S::axes][G] = {};
        for (std::size_t t = 0; t < n; t++) {
            const Gain<G> &gain = filter.gains[filter.place[t]];
            Lanes V[S::axes][G], W[S::axes][G] = {};
            for (std::size_t i = 0; i < m; i++) {
                for (int g = 0; g < G; g++)
                    V[i][g] = -(model.loading[i] * X[0][g] + X[1 + i][g] + X[1 + m + i][g]);
                if (gain.there[i])
                    at(V[i], i) += columns.data()[k * n + t];
            }
            for (std::size_t j = 0; j < m; j++)
                for (std::size_t i = j; i < m; i++)
                    for (int g = 0; g < G; g++)
                        W[i][g] += at(gain.root[j], i) * V[j][g];
            for (std::size_t i = 0; i < m; i++)
                for (std::size_t a = 0; a < m; a++)
                    for (int g = 0; g < G; g++)
                        sum[a][g] += at(W[i], a) * W[i][g];
            for (std::size_t s = 0; s < model.d; s++)
                for (int g = 0; g < G; g++) {
                    Lanes next = X[s][g];
                    for (std::size_t i = 0; i < m; i++)
                        next += at(gain.K[i], s) * V[i][g];
                    X[s][g] = model.decay[s] * next;
                }
            if (t % looked_for == 0)
                for (std::size_t s = 0; s < model.d; s++)
                    for (std::size_t i = 0; i < m; i++)
                        if (std::fabs(at(X[s], i)) < nothing)
                            at(X[s], i) = 0.0;
        }
        for (std::size_t a = 0; a < m; a++)
            std::copy_n(reinterpret_cast<const double *>(sum[a]), m, total.data + (k * m + a) * m);
    }
}

// Compiled for up to 4, 8 and 16 axes.
template <class Of> void sized(std::size_t m, const Of &of) {
    if (m <= 4)
        of(std::integral_constant<int, 1>());
    else if (m <= 8)
        of(std::integral_constant<int, 2>());
    else
        of(std::integral_constant<int, 4>());
}

nb::tuple course(const Matrix &y, const Vector &decay, const Vector &noise, const Vector &loading, const Matrix &R,
                 const Vector &first, bool smoothed) {
    const Model model = model_of(y, decay, noise, loading, R, first);
    const std::size_t m = model.m, n = y.shape(1), d = model.d, back = smoothed ? n : 0;
    const Course out{Array({n, m}, missing), Array({n, m}, missing), Array({n, d}),      Array({back}),
                     Array({back, m}),       Array({back, 2}),       Array({back, m, m})};
    double ln_likelihood = 0.0;
    {
        nb::gil_scoped_release released;
        sized(m, [&](auto groups) {
            const Filter<groups> filter(model, y);
            filtered<groups>(filter, out, ln_likelihood);
            if (smoothed)
                Smoother<groups>{filter, out}.run();
        });
    }
    return nb::make_tuple(ln_likelihood, out.innovations.out(), out.spread.out(), out.predicted.out(), out.f.out(),
                          out.weights.out(), out.of_f.out(), out.known.out());
}

Out information(const Matrix &y, const Matrix &columns, const Vector &decay, const Vector &noise, const Vector &loading,
                const Matrix &R, const Vector &first) {
    const Model model = model_of(y, decay, noise, loading, R, first);
    if (columns.shape(1) != y.shape(1))
        throw std::invalid_argument("shapes do not fit");
    const Array total({columns.shape(0), model.m, model.m});
    {
        nb::gil_scoped_release released;
        sized(model.m, [&](auto groups) { informed<groups>(Filter<groups>(model, y), columns, total); });
    }
    return total.out();
}

} // namespace

NB_MODULE(MODULE_NAME, module) {
    using namespace nb::literals;
    module.def("course", &course, "y"_a, "decay"_a, "noise"_a, "loading"_a, "R"_a, "first"_a, "smoothed"_a);
    module.def("information", &information, "y"_a, "columns"_a, "decay"_a, "noise"_a, "loading"_a, "R"_a, "first"_a);
}
