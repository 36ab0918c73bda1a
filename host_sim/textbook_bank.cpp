#include "textbook_bank.hpp"

#include "parallel.hpp"

#include <cmath>
#include <limits>

namespace selfcal_reference {

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double ln_2pi = 1.8378770664093454836;

// Model (1), (2) at one node, and the Kalman filter over it.
class Filter {
  public:
    Filter(const Record &record, const Node &node) : r_(node.sigma_v * node.sigma_v) {
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
        transition_ << phi, 0.0, 0.0, 1.0;
        step_ << step_variance, 0.0, 0.0, 0.0;
        state_.ln_p = 0.0;
        state_.mean << 0.0, record.bias_mean;
        state_.covariance << drift_variance, 0.0, 0.0, record.bias_sd * record.bias_sd;
    }

    void predict() {
        state_.mean = transition_ * state_.mean;
        state_.covariance = transition_ * state_.covariance * transition_.transpose() + step_;
    }

    // Returns nu / sqrt(s). Adds ln N(nu; 0, s), the factor of (11), to ln_p.
    double update(double y, double r) {
        const Eigen::RowVector2d h(1.0, 1.0);
        const double variance_v = r * r_;
        const double nu = y - h * state_.mean;
        const double s = h * state_.covariance * h.transpose() + variance_v;
        const Eigen::Vector2d gain = state_.covariance * h.transpose() / s;
        const Eigen::Matrix2d rest = Eigen::Matrix2d::Identity() - gain * h;
        state_.mean += gain * nu;
        state_.covariance = rest * state_.covariance * rest.transpose() + gain * variance_v * gain.transpose();
        state_.ln_p -= 0.5 * (ln_2pi + std::log(s) + nu * nu / s);
        return nu / std::sqrt(s);
    }

    double sample(double y, double r) {
        predict();
        return std::isnan(y) ? nan : update(y, r);
    }

    const Filtered &state() const { return state_; }

  private:
    double r_;
    Eigen::Matrix2d transition_, step_;
    Filtered state_;
};

double factor(const Record &record, std::size_t i) { return record.r == nullptr ? 1.0 : record.r[i]; }

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
        out.bias_mean[k] += out.weight[j] * filtered[j].mean.sum();
    }
    for (std::size_t k = 0; k < laws; ++k) {
        out.mean[k] /= out.probability[k];
        out.bias_mean[k] /= out.probability[k];
    }
    for (std::size_t j = 0; j < nodes.size(); ++j) { // (14), about the mean so that nothing cancels
        const auto k = static_cast<std::size_t>(nodes[j].law);
        const double mu = out.weight[j] / out.probability[k];
        const Eigen::Vector3d error = value(j) - out.mean[k];
        const double bias_error = filtered[j].mean.sum() - out.bias_mean[k];
        out.covariance[k] += mu * error * error.transpose();
        out.bias_var[k] += mu * (bias_error * bias_error + filtered[j].covariance.sum());
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
    Filter filter(record, node);
    for (std::size_t i = 0; i < record.n; ++i) {
        const double innovation = filter.sample(record.y[i], factor(record, i));
        if (standardized != nullptr) {
            standardized[i] = innovation;
        }
    }
    return filter.state();
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
        Filter filter(record, nodes[j]);
        std::size_t i = 0;
        for (std::size_t m = 0; m < after.size(); ++m) {
            for (; i < after[m]; ++i) {
                filter.sample(record.y[i], factor(record, i));
            }
            at[m][j] = filter.state();
        }
    });
    std::vector<Posterior> out;
    out.reserve(at.size());
    for (const std::vector<Filtered> &filtered : at) {
        out.push_back(combine(nodes, ln_prior, filtered));
    }
    return out;
}

} // namespace selfcal_reference
