#include "textbook_bank.hpp"

#include "parallel.hpp"

#include <cmath>
#include <limits>

namespace selfcal_reference {

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double ln_2pi = 1.8378770664093454836;

// Model (1), (2) at one node, and the Kalman filter over it. `size` is that of the state [drift; x0; c].
template <int size> class Filter {
    static constexpr int most = size == Eigen::Dynamic ? static_cast<int>(2 + regressors_max) : size;
    using Vector = Eigen::Matrix<double, size, 1, 0, most, 1>;
    using Row = Eigen::Matrix<double, 1, size, Eigen::RowMajor, 1, most>;
    using Square = Eigen::Matrix<double, size, size, 0, most, most>;

  public:
    Filter(const Record &record, const Node &node) : record_(record), r_(node.sigma_v * node.sigma_v) {
        double phi = 1.0;
        double drift_variance = 0.0; // at the instant before the first sample
        double step_variance = 0.0;
        switch (node.law) {
        case Law::constant:
            break;
        case Law::random_walk: // (23), x_0 = 0
            step_variance = node.drift * node.drift * record.dt_s;
            break;
        case Law::gauss_markov: // stationary from the start
            phi = std::exp(-node.alpha * record.dt_s);
            drift_variance = node.drift * node.drift;
            step_variance = -drift_variance * std::expm1(-2.0 * node.alpha * record.dt_s);
            break;
        }
        const auto n = static_cast<Eigen::Index>(2 + record.regressors);
        transition_ = Square::Identity(n, n);
        transition_(0, 0) = phi;
        step_ = Square::Zero(n, n);
        step_(0, 0) = step_variance;
        mean_ = Vector::Zero(n);
        mean_(1) = record.bias_mean;
        covariance_ = Square::Zero(n, n);
        covariance_(0, 0) = drift_variance;
        covariance_(1, 1) = record.bias_sd * record.bias_sd;
        h_ = Row::Zero(n);
        h_(0) = h_(1) = 1.0;
        for (std::size_t k = 0; k < record.regressors; ++k) {
            const auto at = static_cast<Eigen::Index>(2 + k);
            covariance_(at, at) = record.coefficient_sd[k] * record.coefficient_sd[k];
        }
    }

    // Sample i of the record. Returns nu / sqrt(s), NaN where it is missing.
    double sample(std::size_t i) {
        predict();
        if (std::isnan(record_.y[i])) {
            return nan;
        }
        for (std::size_t k = 0; k < record_.regressors; ++k) {
            h_(static_cast<Eigen::Index>(2 + k)) = record_.z[i * record_.regressors + k];
        }
        return update(record_.y[i], record_.r == nullptr ? 1.0 : record_.r[i]);
    }

    Filtered state() const { return {ln_p_, mean_, covariance_, h_ * mean_, h_ * covariance_ * h_.transpose()}; }

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
    double r_;
    double ln_p_ = 0.0;
    Square transition_, step_, covariance_;
    Vector mean_;
    Row h_; // of the last sample
};

// Calls use(filter), with the state's size known to the compiler where nothing is added to the paper's.
template <typename Use> void with_filter(const Record &record, const Node &node, const Use &use) {
    if (record.regressors == 0) {
        Filter<2> filter(record, node);
        use(filter);
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
