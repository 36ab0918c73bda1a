#include "textbook_bank.hpp"

#include "parallel.hpp"

#include <cmath>
#include <limits>

namespace selfcal_reference {

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double ln_2pi = 1.8378770664093454836;
constexpr double pi = 3.14159265358979323846;

// x_i as a linear system: state' = transition state + noise of covariance `step`, `start` that of the state at the instant
// before the first sample, `output` what of it is read, `level` what of that is drift.
struct Drift {
    Eigen::MatrixXd transition, step, start;
    Eigen::RowVectorXd output, level;
    double white;            // variance of the white noise beside it
    double innovation = 0.0; // of the state 1, times r_i, in place of that: variance of a moving average's e_i
};

Drift drift_of(const Node &node, double dt_s) {
    const auto n = static_cast<Eigen::Index>(order(node.law));
    Drift drift;
    drift.transition = Eigen::MatrixXd::Identity(n, n);
    drift.step = drift.start = Eigen::MatrixXd::Zero(n, n);
    drift.output = drift.level = Eigen::RowVectorXd::Ones(n);
    drift.white = node.sigma_v * node.sigma_v;
    const auto random_walk = [&](Eigen::Index i, double density) { drift.step(i, i) = density * density * dt_s; }; // (23), x_0 = 0
    const auto gauss_markov = [&](Eigen::Index i, double deviation, double alpha) { // stationary from the start
        drift.transition(i, i) = std::exp(-alpha * dt_s);
        drift.start(i, i) = deviation * deviation;
        drift.step(i, i) = -deviation * deviation * std::expm1(-2.0 * alpha * dt_s);
    };
    double theta = 0.0;
    switch (node.law) {
    case Law::constant:
        break;
    case Law::random_walk:
        random_walk(0, node.drift);
        break;
    case Law::gauss_markov:
        gauss_markov(0, node.drift, node.alpha);
        break;
    case Law::flicker:
        for (Eigen::Index i = 0; i < n; ++i) {
            gauss_markov(i, node.drift * std::sqrt(std::log(10.0) / pi), node.alpha * std::pow(10.0, static_cast<double>(i - 1)));
        }
        break;
    case Law::moving_average:
        random_walk(0, node.drift);
        drift.transition.bottomRightCorner(2, 2) << 0.0, 0.0, 1.0, 0.0; // e_i is new, e_(i-1) was e_i
        drift.start(1, 1) = drift.innovation = drift.white;
        theta = (node.alpha - 1.0) / (node.alpha + 1.0);
        drift.output << 1.0, 1.0 / (1.0 + theta), theta / (1.0 + theta);
        drift.level << 1.0, 0.0, 0.0;
        drift.white = 0.0;
        break;
    case Law::walk_and_markov:
        gauss_markov(0, node.drift, node.alpha);
        random_walk(1, node.walk);
        break;
    }
    return drift;
}

// Model (1), (2) at one node, and the Kalman filter over it. The state [drift; x0; c] has `size` elements.
template <int size> class Filter {
    static constexpr int most = size == Eigen::Dynamic ? static_cast<int>(order_max + 1 + regressors_max) : size;
    using Vector = Eigen::Matrix<double, size, 1, 0, most, 1>;
    using Row = Eigen::Matrix<double, 1, size, Eigen::RowMajor, 1, most>;
    using Square = Eigen::Matrix<double, size, size, 0, most, most>;

  public:
    Filter(const Record &record, const Node &node) : record_(record) {
        const Drift drift = drift_of(node, record.dt_s);
        const Eigen::Index bias = drift.output.size();
        const Eigen::Index n = bias + 1 + static_cast<Eigen::Index>(record.regressors);
        r_ = drift.white;
        innovation_ = drift.innovation;
        transition_ = Square::Identity(n, n);
        transition_.topLeftCorner(bias, bias) = drift.transition;
        step_ = Square::Zero(n, n);
        step_.topLeftCorner(bias, bias) = drift.step;
        mean_ = Vector::Zero(n);
        mean_(bias) = record.bias_mean;
        covariance_ = Square::Zero(n, n);
        covariance_.topLeftCorner(bias, bias) = drift.start;
        covariance_(bias, bias) = record.bias_sd * record.bias_sd;
        h_ = Row::Zero(n);
        h_.head(bias) = drift.output;
        h_(bias) = 1.0;
        now_ = h_;
        now_.head(bias) = drift.level;
        for (std::size_t k = 0; k < record.regressors; ++k) {
            const Eigen::Index at = bias + 1 + static_cast<Eigen::Index>(k);
            covariance_(at, at) = record.coefficient_sd[k] * record.coefficient_sd[k];
        }
    }

    // Sample i of the record. Returns nu / sqrt(s), NaN where it is missing.
    double sample(std::size_t i) {
        const bool missing = std::isnan(record_.y[i]);
        const double r = record_.r == nullptr || missing ? 1.0 : record_.r[i];
        if (innovation_ > 0.0) {
            step_(1, 1) = r * innovation_;
        }
        predict();
        if (missing) {
            return nan;
        }
        const Eigen::Index first = h_.size() - static_cast<Eigen::Index>(record_.regressors);
        for (std::size_t k = 0; k < record_.regressors; ++k) {
            const Eigen::Index at = first + static_cast<Eigen::Index>(k);
            h_(at) = now_(at) = record_.z[i * record_.regressors + k];
        }
        return update(record_.y[i], r);
    }

    Filtered state() const { return {ln_p_, mean_, covariance_, now_ * mean_, now_ * covariance_ * now_.transpose()}; }

  private:
    void predict() {
        mean_ = transition_ * mean_;
        covariance_ = transition_ * covariance_ * transition_.transpose() + step_;
    }

    // Adds ln N(nu; 0, s), the factor of (11), to ln_p.
    double update(double y, double r) {
        const double variance_v = r * r_;
        const double nu = y - h_ * mean_;
        const double s = h_ * covariance_ * h_.transpose() + variance_v;
        const Vector gain = covariance_ * h_.transpose() / s;
        const Square rest = Square::Identity(mean_.size(), mean_.size()) - gain * h_;
        mean_ += gain * nu;
        covariance_ = rest * covariance_ * rest.transpose() + gain * variance_v * gain.transpose();
        ln_p_ -= 0.5 * (ln_2pi + std::log(s) + nu * nu / s);
        return nu / std::sqrt(s);
    }

    const Record &record_;
    double r_, innovation_;
    double ln_p_ = 0.0;
    Square transition_, step_, covariance_;
    Vector mean_;
    Row h_, now_; // of the last sample: what is read, and the part of it that is not noise
};

// Calls use(filter). The compiler knows the size of a small state and writes its products out; larger states are few.
template <int size = 2, typename Use> void with_filter(const Record &record, const Node &node, const Use &use) {
    if (order(node.law) + 1 + record.regressors == size) {
        Filter<size> filter(record, node);
        use(filter);
    } else if constexpr (size < 5) {
        with_filter<size + 1>(record, node, use);
    } else {
        Filter<Eigen::Dynamic> filter(record, node);
        use(filter);
    }
}

// Equations (11) to (14) from the filters of one instant.
Posterior combine(const std::vector<Node> &nodes, const std::vector<double> &ln_prior,
                  const std::vector<Filtered> &filtered) {
    Posterior out;
    double highest = -std::numeric_limits<double>::infinity();
    for (std::size_t j = 0; j < nodes.size(); ++j) {
        highest = std::max(highest, ln_prior[j] + filtered[j].ln_p);
    }
    double sum = 0.0;
    out.weight.resize(nodes.size());
    for (std::size_t j = 0; j < nodes.size(); ++j) { // (11)
        out.weight[j] = std::exp(ln_prior[j] + filtered[j].ln_p - highest);
        sum += out.weight[j];
    }
    out.probability.fill(0.0);
    out.mean.fill(Eigen::Vector3d::Zero());
    out.covariance.fill(Eigen::Matrix3d::Zero());
    out.bias_mean.fill(0.0);
    out.bias_var.fill(0.0);
    const auto value = [&](std::size_t j) { return Eigen::Vector3d(nodes[j].drift, nodes[j].alpha, nodes[j].sigma_v); };
    for (std::size_t j = 0; j < nodes.size(); ++j) { // (12), (13), not yet over Pr(H = h_k | Y_i)
        const auto k = static_cast<std::size_t>(nodes[j].law);
        out.weight[j] /= sum;
        out.probability[k] += out.weight[j];
        out.mean[k] += out.weight[j] * value(j);
        out.bias_mean[k] += out.weight[j] * filtered[j].now_mean;
    }
    for (std::size_t k = 0; k < laws; ++k) {
        out.mean[k] /= out.probability[k];
        out.bias_mean[k] /= out.probability[k];
    }
    for (std::size_t j = 0; j < nodes.size(); ++j) { // (14), about the mean so that nothing cancels
        const auto k = static_cast<std::size_t>(nodes[j].law);
        const double mu = out.weight[j] / out.probability[k];
        const Eigen::Vector3d error = value(j) - out.mean[k];
        const double bias_error = filtered[j].now_mean - out.bias_mean[k];
        out.covariance[k] += mu * error * error.transpose();
        out.bias_var[k] += mu * (bias_error * bias_error + filtered[j].now_var);
    }
    for (std::size_t k = 0; k < laws; ++k) {
        if (out.probability[k] == 0.0) {
            out.covariance[k].setConstant(nan);
            out.bias_var[k] = nan;
        }
    }
    return out;
}

} // namespace

std::size_t order(Law law) {
    switch (law) {
    case Law::flicker:
    case Law::moving_average:
        return 3;
    case Law::walk_and_markov:
        return 2;
    default:
        return 1;
    }
}

Filtered run_filter(const Record &record, const Node &node, double *standardized) {
    Filtered out;
    with_filter(record, node, [&](auto &filter) {
        for (std::size_t i = 0; i < record.n; ++i) {
            const double innovation = filter.sample(i);
            if (standardized != nullptr) {
                standardized[i] = innovation;
            }
        }
        out = filter.state();
    });
    return out;
}

std::vector<Filtered> run_filters(const Record &record, const std::vector<Node> &nodes) {
    std::vector<Filtered> out(nodes.size());
    parallel_for(nodes.size(), [&](std::size_t j) { out[j] = run_filter(record, nodes[j]); });
    return out;
}

std::vector<Posterior> run_bank(const Record &record, const std::vector<Node> &nodes,
                                const std::vector<double> &ln_prior, const std::vector<std::size_t> &after) {
    // (11) is recursive; its normalisation cancels between instants, so each filter runs through alone and the weights
    // are normalised where they are wanted.
    std::vector<std::vector<Filtered>> at(after.size(), std::vector<Filtered>(nodes.size()));
    parallel_for(nodes.size(), [&](std::size_t j) {
        with_filter(record, nodes[j], [&](auto &filter) {
            std::size_t i = 0;
            for (std::size_t m = 0; m < after.size(); ++m) {
                for (; i < after[m]; ++i) {
                    filter.sample(i);
                }
                at[m][j] = filter.state();
            }
        });
    });
    std::vector<Posterior> out;
    out.reserve(at.size());
    for (const std::vector<Filtered> &filtered : at) {
        out.push_back(combine(nodes, ln_prior, filtered));
    }
    return out;
}

} // namespace selfcal_reference
