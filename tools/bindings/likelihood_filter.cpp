// The filter of likelihood.hpp. Compiled in parts, side by side (CMakeLists.txt): each for FIRST to LAST states. With
// SLOPES a part has the derivatives in place of the sums.
#include "likelihood.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

using namespace likelihood;

namespace {

// The covariance counts as settled after this many samples in a row that change s by less than `settled` of itself.
constexpr int settled_samples = 8;
constexpr double settled = 1e-12;
// Below a change a sample the gain stays for so many samples, and the covariance goes over them in one jump. s is off
// by 6e-6 of itself at most. Such errors have no sign: over 10^6 samples they sum to some 0.005 nats. The jump of a
// stretch goes on from that of the shorter one.
struct Stretch {
    double slow;
    int doublings;
};
constexpr Stretch stretches[] = {{1e-7, 6}, {1e-8, 8}, {1e-9, 10}};
constexpr int stretch_count = 3;

// Samples that share one gain are cut into so many pieces of one length, and the pieces go through the filter side by
// side: a chain of multiply-adds waits for its own results, and eight chains wait together.
constexpr int groups = 2, lanes = width * groups;
typedef double Lanes __attribute__((vector_size(width * sizeof(double))));
// Of arrays within structs: gcc 12 takes one with rows of an even number of doubles for aligned to a vector, which by
// itself it is not.
constexpr std::size_t aligned = sizeof(Lanes);
// Samples of a piece at most, and at least: shorter ones cost more to join than they save.
constexpr std::size_t piece_most = 128, piece_least = 8;
// States up to which the groups' chains are interleaved.
constexpr int beside = 4;

// A number and its derivatives by up to `width` parameters.
struct Dual {
    double value;
    Lanes slopes;

    Dual(double v = 0.0) : value(v), slopes{} {}

    Dual &operator+=(const Dual &b) {
        value += b.value;
        slopes += b.slopes;
        return *this;
    }
    Dual &operator-=(const Dual &b) {
        value -= b.value;
        slopes -= b.slopes;
        return *this;
    }
    Dual &operator*=(const Dual &b) {
        slopes = value * b.slopes + b.value * slopes;
        value *= b.value;
        return *this;
    }
    friend Dual operator+(Dual a, const Dual &b) { return a += b; }
    friend Dual operator-(Dual a, const Dual &b) { return a -= b; }
    friend Dual operator*(Dual a, const Dual &b) { return a *= b; }
    friend Dual operator/(const Dual &a, const Dual &b) {
        const double inverse = 1.0 / b.value;
        return a * b.through(inverse, -inverse * inverse);
    }

    // A function of the number, by its value and its derivative there.
    Dual through(double v, double slope) const {
        Dual d(v);
        d.slopes = slope * slopes;
        return d;
    }
    bool bent() const {
        for (int j = 0; j < width; j++)
            if (slopes[j] != 0.0)
                return true;
        return false;
    }
};

double value_of(double a) {
    return a;
}
double value_of(const Dual &a) {
    return a.value;
}
double root(double a) {
    return std::sqrt(a);
}
Dual root(const Dual &a) {
    return a.through(std::sqrt(a.value), 0.5 / std::sqrt(a.value));
}
double ln(double a) {
    return std::log(a);
}
Dual ln(const Dual &a) {
    return a.through(std::log(a.value), 1.0 / a.value);
}

void take(double &to, const double *values, const double *, std::size_t i, std::size_t, std::size_t) {
    to = values[i];
}

void take(Dual &to, const double *values, const double *by, std::size_t i, std::size_t size, std::size_t count) {
    to = values[i];
    for (std::size_t j = 0; j < count; j++)
        to.slopes[j] = by[j * size + i];
}

template <class T, int D> using Square = T[D][D];

// The model as the filter has it: T double, or Dual for its derivatives too. Where the filter has more states than the
// model the first ones are 0.
template <class T, int D> struct Model {
    alignas(aligned) Square<T, D> F = {}, Q = {}, P0 = {};
    alignas(aligned) T h[D] = {};
    T R, lost;
    int driver;

    explicit Model(const Input &in) {
        const std::size_t d = in.states, none = D - d;
        driver = in.driver < 0 ? -1 : in.driver + static_cast<int>(none);
        for (std::size_t a = 0; a < d; a++) {
            take(h[none + a], in.m.h, in.by.h, a, d, in.count);
            for (std::size_t b = 0; b < d; b++) {
                take(F[none + a][none + b], in.m.F, in.by.F, a * d + b, d * d, in.count);
                take(Q[none + a][none + b], in.m.Q, in.by.Q, a * d + b, d * d, in.count);
                take(P0[none + a][none + b], in.m.P0, in.by.P0, a * d + b, d * d, in.count);
            }
        }
        take(R, in.m.R, in.by.R, 0, 1, in.count);
        take(lost, in.m.lost, in.by.lost, 0, 1, in.count);
    }

    T noise(double r) const {
        const T all = R * r + lost * (r - 1.0), least = R * (0.1 * r);
        return value_of(all) < value_of(least) ? least : all;
    }
};

// to := from
template <class T, int D> void copy(const Square<T, D> &from, Square<T, D> &to) {
    for (int a = 0; a < D; a++)
        for (int b = 0; b < D; b++)
            to[a][b] = from[a][b];
}

// m := a b
template <class T, int D> void product(const Square<T, D> &a, const Square<T, D> &b, Square<T, D> &m) {
    for (int i = 0; i < D; i++) {
        for (int j = 0; j < D; j++)
            m[i][j] = 0.0;
        for (int k = 0; k < D; k++)
            for (int j = 0; j < D; j++)
                m[i][j] += a[i][k] * b[k][j];
    }
}

// x := (1 + b c)^-1 x, by elimination with pivots.
template <class T, int D> void solve(const Square<T, D> &b, const Square<T, D> &c, Square<T, D> &x) {
    Square<T, D> m;
    product<T, D>(b, c, m);
    for (int i = 0; i < D; i++)
        m[i][i] += 1.0;
    for (int k = 0; k < D; k++) {
        int pivot = k;
        for (int i = k + 1; i < D; i++)
            if (std::fabs(value_of(m[i][k])) > std::fabs(value_of(m[pivot][k])))
                pivot = i;
        for (int j = 0; j < D; j++) {
            std::swap(m[k][j], m[pivot][j]);
            std::swap(x[k][j], x[pivot][j]);
        }
        for (int i = 0; i < D; i++) {
            if (i == k)
                continue;
            const T f = m[i][k] / m[k][k];
            for (int j = k; j < D; j++)
                m[i][j] -= f * m[k][j];
            for (int j = 0; j < D; j++)
                x[i][j] -= f * x[k][j];
        }
    }
    for (int i = 0; i < D; i++)
        for (int j = 0; j < D; j++)
            x[i][j] = x[i][j] / m[i][i];
}

// m := b + a x a'
template <class T, int D>
void congruent(const Square<T, D> &a, const Square<T, D> &x, const Square<T, D> &b, Square<T, D> &m) {
    Square<T, D> ax;
    product<T, D>(a, x, ax);
    for (int i = 0; i < D; i++)
        for (int j = 0; j <= i; j++) {
            T sum = 0.0;
            for (int k = 0; k < D; k++)
                sum += ax[i][k] * a[j][k];
            m[i][j] = m[j][i] = b[i][j] + sum;
        }
}

// The Riccati map of 2^doublings samples with one noise: P := B + A P (1 + C P)^-1 A' (doubling: Anderson & Moore 1979,
// section 6.7).
template <class T, int D> struct Jump {
    alignas(aligned) Square<T, D> A, B, C;
    double r = -1.0;

    void of_one(const Model<T, D> &m, double noise) {
        r = noise;
        copy<T, D>(m.F, A);
        copy<T, D>(m.Q, B);
        for (int a = 0; a < D; a++)
            for (int b = 0; b < D; b++)
                C[a][b] = m.h[a] * m.h[b] / m.noise(r);
        if (m.driver >= 0)
            B[m.driver][m.driver] = B[m.driver][m.driver] * r;
    }

    void twice(int doublings) {
        for (int k = 0; k < doublings; k++) {
            Square<T, D> X, Y, AT, CX, next;
            copy<T, D>(A, X); // (1 + B C)^-1 A
            copy<T, D>(B, Y); // (1 + B C)^-1 B
            solve<T, D>(B, C, X);
            solve<T, D>(B, C, Y);
            for (int a = 0; a < D; a++)
                for (int b = 0; b < D; b++)
                    AT[a][b] = A[b][a];
            congruent<T, D>(A, Y, B, next);
            copy<T, D>(next, B);
            product<T, D>(C, X, CX);
            product<T, D>(AT, CX, next);
            for (int a = 0; a < D; a++)
                for (int b = 0; b < D; b++)
                    C[a][b] += 0.5 * (next[a][b] + next[b][a]);
            product<T, D>(A, X, next);
            copy<T, D>(next, A);
        }
    }

    void over(Square<T, D> &P) const {
        Square<T, D> Y, next;
        copy<T, D>(P, Y);
        solve<T, D>(P, C, Y);
        congruent<T, D>(A, Y, B, next);
        copy<T, D>(next, P);
    }
};

// The filter's numbers from sample `start` on, until the next ones: F K (0 where the reading is missing), 1 / sqrt(s).
template <class T, int D> struct Gain {
    std::size_t start;
    alignas(aligned) T FK[D];
    T scale;
};

// Sums of the products of a number's derivatives.
template <class T> struct Outer {
    void add(const T &, double) {}
};

template <> struct Outer<Dual> {
    Lanes sum[width] = {};

    void add(const Dual &a, double weight) {
        for (int j = 0; j < width; j++)
            sum[j] += weight * a.slopes[j] * a.slopes;
    }

    void add(const Outer &more, double weight) {
        for (int j = 0; j < width; j++)
            sum[j] += weight * more.sum[j];
    }
};

// F is block diagonal, and a step costs of the order of D. PLAIN: F is diagonal. Else the last states are pairs, as far
// as there are blocks of two.
template <class T, int D> struct Filter {
    const Input &in;
    const Sums &out;
    const bool diagonal;
    std::vector<Gain<T, D>> *const gains; // null: nobody asks for them
    const Model<T, D> m;
    alignas(aligned) T below[D] = {}, on[D] = {}, above[D] = {}; // F[a][a-1], F[a][a], F[a][a+1]
    bool tied[D] = {};                                           // whether the state is one of a pair
    alignas(aligned) Square<T, D> P;
    alignas(aligned) T FK[D] = {};
    T s = 0.0, scale = 0.0, ln_now = 0.0;
    double s_before = -1.0, r = -1.0;
    int quiet = 0, slowly[stretch_count] = {};
    double since = 1.0;                 // samples since s_before
    std::size_t held = 0;               // the gain stays until this sample
    std::size_t even_from = 0, even_to; // samples known to be alike
    Jump<T, D> jumps[stretch_count];
    static constexpr bool plain_numbers = std::is_same_v<T, double>;
    static constexpr int most = plain_numbers ? columns_max : 1; // columns
    alignas(aligned) T x[most][D] = {};
    std::size_t joined = 0; // samples of a piece that `left` and `over` are for; 0: for another gain
    alignas(aligned) double left[piece_most][D], over[D][D];
    Lanes nu[columns_max][piece_most][groups];
    T G[most][most] = {}, ln_s = 0.0;
    std::size_t counted = 0;
    Outer<T> innovations, spread; // of the derivatives of the innovations, over s, and of ln s

    Filter(const Input &input, const Sums &output, bool plain_F, std::vector<Gain<T, D>> *kept = nullptr)
        : in(input), out(output), diagonal(plain_F), gains(kept), m(input), even_to(0) {
        for (int i = 0; i < D; i++) {
            on[i] = m.F[i][i];
            below[i] = i > 0 ? m.F[i][i - 1] : 0.0;
            above[i] = i < D - 1 ? m.F[i][i + 1] : 0.0;
            tied[i] = value_of(below[i]) != 0.0 || value_of(above[i]) != 0.0;
        }
        copy<T, D>(m.P0, P);
        if (m.driver >= 0 && in.n > 0)
            P[m.driver][m.driver] = P[m.driver][m.driver] * in.r[0];
    }

    const double *column(int k) const { return k == 0 ? in.y : in.z + static_cast<std::size_t>(k - 1) * in.n; }

    // Whether the sample may be read with the last one's gain, once that has settled.
    bool alike(std::size_t i) const { return std::isfinite(in.y[i]) && in.r[i] == r; }

    // Covariance, gain and s of sample i; the covariance goes on to the next one. It is symmetric: of its derivatives
    // one half is worked out, of mere numbers all, as whole rows are vectors.
    void covariance(std::size_t i) {
        const bool present = std::isfinite(in.y[i]);
        T Ph[D] = {}, K[D], A[D][D], FA[D][D + 2]; // FA: from its second column on, between columns of 0
        s = m.noise(in.r[i]);
        for (int b = 0; b < D; b++)
            for (int a = 0; a < D; a++)
                Ph[a] += P[b][a] * m.h[b];
        for (int a = 0; a < D; a++)
            s += m.h[a] * Ph[a];
        const T inverse = present ? T(1.0) / s : T(0.0);
        for (int a = 0; a < D; a++)
            K[a] = Ph[a] * inverse;
        for (int a = 0; a < D; a++)
            for (int b = plain_numbers ? 0 : a; b < D; b++) {
                A[a][b] = P[a][b] - K[a] * Ph[b];
                if (!plain_numbers)
                    A[b][a] = A[a][b];
            }
        for (int a = 0; a < D; a++) {
            const int before = a > 0 ? a - 1 : 0, after = a < D - 1 ? a + 1 : a, first = plain_numbers ? 0 : before;
            FK[a] = on[a] * K[a];
            FA[a][0] = FA[a][D + 1] = 0.0;
            for (int b = first; b < D; b++)
                FA[a][b + 1] = on[a] * A[a][b];
            if (!tied[a])
                continue;
            FK[a] += below[a] * K[before] + above[a] * K[after];
            for (int b = first; b < D; b++)
                FA[a][b + 1] += below[a] * A[before][b] + above[a] * A[after][b];
        }
        for (int a = 0; a < D; a++) {
            for (int b = plain_numbers ? 0 : a; b < D; b++)
                P[a][b] = m.Q[a][b] + FA[a][b + 1] * on[b];
            if (!diagonal)
                for (int b = plain_numbers ? 0 : a; b < D; b++)
                    if (plain_numbers || tied[b])
                        P[a][b] += FA[a][b] * below[b] + FA[a][b + 2] * above[b];
        }
        for (int a = 0; a < D && !plain_numbers; a++)
            for (int b = 0; b < a; b++)
                P[a][b] = P[b][a];
        if (m.driver >= 0)
            P[m.driver][m.driver] += m.Q[m.driver][m.driver] * (in.r[i] - 1.0);
        scale = T(1.0) / root(s);
        ln_now = ln(s);
        const double s_now = value_of(s), change = alike(i) ? std::fabs(s_now - s_before) : 2.0 * s_now;
        quiet = change <= settled * since * s_now ? quiet + 1 : 0;
        for (int k = 0; k < stretch_count; k++)
            slowly[k] = change <= stretches[k].slow * since * s_now ? slowly[k] + 1 : 0;
        since = 1.0;
        s_before = present ? s_now : -1.0;
        r = in.r[i];
        joined = 0;
    }

    // The samples from i on that are alike, as far as `end`: each is looked at once.
    std::size_t even(std::size_t i, std::size_t end) {
        if (i < even_from || i > even_to || (i == even_to && !(i < in.n && alike(i)))) {
            even_from = even_to = i;
            if (!(i < in.n && alike(i)))
                return i;
        }
        while (even_to < end && alike(even_to))
            even_to++;
        return std::min(even_to, end);
    }

    // The jump of stretch k, from those of the shorter ones.
    void prepare(int k) {
        if (jumps[k].r == r)
            return;
        if (k > 0) {
            prepare(k - 1);
            jumps[k] = jumps[k - 1];
        } else
            jumps[k].of_one(m, r);
        jumps[k].twice(stretches[k].doublings - (k > 0 ? stretches[k - 1].doublings : 0));
    }

    // Gain of sample i, for a stretch of alike samples where it moves slowly enough; the covariance goes beyond them.
    void gain(std::size_t i) {
        for (int k = stretch_count; k-- > 0;) {
            const std::size_t length = std::size_t{1} << stretches[k].doublings;
            if (slowly[k] < settled_samples || in.n - i < length || even(i, i + length) < i + length)
                continue;
            Square<T, D> before;
            copy<T, D>(P, before);
            covariance(i);
            prepare(k);
            copy<T, D>(before, P);
            jumps[k].over(P);
            since = static_cast<double>(length);
            held = i + length;
            return;
        }
        covariance(i);
        held = i + 1;
    }

    void keep(std::size_t i) {
        Gain<T, D> now{i, {}, scale};
        std::memcpy(now.FK, FK, sizeof FK);
        gains->push_back(now);
    }

    // X := F X + FK e
    template <bool PLAIN, class U> void step(U (&X)[D], const U &e) const {
        constexpr int paired = PLAIN ? D : D % 2; // the first state in a pair
#pragma GCC unroll 24
        for (int a = 0; a < paired; a++)
            X[a] = on[a] * X[a] + FK[a] * e;
#pragma GCC unroll 24
        for (int a = paired; a + 1 < D; a += 2) {
            const U first = X[a];
            X[a] = on[a] * first + above[a] * X[a + 1] + FK[a] * e;
            X[a + 1] = below[a + 1] * first + on[a + 1] * X[a + 1] + FK[a + 1] * e;
        }
    }

    // e := value - h X
    template <class U> void innovation(const U &value, const U (&X)[D], U &e) const {
        U sum[4] = {value};
#pragma GCC unroll 24
        for (int a = 0; a < D; a++)
            sum[a % 4] -= m.h[a] * X[a];
        e = (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }

    // No denormals: they cost a hundred times as much.
    template <class U> static U plain(const U &number) {
        return std::fabs(value_of(number)) < 1e-250 ? U(0.0) : number;
    }

    // One sample. A missing reading is 0 and moves nothing, since its gain is 0.
    template <bool PLAIN> void one(std::size_t i) {
        const bool present = std::isfinite(in.y[i]);
        T e[most];
        for (int k = 0; k < in.columns; k++) {
            const T value = k == 0 && !present ? 0.0 : column(k)[i];
            innovation(value, x[k], e[k]);
            step<PLAIN>(x[k], e[k]);
            for (int a = 0; a < D; a++)
                x[k][a] = plain(x[k][a]);
            e[k] = e[k] * scale;
        }
        if (out.white != nullptr)
            for (int k = 0; k < in.columns; k++)
                out.white[i * in.columns + k] = present ? value_of(e[k]) : std::nan("");
        if (present)
            for (int a = 0; a < in.columns; a++)
                for (int b = 0; b <= a; b++)
                    G[a][b] += e[a] * e[b];
    }

    // The readings from `from` to `to`, of one column, all with one gain: as `one`, with values and slopes apart.
    template <bool PLAIN> void alone(std::size_t from, std::size_t to) {
        double v[D];
        Lanes X[D];
        bool bent[D]; // whether a parameter moves what F and h do with the state
        for (int a = 0; a < D; a++) {
            const int after = a < D - 1 ? a + 1 : a;
            bent[a] = on[a].bent() || above[a].bent() || below[after].bent() || m.h[a].bent();
            v[a] = x[0][a].value;
            X[a] = x[0][a].slopes;
        }
        T sum = 0.0;
        Outer<T> products;
        for (std::size_t i = from; i < to; i++) {
            double value[4] = {in.y[i]};
            Lanes slope[4] = {}, moved[D];
#pragma GCC unroll 4
            for (int a = 0; a < D; a++) {
                value[a % 4] -= m.h[a].value * v[a];
                slope[a % 4] -= m.h[a].value * X[a];
            }
#pragma GCC unroll 4
            for (int a = 0; a < D; a++)
                moved[a] = on[a].value * X[a];
            if constexpr (!PLAIN) {
#pragma GCC unroll 4
                for (int a = D % 2; a + 1 < D; a += 2)
                    moved[a] += above[a].value * X[a + 1], moved[a + 1] += below[a + 1].value * X[a];
            }
#pragma GCC unroll 4
            for (int a = 0; a < D; a++)
                if (bent[a]) {
                    slope[a % 4] -= v[a] * m.h[a].slopes;
                    moved[a] += v[a] * on[a].slopes;
                    if (!PLAIN && a > 0)
                        moved[a - 1] += v[a] * above[a - 1].slopes;
                    if (!PLAIN && a < D - 1)
                        moved[a + 1] += v[a] * below[a + 1].slopes;
                }
            const double e = (value[0] + value[1]) + (value[2] + value[3]);
            const Lanes E = (slope[0] + slope[1]) + (slope[2] + slope[3]);
#pragma GCC unroll 4
            for (int a = 0; a < D; a++)
                X[a] = moved[a] + FK[a].value * E + e * FK[a].slopes;
            if constexpr (PLAIN) {
#pragma GCC unroll 4
                for (int a = 0; a < D; a++)
                    v[a] = on[a].value * v[a] + FK[a].value * e;
            } else {
                if (D % 2 != 0)
                    v[0] = on[0].value * v[0] + FK[0].value * e;
#pragma GCC unroll 4
                for (int a = D % 2; a + 1 < D; a += 2) {
                    const double first = v[a];
                    v[a] = on[a].value * first + above[a].value * v[a + 1] + FK[a].value * e;
                    v[a + 1] = below[a + 1].value * first + on[a + 1].value * v[a + 1] + FK[a + 1].value * e;
                }
            }
            sum.value += e * e;
            sum.slopes += 2.0 * e * E;
            for (int j = 0; j < width; j++)
                products.sum[j] += E[j] * E;
        }
        for (int a = 0; a < D; a++) {
            x[0][a].value = v[a];
            x[0][a].slopes = X[a];
        }
        G[0][0] += sum * (scale * scale);
        innovations.add(products, scale.value * scale.value);
    }

    // How a state at the start of a piece of `length` samples acts on it, with M = F - FK h: left[i] = -h M^i on nu of
    // sample i, over = M^length on the state at the end.
    void join(std::size_t length) {
        joined = length;
        double row[D];
        Square<double, D> power, next;
        for (int a = 0; a < D; a++) {
            row[a] = -m.h[a] * scale;
            for (int b = 0; b < D; b++) {
                power[a][b] = m.F[a][b] - FK[a] * m.h[b];
                over[a][b] = a == b ? 1.0 : 0.0;
            }
        }
        for (std::size_t i = 0; i < length; i++) {
            double along = 0.0, last = 0.0;
            for (int a = 0; a < D; a++) {
                left[i][a] = row[a];
                along += row[a] * FK[a];
            }
            for (int a = 0; a < D; a++) {
                const double here = row[a], after = a < D - 1 ? below[a + 1] * row[a + 1] : 0.0;
                row[a] = plain(on[a] * here + (a > 0 ? above[a - 1] : 0.0) * last + after - along * m.h[a]);
                last = here;
            }
        }
        for (std::size_t bits = length; bits != 0; bits >>= 1) {
            if ((bits & 1) != 0) {
                product<double, D>(power, over, next);
                copy<double, D>(next, over);
            }
            if (bits > 1) {
                product<double, D>(power, power, next);
                copy<double, D>(next, power);
            }
        }
    }

    // The samples from `from` on, `lanes` pieces of `length`, all with one gain. Each piece begins with a state of 0.
    // Its true one is known when the piece before has ended, and acts by superposition.
    template <bool PLAIN> void many(std::size_t from, std::size_t length) {
        if (joined != length)
            join(length);
        for (int k = 0; k < in.columns; k++) {
            const double *value = column(k) + from;
            Lanes X[groups][D] = {};
            const auto read = [&](std::size_t i, int g) {
                const double *v = value + i + static_cast<std::size_t>(g * width) * length;
                const Lanes reading = {v[0], v[length], v[2 * length], v[3 * length]};
                Lanes e;
                innovation(reading, X[g], e);
                nu[k][i][g] = e * scale;
                step<PLAIN>(X[g], e);
            };
            if (D <= beside) // all states of both groups in registers
                for (std::size_t i = 0; i < length; i++)
                    for (int g = 0; g < groups; g++)
                        read(i, g);
            else
                for (int g = 0; g < groups; g++)
                    for (std::size_t i = 0; i < length; i++)
                        read(i, g);
            Lanes begun[groups][D] = {};
            for (int lane = 0; lane < lanes; lane++) {
                double next[D];
                for (int a = 0; a < D; a++) {
                    begun[lane / width][a][lane % width] = x[k][a];
                    next[a] = X[lane / width][a][lane % width];
                    for (int j = 0; j < D; j++)
                        next[a] += over[a][j] * x[k][j];
                }
                for (int a = 0; a < D; a++)
                    x[k][a] = plain(next[a]);
            }
            for (std::size_t i = 0; i < length; i++)
                for (int g = 0; g < groups; g++) {
                    Lanes sum[2] = {nu[k][i][g]};
#pragma GCC unroll 24
                    for (int j = 0; j < D; j++)
                        sum[j % 2] += left[i][j] * begun[g][j];
                    nu[k][i][g] = sum[0] + sum[1];
                }
        }
        for (int a = 0; a < in.columns; a++)
            for (int b = 0; b <= a; b++) {
                Lanes sum[groups] = {};
                for (std::size_t i = 0; i < length; i++)
                    for (int g = 0; g < groups; g++)
                        sum[g] += nu[a][i][g] * nu[b][i][g];
                for (int lane = 0; lane < lanes; lane++)
                    G[a][b] += sum[lane / width][lane % width];
            }
        if (out.white != nullptr)
            for (int lane = 0; lane < lanes; lane++)
                for (std::size_t i = 0; i < length; i++)
                    for (int k = 0; k < in.columns; k++)
                        out.white[(from + static_cast<std::size_t>(lane) * length + i) * in.columns + k] =
                            nu[k][i][lane / width][lane % width];
    }

    // The samples from `from` to `to`, all with one gain.
    template <bool PLAIN> void advance(std::size_t from, std::size_t to) {
        if constexpr (!plain_numbers) {
            if (std::isfinite(in.y[from]))
                return alone<PLAIN>(from, to);
        } else
            while (to - from >= lanes * piece_least) {
                const std::size_t length = std::min(piece_most, (to - from) / lanes);
                many<PLAIN>(from, length);
                from += lanes * length;
            }
        for (; from < to; from++)
            one<PLAIN>(from);
    }

    void leave(std::size_t mark) const {
        for (int a = 0; a < in.columns; a++)
            for (int b = 0; b < in.columns; b++)
                out.G[(mark * in.columns + a) * in.columns + b] = value_of(a >= b ? G[a][b] : G[b][a]);
        for (int k = 0; k < in.columns; k++)
            for (int a = 0; a < D; a++)
                out.x[(mark * in.columns + k) * D + a] = value_of(x[k][a]);
        out.D[mark] = value_of(ln_s);
        out.counted[mark] = static_cast<double>(counted);
    }

    void run() {
        std::size_t mark = 0, i = 0;
        bool present = false;
        for (;;) {
            while (mark < in.mark_count && in.marks[mark] == i)
                leave(mark++);
            if (i == in.n)
                return;
            if (i == held) {
                present = std::isfinite(in.y[i]);
                if (quiet >= settled_samples && alike(i))
                    held = even(i, in.n);
                else {
                    gain(i);
                    if (gains != nullptr)
                        keep(i);
                }
                if (m.driver >= 0 && held < in.n)
                    P[m.driver][m.driver] += m.Q[m.driver][m.driver] * (in.r[held] - in.r[i]);
            }
            const std::size_t to = mark < in.mark_count ? std::min(held, in.marks[mark]) : held;
            if (diagonal)
                advance<true>(i, to);
            else
                advance<false>(i, to);
            if (out.s != nullptr)
                for (std::size_t j = i; j < to; j++)
                    out.s[j] = value_of(s);
            if (present) {
                const double samples = static_cast<double>(to - i);
                ln_s += ln_now * samples;
                spread.add(ln_now, samples);
                counted += to - i;
            }
            i = to;
        }
    }
};

template <int D> struct Backward {
    static constexpr int E = D + 1;
    const Filter<double, D> &filter;
    alignas(aligned) double h[E], N[E][E] = {}, R[E][columns_max] = {};
    // F' x at a: left[a] x[a - 1] + on[a] x[a] + right[a] x[a + 1]
    alignas(aligned) double left[E + 1] = {}, on[E], right[E + 1] = {};
    bool steady = false; // N stays as long as the gain does

    explicit Backward(const Filter<double, D> &passed) : filter(passed) {
        for (int a = 0; a < E; a++) {
            h[a] = a < D ? filter.m.h[a] : 1.0;
            on[a] = a < D ? filter.on[a] : 1.0;
            left[a] = a > 0 && a < D ? filter.above[a - 1] : 0.0;
            right[a] = a < D - 1 ? filter.below[a + 1] : 0.0;
        }
    }

    // N := h h' / s + L' N L, with L = F - g h': F' N F - u h' - h u' + (g' N g + 1 / s) h h', where u = F' N g.
    // `Ng` and `gNg` of the N before.
    void information(const double (&Ng)[E], double gNg, double energy) {
        double W[E][E + 2] = {}, u[E], change = 0.0, most = 0.0;
        for (int a = 0; a < E; a++) {
            const int before = a > 0 ? a - 1 : 0, after = a < E - 1 ? a + 1 : a;
            u[a] = left[a] * Ng[before] + on[a] * Ng[a] + right[a] * Ng[after];
            for (int b = 0; b < E; b++)
                W[a][b + 1] = left[a] * N[before][b] + on[a] * N[a][b] + right[a] * N[after][b];
        }
        for (int a = 0; a < E; a++) {
            const double all = (gNg + energy) * h[a] - u[a], own = h[a], here = N[a][a], last = N[a][D];
            for (int b = 0; b < E; b++)
                N[a][b] = left[b] * W[a][b] + on[b] * W[a][b + 1] + right[b] * W[a][b + 2] + all * h[b] - own * u[b];
            change = std::max({change, std::fabs(N[a][a] - here), std::fabs(N[a][D] - last)});
            most = std::max(most, N[a][a]);
        }
        steady = change <= 1e-15 * most;
    }

    // One sample further back for the products with every column: R := F' R - h (g' R - white / sqrt(s)).
    void products(const double (&g)[E], const double *white, double scale) {
        const int columns = filter.in.columns;
        double gR[columns_max], was[E][columns_max];
        for (int c = 0; c < columns; c++)
            gR[c] = scale == 0.0 ? 0.0 : -scale * white[c];
        for (int a = 0; a < E; a++)
            for (int c = 0; c < columns; c++) {
                gR[c] += g[a] * R[a][c];
                was[a][c] = R[a][c];
            }
        for (int a = 0; a < E; a++) {
            const int before = a > 0 ? a - 1 : 0, after = a < E - 1 ? a + 1 : a;
            for (int c = 0; c < columns; c++) {
                const double next =
                    left[a] * was[before][c] + on[a] * was[a][c] + right[a] * was[after][c] - gR[c] * h[a];
                R[a][c] = std::fabs(next) < 1e-250 ? 0.0 : next;
            }
        }
    }

    void run(const std::vector<Gain<double, D>> &gains, const Shifts &out) {
        const Input &in = filter.in;
        std::size_t end = in.n;
        for (std::size_t k = gains.size(); k-- > 0; end = gains[k].start) {
            double g[E] = {}, Ng[E] = {}, gNg = 0.0;
            std::memcpy(g, gains[k].FK, sizeof gains[k].FK);
            steady = false;
            for (std::size_t i = end; i-- > gains[k].start;) {
                const bool present = std::isfinite(in.y[i]);
                const double scale = present ? gains[k].scale : 0.0;
                if (!steady) {
                    gNg = 0.0;
                    for (int a = 0; a < E; a++) {
                        Ng[a] = 0.0;
                        for (int b = 0; b < E; b++)
                            Ng[a] += N[a][b] * g[b];
                        gNg += g[a] * Ng[a];
                    }
                    information(Ng, gNg, scale * scale);
                }
                products(g, filter.out.white + i * in.columns, scale);
                for (int c = 0; c < in.columns; c++)
                    out.B[i * in.columns + c] = R[D][c];
                out.A[i] = N[D][D];
                out.impulse[i] = present ? scale * scale + gNg : 0.0; // by the gain's effect on later readings
            }
        }
    }
};

} // namespace

namespace likelihood {

template <int D, int MOST> void filtered(bool diagonal, const Input &in, const Sums &out) {
    if (in.states == D)
        std::make_unique<Filter<double, D>>(in, out, diagonal)->run();
    else if constexpr (D < MOST)
        filtered<D + 1, MOST>(diagonal, in, out);
}

template <int D, int MOST> void shifted(const Input &in, const Sums &out, const Shifts &shifts) {
    if (in.states == D) {
        std::vector<Gain<double, D>> gains;
        const auto filter = std::make_unique<Filter<double, D>>(in, out, false, &gains);
        filter->run();
        Backward<D>(*filter).run(gains, shifts);
    } else if constexpr (D < MOST)
        shifted<D + 1, MOST>(in, out, shifts);
}

// Compiled for few numbers of states: every one up to 4 and every second beyond.
template <int D, int MOST> void differentiated(bool diagonal, const Input &in, const Sums &out, const Slopes &slopes) {
    if constexpr (D < MOST)
        if (in.states > D)
            return differentiated<D + (D < 4 ? 1 : 2), MOST>(diagonal, in, out, slopes);
    const auto filter = std::make_unique<Filter<Dual, D>>(in, out, diagonal);
    filter->run();
    for (std::size_t j = 0; j < in.count; j++) {
        slopes.G[j] = filter->G[0][0].slopes[j];
        slopes.D[j] = filter->ln_s.slopes[j];
        for (std::size_t k = 0; k < in.count; k++) {
            slopes.innovations[j * in.count + k] = filter->innovations.sum[j][k];
            slopes.spread[j * in.count + k] = filter->spread.sum[j][k];
        }
    }
}

#ifdef SLOPES
template void differentiated<FIRST, LAST>(bool, const Input &, const Sums &, const Slopes &);
#else
template void filtered<FIRST, LAST>(bool, const Input &, const Sums &);
template void shifted<FIRST, LAST>(const Input &, const Sums &, const Shifts &);
#endif

} // namespace likelihood
