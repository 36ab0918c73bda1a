// The Kalman filter of several axes, its smoother, and columns through it. selfcal/_joint.pyi describes the arrays.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <Eigen/Dense>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;

// The covariance has settled when a step changes it by less than this share.
constexpr double settled = 1e-7;
constexpr double missing = std::numeric_limits<double>::quiet_NaN();

Eigen::Map<const Rows> map(const Matrix &a) {
    return {a.data(), static_cast<Index>(a.shape(0)), static_cast<Index>(a.shape(1))};
}

// x(t + 1) = decay x(t) + noise, y = H x + white noise of covariance R; P0: covariance of x(0).
struct Model {
    VectorXd decay, noise;
    MatrixXd H, R, P0;
};

Model model_of(const Vector &decay, const Vector &noise, const Matrix &H, const Matrix &R, const Matrix &P0) {
    const std::size_t d = decay.shape(0), m = H.shape(0);
    if (noise.shape(0) != d || H.shape(1) != d || R.shape(0) != m || R.shape(1) != m || P0.shape(0) != d ||
        P0.shape(1) != d)
        throw std::invalid_argument("shapes do not fit");
    const auto size = static_cast<Index>(d);
    return {Eigen::Map<const VectorXd>(decay.data(), size), Eigen::Map<const VectorXd>(noise.data(), size), map(H),
            map(R), map(P0)};
}

// The filter at one sample: covariance before it, gain, the axes that are there with their rows of H, and the
// innovations' variances, inverse root and ln determinant.
struct Gain {
    std::vector<Index> there;
    MatrixXd P, h, K, inverse;
    VectorXd variances;
    double ln_det = 0.0;
};

using Gains = std::vector<std::shared_ptr<const Gain>>;

// Of each sample of y [m, n]. Samples without a gap share one gain once the covariance has settled.
Gains gains_of(const Model &model, const Eigen::Map<const Rows> &y) {
    const Index m = y.rows(), n = y.cols(), d = model.decay.size();
    Gains found(static_cast<std::size_t>(n));
    MatrixXd P = model.P0, next(d, d);
    std::shared_ptr<const Gain> steady;
    for (Index t = 0; t < n; t++) {
        auto now = std::make_shared<Gain>();
        for (Index i = 0; i < m; i++)
            if (std::isfinite(y(i, t)))
                now->there.push_back(i);
        const bool whole = static_cast<Index>(now->there.size()) == m;
        if (whole && steady) {
            found[static_cast<std::size_t>(t)] = steady;
            continue;
        }
        now->P = P;
        now->h = model.H(now->there, Eigen::all);
        const MatrixXd S = now->h * P * now->h.transpose() + model.R(now->there, now->there);
        const Eigen::LLT<MatrixXd> root(S);
        if (root.info() != Eigen::Success)
            throw std::domain_error("a covariance is not positive definite");
        now->inverse = MatrixXd::Identity(S.rows(), S.cols());
        root.matrixL().solveInPlace(now->inverse);
        now->K = P * now->h.transpose() * now->inverse.transpose() * now->inverse;
        now->variances = S.diagonal();
        now->ln_det = 2.0 * MatrixXd(root.matrixL()).diagonal().array().log().sum();
        next = (P - now->K * now->h * P).cwiseProduct(model.decay * model.decay.transpose());
        next.diagonal() += model.noise;
        next = (0.5 * (next + next.transpose())).eval();
        const double change = (next - P).cwiseAbs().maxCoeff();
        steady = whole && change < settled * next.diagonal().cwiseAbs().maxCoeff() ? now : nullptr;
        P = next;
        found[static_cast<std::size_t>(t)] = std::move(now);
    }
    return found;
}

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

    // Its last two axes, `k` blocks on.
    Eigen::Map<Rows> block(Index k = 0) const {
        const auto rows = static_cast<Index>(shape[shape.size() - 2]), columns = static_cast<Index>(shape.back());
        return {data + k * rows * columns, rows, columns};
    }
};

// Backwards r' = H' S^-1 v + L' r (de Jong, Biometrika 75, 1988): the score of a jump of each state. Its information N
// runs likewise (Harvey & Koopman, J. Bus. Econ. Stat. 10, 1992).
void smooth(const Model &model, const Gains &gains, const Rows &whitened, const Rows &predicted, const Array &states,
            const Array &weights, const Array &of_f, const Array &known) {
    const Index n = predicted.rows(), d = predicted.cols(), m = model.H.rows();
    VectorXd r = VectorXd::Zero(d);
    MatrixXd N = MatrixXd::Zero(d, d), L, back, own, next;
    bool constant = false;
    for (Index t = n - 1; t >= 0; t--) {
        const auto &gain = *gains[static_cast<std::size_t>(t)];
        const bool same = t + 1 < n && gains[static_cast<std::size_t>(t) + 1].get() == &gain;
        const auto there = static_cast<Index>(gain.there.size());
        if (!same) {
            back = (model.decay.asDiagonal() * gain.K).transpose();
            L = MatrixXd(model.decay.asDiagonal()) - back.transpose() * gain.h;
            own = gain.h.transpose() * gain.inverse.transpose() * gain.inverse * gain.h;
        }
        const VectorXd e = gain.inverse.transpose() * whitened.row(t).head(there).transpose();
        const VectorXd weight = e - back * r;
        for (Index i = 0; i < there; i++)
            weights.block()(t, gain.there[static_cast<std::size_t>(i)]) = weight(i);
        r = (gain.h.transpose() * e + L.transpose() * r).eval();
        if (!(constant && same)) {
            next = own + L.transpose() * N * L;
            constant = same && (next - N).cwiseAbs().maxCoeff() < settled * next.cwiseAbs().maxCoeff();
            N = next;
        }
        states.block().row(t) = predicted.row(t) + (gain.P * r).transpose();
        of_f.block().row(t) << r(0), N(0, 0);
        known.block(t) = N.block(1, 1, m, m);
    }
}

nb::tuple course(const Matrix &y, const Vector &decay, const Vector &noise, const Matrix &H, const Matrix &R,
                 const Matrix &P0, bool smoothed) {
    const Model model = model_of(decay, noise, H, R, P0);
    const std::size_t m = H.shape(0), n = y.shape(1), d = decay.shape(0), back = smoothed ? n : 0;
    if (y.shape(0) != m || m + 1 > d)
        throw std::invalid_argument("shapes do not fit");
    const auto record = map(y);
    const Array innovations({n, m}, missing), spread({n, m}, missing), predicted({n, d});
    const Array states({back, d}), weights({back, m}), of_f({back, 2}), known({back, m, m});
    double ln_likelihood = 0.0;
    {
        nb::gil_scoped_release released;
        const Gains gains = gains_of(model, record);
        Rows whitened = Rows::Zero(static_cast<Index>(n), static_cast<Index>(m));
        std::vector<bool> seen(m, false);
        std::size_t unseen = m;
        VectorXd x = VectorXd::Zero(static_cast<Index>(d));
        for (Index t = 0; t < record.cols(); t++) {
            const auto &gain = *gains[static_cast<std::size_t>(t)];
            const auto there = static_cast<Index>(gain.there.size());
            const VectorXd v = record(gain.there, t) - gain.h * x, u = gain.inverse * v;
            predicted.block().row(t) = x.transpose();
            whitened.row(t).head(there) = u.transpose();
            if (unseen == 0)
                ln_likelihood -= 0.5 * (u.squaredNorm() + gain.ln_det);
            for (Index i = 0; i < there; i++) {
                const Index axis = gain.there[static_cast<std::size_t>(i)];
                innovations.block()(t, axis) = v(i), spread.block()(t, axis) = gain.variances(i);
                if (!seen[static_cast<std::size_t>(axis)]) // the first reading of an axis sets its level
                    seen[static_cast<std::size_t>(axis)] = true, unseen--;
            }
            x = model.decay.cwiseProduct(x + gain.K * v);
        }
        if (smoothed)
            smooth(model, gains, whitened, predicted.block(), states, weights, of_f, known);
    }
    return nb::make_tuple(ln_likelihood, innovations.out(), spread.out(), predicted.out(), states.out(), weights.out(),
                          of_f.out(), known.out());
}

Out information(const Matrix &y, const Matrix &columns, const Vector &decay, const Vector &noise, const Matrix &H,
                const Matrix &R, const Matrix &P0) {
    const Model model = model_of(decay, noise, H, R, P0);
    if (y.shape(0) != H.shape(0) || columns.shape(1) != y.shape(1))
        throw std::invalid_argument("shapes do not fit");
    const auto record = map(y), column = map(columns);
    const Index m = record.rows(), k = column.rows();
    const Array total({columns.shape(0), y.shape(0), y.shape(0)});
    {
        nb::gil_scoped_release released;
        const Gains gains = gains_of(model, record);
        MatrixXd X = MatrixXd::Zero(model.decay.size(), k * m), V, W;
        for (Index t = 0; t < record.cols(); t++) {
            const auto &gain = *gains[static_cast<std::size_t>(t)];
            V = -gain.h * X;
            for (Index i = 0; i < V.rows(); i++)
                for (Index j = 0; j < k; j++)
                    V(i, j * m + gain.there[static_cast<std::size_t>(i)]) += column(j, t);
            W = gain.inverse * V;
            for (Index j = 0; j < k; j++)
                total.block(j).noalias() += W.middleCols(j * m, m).transpose() * W.middleCols(j * m, m);
            X = model.decay.asDiagonal() * (X + gain.K * V);
        }
    }
    return total.out();
}

} // namespace

NB_MODULE(_joint, module) {
    module.def("course", &course, nb::arg("y"), nb::arg("decay"), nb::arg("noise"), nb::arg("H"), nb::arg("R"),
               nb::arg("P0"), nb::arg("smoothed"));
    module.def("information", &information, nb::arg("y"), nb::arg("columns"), nb::arg("decay"), nb::arg("noise"),
               nb::arg("H"), nb::arg("R"), nb::arg("P0"));
}
