// The likelihood of a record under any small state model: the diagnosis tries models here before the bank gets them.
//
// y_i = h x_i + sum_k c_k z_ik + v_i,  x_(i+1) = F x_i + w_i,  w ~ N(0, Q),  v_i ~ N(0, R r_i),  x_0 ~ N(0, P0).
// White noise with memory is a state: r then scales the noise of the state `driver` (-1: none) that enters at i.
// One Kalman filter runs over the record and over every column z_k (de Jong 1991): with the whitened innovations
// nu_y and u_k, the Gram matrix G = sum [nu_y, u]' [nu_y, u] and D = sum ln s are all that the likelihood of any
// coefficients needs: the least squares estimate is c = G_uu^-1 G_uy.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

namespace nb = nanobind;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;

constexpr int states_max = 24;
constexpr int columns_max = 40;
// The covariance counts as settled after this many samples in a row that change s by less than `settled` of itself.
constexpr int settled_samples = 8;
constexpr double settled = 1e-12;
// Below a change a sample the gain stays for so many samples, and the covariance goes over them in one jump. s is off
// by 6e-6 of itself at most. Such errors have no sign: over 10^6 samples they sum to some 0.005 nats.
struct Stretch {
    double slow;
    int doublings;
};
constexpr Stretch stretches[] = {{1e-9, 10}, {1e-7, 6}};
constexpr int stretch_count = 2;

// Samples that share one gain are cut into so many pieces of one length, and the pieces go through the filter side by
// side: a chain of multiply-adds waits for its own results, and eight chains wait together.
constexpr int width = 4, groups = 2, lanes = width * groups;
typedef double Lanes __attribute__((vector_size(width * sizeof(double))));
// Samples of a piece at most, and at least: shorter ones cost more to join than they save.
constexpr std::size_t piece_most = 128, piece_least = 8;
// States up to which the groups' chains are interleaved.
constexpr int beside = 4;

struct Input {
    const double *y, *z, *r; // z: [p, n]
    std::size_t n;
    int columns; // 1 + p
    const double *F, *Q, *h, *P0;
    double R;
    int driver;
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

template <int D> using Square = double[D][D];

// m := a b
template <int D> void product(const Square<D> &a, const Square<D> &b, Square<D> &m) {
    for (int i = 0; i < D; i++) {
        for (int j = 0; j < D; j++)
            m[i][j] = 0.0;
        for (int k = 0; k < D; k++)
            for (int j = 0; j < D; j++)
                m[i][j] += a[i][k] * b[k][j];
    }
}

// x := (1 + b c)^-1 x, by elimination with pivots.
template <int D> void solve(const Square<D> &b, const Square<D> &c, Square<D> &x) {
    Square<D> m;
    product<D>(b, c, m);
    for (int i = 0; i < D; i++)
        m[i][i] += 1.0;
    for (int k = 0; k < D; k++) {
        int pivot = k;
        for (int i = k + 1; i < D; i++)
            if (std::fabs(m[i][k]) > std::fabs(m[pivot][k]))
                pivot = i;
        for (int j = 0; j < D; j++) {
            std::swap(m[k][j], m[pivot][j]);
            std::swap(x[k][j], x[pivot][j]);
        }
        for (int i = 0; i < D; i++) {
            if (i == k)
                continue;
            const double f = m[i][k] / m[k][k];
            for (int j = k; j < D; j++)
                m[i][j] -= f * m[k][j];
            for (int j = 0; j < D; j++)
                x[i][j] -= f * x[k][j];
        }
    }
    for (int i = 0; i < D; i++)
        for (int j = 0; j < D; j++)
            x[i][j] /= m[i][i];
}

// m := b + a x a'
template <int D> void congruent(const Square<D> &a, const Square<D> &x, const Square<D> &b, Square<D> &m) {
    Square<D> ax;
    product<D>(a, x, ax);
    for (int i = 0; i < D; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int k = 0; k < D; k++)
                sum += ax[i][k] * a[j][k];
            m[i][j] = m[j][i] = b[i][j] + sum;
        }
}

// The Riccati map of 2^doublings samples with one noise: P := B + A P (1 + C P)^-1 A' (doubling: Anderson & Moore 1979,
// section 6.7).
template <int D> struct Jump {
    Square<D> A, B, C;
    double r = -1.0;

    void prepare(const Input &in, double noise, int doublings) {
        r = noise;
        for (int a = 0; a < D; a++)
            for (int b = 0; b < D; b++) {
                A[a][b] = in.F[a * D + b];
                B[a][b] = in.Q[a * D + b];
                C[a][b] = in.h[a] * in.h[b] / (in.R * r);
            }
        if (in.driver >= 0)
            B[in.driver][in.driver] *= r;
        for (int k = 0; k < doublings; k++) {
            Square<D> X, Y, AT, CX, next;
            std::memcpy(X, A, sizeof X); // (1 + B C)^-1 A
            std::memcpy(Y, B, sizeof Y); // (1 + B C)^-1 B
            solve<D>(B, C, X);
            solve<D>(B, C, Y);
            for (int a = 0; a < D; a++)
                for (int b = 0; b < D; b++)
                    AT[a][b] = A[b][a];
            congruent<D>(A, Y, B, next);
            std::memcpy(B, next, sizeof B);
            product<D>(C, X, CX);
            product<D>(AT, CX, next);
            for (int a = 0; a < D; a++)
                for (int b = 0; b < D; b++)
                    C[a][b] += 0.5 * (next[a][b] + next[b][a]);
            product<D>(A, X, next);
            std::memcpy(A, next, sizeof A);
        }
    }

    void over(Square<D> &P) const {
        Square<D> Y, next;
        std::memcpy(Y, P, sizeof Y);
        solve<D>(P, C, Y);
        congruent<D>(A, Y, B, next);
        std::memcpy(P, next, sizeof P);
    }
};

// The filter's numbers from sample `start` on, until the next ones: F K (0 where the reading is missing), 1 / sqrt(s).
template <int D> struct Gain {
    std::size_t start;
    double FK[D], scale;
};

// F is block diagonal, and a step costs of the order of D. PLAIN: F is diagonal. Else the last states are pairs, as far
// as there are blocks of two.
template <int D, bool PLAIN> struct Filter {
    const Input &in;
    const Sums &out;
    std::vector<Gain<D>> *const gains; // null: nobody asks for them
    double h[D] = {}, below[D] = {}, on[D] = {}, above[D] = {}; // F[a][a-1], F[a][a], F[a][a+1]
    double P[D][D], FK[D] = {};
    double s = 0.0, s_before = -1.0, r = -1.0, scale = 0.0, ln_now = 0.0;
    int quiet = 0, slowly[stretch_count] = {};
    double since = 1.0;                 // samples since s_before
    std::size_t held = 0;               // the gain stays until this sample
    std::size_t even_from = 0, even_to; // samples known to be alike
    Jump<D> jumps[stretch_count];
    double x[columns_max][D] = {};
    std::size_t joined = 0; // samples of a piece that `left` and `over` are for; 0: for another gain
    double left[piece_most][D], over[D][D];
    Lanes nu[columns_max][piece_most][groups];
    double G[columns_max][columns_max] = {}, ln_s = 0.0;
    std::size_t counted = 0;

    Filter(const Input &input, const Sums &output, std::vector<Gain<D>> *kept = nullptr)
        : in(input), out(output), gains(kept), even_to(0) {
        for (int i = 0; i < D; i++) {
            h[i] = in.h[i];
            on[i] = in.F[i * D + i];
            below[i] = i > 0 ? in.F[i * D + i - 1] : 0.0;
            above[i] = i < D - 1 ? in.F[i * D + i + 1] : 0.0;
            for (int j = 0; j < D; j++)
                P[i][j] = in.P0[i * D + j];
        }
        if (in.driver >= 0 && in.n > 0)
            P[in.driver][in.driver] *= in.r[0];
    }

    const double *column(int k) const { return k == 0 ? in.y : in.z + static_cast<std::size_t>(k - 1) * in.n; }

    // Whether the sample may be read with the last one's gain, once that has settled.
    bool alike(std::size_t i) const { return std::isfinite(in.y[i]) && in.r[i] == r; }

    // Covariance, gain and s of sample i; the covariance goes on to the next one.
    void covariance(std::size_t i) {
        const bool present = std::isfinite(in.y[i]);
        double Ph[D], K[D], A[D][D], FA[D][D];
        s = in.R * in.r[i];
        for (int a = 0; a < D; a++) {
            Ph[a] = 0.0;
            for (int b = 0; b < D; b++)
                Ph[a] += P[b][a] * in.h[b];
            s += in.h[a] * Ph[a];
        }
        const double inverse = present ? 1.0 / s : 0.0;
        for (int a = 0; a < D; a++)
            K[a] = Ph[a] * inverse;
        for (int a = 0; a < D; a++)
            for (int b = 0; b < D; b++)
                A[a][b] = P[a][b] - K[a] * Ph[b];
        for (int a = 0; a < D; a++) {
            const int before = a > 0 ? a - 1 : 0, after = a < D - 1 ? a + 1 : a;
            FK[a] = below[a] * K[before] + on[a] * K[a] + above[a] * K[after];
            for (int b = 0; b < D; b++)
                FA[a][b] = below[a] * A[before][b] + on[a] * A[a][b] + above[a] * A[after][b];
        }
        for (int a = 0; a < D; a++)
            for (int b = a; b < D; b++) {
                const int before = b > 0 ? b - 1 : 0, after = b < D - 1 ? b + 1 : b;
                P[a][b] = P[b][a] =
                    in.Q[a * D + b] + FA[a][before] * below[b] + FA[a][b] * on[b] + FA[a][after] * above[b];
            }
        if (in.driver >= 0)
            P[in.driver][in.driver] += in.Q[in.driver * D + in.driver] * (in.r[i] - 1.0);
        scale = 1.0 / std::sqrt(s);
        ln_now = std::log(s);
        const double change = alike(i) ? std::fabs(s - s_before) : 2.0 * s;
        quiet = change <= settled * since * s ? quiet + 1 : 0;
        for (int k = 0; k < stretch_count; k++)
            slowly[k] = change <= stretches[k].slow * since * s ? slowly[k] + 1 : 0;
        since = 1.0;
        s_before = present ? s : -1.0;
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

    // Gain of sample i, for a stretch of alike samples where it moves slowly enough; the covariance goes beyond them.
    void gain(std::size_t i, std::size_t stop) {
        for (int k = 0; k < stretch_count; k++) {
            const std::size_t length = std::size_t{1} << stretches[k].doublings;
            if (slowly[k] < settled_samples || stop - i < length || even(i, i + length) < i + length)
                continue;
            Square<D> before;
            std::memcpy(before, P, sizeof before);
            covariance(i);
            if (jumps[k].r != r)
                jumps[k].prepare(in, r, stretches[k].doublings);
            std::memcpy(P, before, sizeof P);
            jumps[k].over(P);
            since = static_cast<double>(length);
            held = i + length;
            return;
        }
        covariance(i);
        held = i + 1;
    }

    void keep(std::size_t i) {
        Gain<D> now{i, {}, scale};
        std::memcpy(now.FK, FK, sizeof FK);
        gains->push_back(now);
    }

    // X := F X + FK e
    template <class T> void step(T (&X)[D], const T &e) const {
        constexpr int paired = PLAIN ? D : D % 2; // the first state in a pair
#pragma GCC unroll 24
        for (int a = 0; a < paired; a++)
            X[a] = on[a] * X[a] + FK[a] * e;
#pragma GCC unroll 24
        for (int a = paired; a + 1 < D; a += 2) {
            const T first = X[a];
            X[a] = on[a] * first + above[a] * X[a + 1] + FK[a] * e;
            X[a + 1] = below[a + 1] * first + on[a + 1] * X[a + 1] + FK[a + 1] * e;
        }
    }

    // e := value - h X
    template <class T> void innovation(const T &value, const T (&X)[D], T &e) const {
        T sum[4] = {value};
#pragma GCC unroll 24
        for (int a = 0; a < D; a++)
            sum[a % 4] -= h[a] * X[a];
        e = (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }

    // No denormals: they cost a hundred times as much.
    static double plain(double value) { return std::fabs(value) < 1e-250 ? 0.0 : value; }

    // One sample. A missing reading is 0 and moves nothing, since its gain is 0.
    void one(std::size_t i) {
        const bool present = std::isfinite(in.y[i]);
        double e[columns_max];
        for (int k = 0; k < in.columns; k++) {
            const double value = k == 0 && !present ? 0.0 : column(k)[i];
            innovation(value, x[k], e[k]);
            step(x[k], e[k]);
            for (int a = 0; a < D; a++)
                x[k][a] = plain(x[k][a]);
            e[k] *= scale;
        }
        if (out.white != nullptr)
            for (int k = 0; k < in.columns; k++)
                out.white[i * in.columns + k] = present ? e[k] : std::nan("");
        if (present)
            for (int a = 0; a < in.columns; a++)
                for (int b = 0; b <= a; b++)
                    G[a][b] += e[a] * e[b];
    }

    // How a state at the start of a piece of `length` samples acts on it, with M = F - FK h: left[i] = -h M^i on nu of
    // sample i, over = M^length on the state at the end.
    void join(std::size_t length) {
        joined = length;
        double row[D];
        Square<D> power, next;
        for (int a = 0; a < D; a++) {
            row[a] = -h[a] * scale;
            for (int b = 0; b < D; b++) {
                power[a][b] = in.F[a * D + b] - FK[a] * h[b];
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
                row[a] = plain(on[a] * here + (a > 0 ? above[a - 1] : 0.0) * last + after - along * h[a]);
                last = here;
            }
        }
        for (std::size_t bits = length; bits != 0; bits >>= 1) {
            if ((bits & 1) != 0) {
                product<D>(power, over, next);
                std::memcpy(over, next, sizeof over);
            }
            if (bits > 1) {
                product<D>(power, power, next);
                std::memcpy(power, next, sizeof power);
            }
        }
    }

    // The samples from `from` on, `lanes` pieces of `length`, all with one gain. Each piece begins with a state of 0.
    // Its true one is known when the piece before has ended, and acts by superposition.
    void many(std::size_t from, std::size_t length) {
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
                step(X[g], e);
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
    void advance(std::size_t from, std::size_t to) {
        while (to - from >= lanes * piece_least) {
            const std::size_t length = std::min(piece_most, (to - from) / lanes);
            many(from, length);
            from += lanes * length;
        }
        for (; from < to; from++)
            one(from);
    }

    void leave(std::size_t mark) const {
        for (int a = 0; a < in.columns; a++)
            for (int b = 0; b < in.columns; b++)
                out.G[(mark * in.columns + a) * in.columns + b] = a >= b ? G[a][b] : G[b][a];
        for (int k = 0; k < in.columns; k++)
            for (int a = 0; a < D; a++)
                out.x[(mark * in.columns + k) * D + a] = x[k][a];
        out.D[mark] = ln_s;
        out.counted[mark] = static_cast<double>(counted);
    }

    void run() {
        std::size_t mark = 0, i = 0;
        for (;;) {
            while (mark < in.mark_count && in.marks[mark] == i)
                leave(mark++);
            if (i == in.n)
                return;
            const bool present = std::isfinite(in.y[i]);
            const std::size_t stop = mark < in.mark_count ? in.marks[mark] : in.n;
            if (quiet >= settled_samples && alike(i))
                held = even(i, stop);
            else {
                gain(i, stop);
                if (gains != nullptr)
                    keep(i);
            }
            if (in.driver >= 0 && held < in.n)
                P[in.driver][in.driver] += in.Q[in.driver * D + in.driver] * (in.r[held] - in.r[i]);
            advance(i, held);
            if (out.s != nullptr)
                for (std::size_t j = i; j < held; j++)
                    out.s[j] = s;
            if (present) {
                ln_s += ln_now * static_cast<double>(held - i);
                counted += held - i;
            }
            i = held;
        }
    }
};

// The filter of `states` states.
template <int D> void filter(std::size_t states, bool diagonal, const Input &in, const Sums &out) {
    if (states == D && diagonal)
        std::make_unique<Filter<D, true>>(in, out)->run();
    else if (states == D)
        std::make_unique<Filter<D, false>>(in, out)->run();
    else if constexpr (D < states_max)
        filter<D + 1>(states, diagonal, in, out);
}

// A shift of the level that begins at sample k and stays, at every k, by one pass backwards over the filter's gains
// (de Jong & Penzer 1998, JASA 93, 796). The shift is one state more, which F keeps and the filter does not know: with
// h = [h, 1], g = [F K, 0] and L = F - g h' the innovations that it makes are h' L ... L e. Gaps, changes of the noise
// and a covariance that has not settled are in the gains.
struct Shifts {
    double *A;       // [n] information: the sum of the squares of these innovations, whitened
    double *B;       // [n, columns] their products with the whitened innovations of the record and of each column
    double *impulse; // [n] the information of a single shifted sample
};

template <int D> struct Backward {
    static constexpr int E = D + 1;
    const Filter<D, false> &filter;
    double h[E], below[E], on[E], above[E], N[E][E] = {}, R[columns_max][E] = {};
    bool steady = false; // N stays as long as the gain does

    explicit Backward(const Filter<D, false> &passed) : filter(passed) {
        for (int a = 0; a < E; a++) {
            h[a] = a < D ? filter.h[a] : 1.0;
            below[a] = a < D ? filter.below[a] : 0.0;
            on[a] = a < D ? filter.on[a] : 1.0;
            above[a] = a < D ? filter.above[a] : 0.0;
        }
    }

    // x := F' x
    void transposed(double (&x)[E]) const {
        double left = 0.0;
        for (int a = 0; a < E; a++) {
            const double here = x[a], right = a < D ? below[a + 1] * x[a + 1] : 0.0;
            x[a] = (a > 0 ? above[a - 1] * left : 0.0) + on[a] * here + right;
            left = here;
        }
    }

    // N := h h' / s + L' N L
    void information(const double (&g)[E], double energy) {
        double M[E][E], change = 0.0, most = 0.0;
        for (int a = 0; a < E; a++) {
            double Ng = 0.0;
            for (int b = 0; b < E; b++)
                Ng += N[a][b] * g[b];
            std::memcpy(M[a], N[a], sizeof M[a]);
            transposed(M[a]);
            for (int b = 0; b < E; b++)
                M[a][b] -= Ng * h[b];
        }
        for (int b = 0; b < E; b++) {
            double column[E], gM = 0.0;
            for (int a = 0; a < E; a++) {
                column[a] = M[a][b];
                gM += g[a] * M[a][b];
            }
            transposed(column);
            for (int a = 0; a <= b; a++) {
                const double next = column[a] + h[a] * (energy * h[b] - gM);
                change = std::max(change, std::fabs(next - N[a][b]));
                most = std::max(most, std::fabs(next));
                N[a][b] = N[b][a] = next;
            }
        }
        steady = change <= 1e-15 * most;
    }

    void run(const std::vector<Gain<D>> &gains, const Shifts &out) {
        const Input &in = filter.in;
        std::size_t end = in.n;
        for (std::size_t k = gains.size(); k-- > 0; end = gains[k].start) {
            double g[E] = {};
            std::memcpy(g, gains[k].FK, sizeof gains[k].FK);
            steady = false;
            for (std::size_t i = end; i-- > gains[k].start;) {
                const bool present = std::isfinite(in.y[i]);
                const double scale = present ? gains[k].scale : 0.0;
                double single = scale * scale; // by the gain's effect on later readings
                for (int a = 0; a < D; a++)
                    for (int b = 0; b < D; b++)
                        single += g[a] * N[a][b] * g[b];
                if (!steady)
                    information(g, scale * scale);
                for (int c = 0; c < in.columns; c++) {
                    double gR = present ? -scale * filter.out.white[i * in.columns + c] : 0.0;
                    for (int a = 0; a < D; a++)
                        gR += g[a] * R[c][a];
                    transposed(R[c]);
                    for (int a = 0; a < E; a++) {
                        R[c][a] -= gR * h[a];
                        R[c][a] = std::fabs(R[c][a]) < 1e-250 ? 0.0 : R[c][a];
                    }
                    out.B[i * in.columns + c] = R[c][D];
                }
                out.A[i] = N[D][D];
                out.impulse[i] = present ? single : 0.0;
            }
        }
    }
};

template <int D> void shifted(std::size_t states, const Input &in, const Sums &out, const Shifts &shifts) {
    if (states == D) {
        std::vector<Gain<D>> gains;
        const auto filter = std::make_unique<Filter<D, false>>(in, out, &gains);
        filter->run();
        Backward<D>(*filter).run(gains, shifts);
    } else if constexpr (D < states_max)
        shifted<D + 1>(states, in, out, shifts);
}

double *fresh(std::size_t size) { return new double[size > 0 ? size : 1]; }

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
              const Matrix &P0, double R, int driver, const std::vector<std::size_t> &marks, bool innovations) {
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
    const Input in{y.data(), z.data(),  r.data(), n, c,           F.data(), Q.data(),
                   h.data(), P0.data(), R,        driver, marks.data(), m};
    {
        nb::gil_scoped_release released;
        filter<1>(d, diagonal, in, out);
    }
    return nb::make_tuple(G, D, counted, x, white, s);
}

nb::tuple shifts(const Vector &y, const Matrix &z, const Vector &r, const Matrix &F, const Matrix &Q, const Vector &h,
                 const Matrix &P0, double R, int driver) {
    check(y, z, r, F, Q, h, P0, driver);
    const std::size_t n = y.shape(0), d = h.shape(0), c = z.shape(0) + 1;
    std::vector<double> D(1), counted(1), x(c * d), white(n * c);
    const std::size_t end = n;
    Out G = array(fresh(c * c), {c, c}), A = array(fresh(n), {n}), B = array(fresh(n * c), {n, c});
    Out impulse = array(fresh(n), {n});
    const Sums out{G.data(), D.data(), counted.data(), x.data(), white.data(), nullptr};
    const Shifts made{A.data(), B.data(), impulse.data()};
    const Input in{y.data(), z.data(),  r.data(), n, static_cast<int>(c), F.data(), Q.data(),
                   h.data(), P0.data(), R,        driver, &end, 1};
    {
        nb::gil_scoped_release released;
        shifted<1>(d, in, out, made);
    }
    return nb::make_tuple(G, D[0], A, B, impulse);
}

} // namespace

NB_MODULE(_likelihood, m) {
    using namespace nb::literals;
    m.def("run", &run, "y"_a, "z"_a, "r"_a, "F"_a, "Q"_a, "h"_a, "P0"_a, "R"_a, "driver"_a, "marks"_a, "innovations"_a);
    m.def("shifts", &shifts, "y"_a, "z"_a, "r"_a, "F"_a, "Q"_a, "h"_a, "P0"_a, "R"_a, "driver"_a);
    m.attr("STATES_MAX") = states_max;
    m.attr("COLUMNS_MAX") = columns_max;
}
