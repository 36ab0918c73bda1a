#include "textbook_bank.hpp"

#include "parallel.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace selfcal_reference {

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double ln_2pi = 1.8378770664093454836;

// x_i as a linear system: state' = transition state + noise of covariance `step`. `start` is the covariance of the
// state at the instant before the first sample. The reading has `output` times the state, the drift `level` times it.
struct Drift {
    Eigen::MatrixXd transition, step, start;
    Eigen::RowVectorXd output, level;
    double white;            // variance of the white noise beside it
    double innovation = 0.0; // variance of e_i over r_i, the last state but one, in place of that
    double scatter = 0.0;    // over r_i - 1: variance that a mean has about the block's where readings are lost
};

// A term at the last of `block` samples, and its mean over them, from the term before: sample by sample.
struct Block {
    double phi, mean;                // of the term, of its mean
    double var, covariance, of_mean; // of the noise in either
    double scatter;                  // variance of m readings drawn from the block about its mean, over M/m - 1
};

Block block_of(double phi, double step, std::size_t block) {
    Block sum{1.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    // Without replacement the mean of m has the variance (M/m - 1) s^2/M about the mean of all, with s^2 the mean over
    // pairs of half of their squared difference.
    double apart = 0.0, reach = 1.0;
    for (std::size_t lag = 1; lag < block; ++lag) {
        apart = phi * phi * apart + step;
        reach *= phi;
        const double left = (1.0 - reach) * (1.0 - reach) * (phi < 1.0 ? step / (1.0 - phi * phi) : 0.0);
        sum.scatter += static_cast<double>(block - lag) * 0.5 * (apart + left);
    }
    for (std::size_t k = 0; k < block; ++k) {
        sum.phi *= phi;
        sum.var = phi * phi * sum.var + step;
        sum.of_mean += 2.0 * phi * sum.covariance + sum.var;
        sum.covariance = phi * sum.covariance + sum.var;
        sum.mean += sum.phi;
    }
    const auto m = static_cast<double>(block);
    const double pairs = std::max(m * (m - 1.0) / 2.0, 1.0);
    return {sum.phi, sum.mean / m, sum.var, sum.covariance / m, sum.of_mean / (m * m), sum.scatter / pairs / m};
}

// An oscillation at the states i, i + 1, and the mean of its reading over `block` samples.
void put_swing(Drift &drift, const Law &law, const Node &node, Eigen::Index i, double sample_s, std::size_t block) {
    const Term &term = law.terms[static_cast<std::size_t>(i)];
    const double sd = deviation(law, term, node.drift, node.second);
    const Eigen::Matrix2d F = swing(term, law.terms[static_cast<std::size_t>(i) + 1], sample_s);
    const Eigen::Matrix2d all = sd * sd * Eigen::Matrix2d::Identity(), Q = all - F * F.transpose() * sd * sd;
    Eigen::Matrix2d over = Eigen::Matrix2d::Identity(), noise = Eigen::Matrix2d::Zero();
    Eigen::RowVector2d sum = Eigen::RowVector2d::Zero(), both = sum;
    double of_sum = 0.0;
    for (std::size_t k = 0; k < block; ++k) {
        over = F * over;
        noise = F * noise * F.transpose() + Q;
        both = both * F.transpose();
        of_sum += 2.0 * both(0) + noise(0, 0);
        both += noise.row(0);
        sum += over.row(0);
    }
    const auto m = static_cast<double>(block);
    drift.transition.block<2, 2>(i, i) = over;
    drift.step.block<2, 2>(i, i) = noise;
    drift.start.block<2, 2>(i, i) = all;
    drift.output(i + 1) = drift.level(i + 1) = 0.0;
    if (block > 1) {
        const Eigen::Index mean = i + static_cast<Eigen::Index>(law.terms.size());
        drift.transition.block<2, 2>(mean, mean).setZero();
        drift.transition.block<1, 2>(mean, i) = sum / m;
        drift.step.block<1, 2>(mean, i) = both / m;
        drift.step.block<2, 1>(i, mean) = both.transpose() / m;
        drift.step(mean, mean) = of_sum / (m * m);
        drift.output(i) = drift.output(mean + 1) = drift.level(mean) = drift.level(mean + 1) = 0.0;
    }
}

Drift drift_of(const Law &law, const Node &node, double dt_s, std::size_t block) {
    const auto n = static_cast<Eigen::Index>(order(law, block));
    const auto m = static_cast<double>(block);
    const double sample_s = dt_s / m;
    Drift drift;
    drift.transition = Eigen::MatrixXd::Identity(n, n);
    drift.step = drift.start = Eigen::MatrixXd::Zero(n, n);
    drift.output = drift.level = Eigen::RowVectorXd::Ones(n);
    drift.white = node.sigma_v * node.sigma_v;
    Eigen::Index i = 0;
    for (const Term &term : law.terms) {
        double phi = 1.0, step = 0.0;
        if (term.kind == Kind::damping) { // the oscillation before has put its state
            ++i;
            continue;
        }
        if (term.kind == Kind::oscillation) {
            put_swing(drift, law, node, i, sample_s, block);
            ++i;
            continue;
        }
        if (term.kind == Kind::walk) { // (23), x_0 = 0
            const double density = term.deviation * node.drift;
            step = density * density * sample_s;
            drift.start(i, i) = step * (m - 1.0) / 2.0;
        } else { // stationary from the start
            const double alpha = bandwidth(term, node.second), sigma = deviation(law, term, node.drift, node.second);
            phi = std::exp(-alpha * sample_s);
            drift.start(i, i) = sigma * sigma;
            step = -sigma * sigma * std::expm1(-2.0 * alpha * sample_s);
        }
        const Block over = block_of(phi, step, block);
        drift.transition(i, i) = over.phi;
        drift.step(i, i) = over.var;
        drift.scatter += over.scatter;
        if (block > 1) {
            const Eigen::Index mean = i + static_cast<Eigen::Index>(law.terms.size());
            drift.transition(mean, mean) = 0.0;
            drift.transition(mean, i) = over.mean;
            drift.step(mean, i) = drift.step(i, mean) = over.covariance;
            drift.step(mean, mean) = over.of_mean;
            drift.output(i) = drift.level(mean) = 0.0;
        }
        ++i;
    }
    i = n - 2; // of e_i
    if (law.coloured_noise) {
        const double theta = (node.second - 1.0) / (node.second + 1.0);
        drift.transition.bottomRightCorner(2, 2) << 0.0, 0.0, 1.0, 0.0; // e_i is new, e_(i-1) was e_i
        drift.start(i, i) = drift.innovation = drift.white;
        drift.output.tail(2) << 1.0 / (1.0 + theta), theta / (1.0 + theta);
        drift.level.tail(2).setZero();
        drift.white = 0.0;
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
    Filter(const Record &record, const Law &law, const Node &node) : record_(record) {
        const Drift drift = drift_of(law, node, record.dt_s, record.block);
        const Eigen::Index bias = drift.output.size();
        const Eigen::Index n = bias + 1 + static_cast<Eigen::Index>(record.regressors);
        r_ = drift.white;
        scatter_ = drift.scatter;
        innovation_ = drift.innovation;
        new_ = bias - 2;
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
            step_(new_, new_) = r * innovation_;
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
        const double variance_v = r * r_ + (r - 1.0) * scatter_;
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
    double r_, innovation_, scatter_;
    Eigen::Index new_; // place of e_i, if there is one
    double ln_p_ = 0.0;
    Square transition_, step_, covariance_;
    Vector mean_;
    Row h_, now_; // of the last sample: what is read, and the part of it that is not noise
};

// Calls use(filter). The compiler knows the size of a small state and writes its products out; larger states are few.
template <int size = 2, typename Use>
void with_filter(const Record &record, const Law &law, const Node &node, const Use &use) {
    if (order(law, record.block) + 1 + record.regressors == size) {
        Filter<size> filter(record, law, node);
        use(filter);
    } else if constexpr (size < 5) {
        with_filter<size + 1>(record, law, node, use);
    } else {
        Filter<Eigen::Dynamic> filter(record, law, node);
        use(filter);
    }
}

// Equations (11) to (14) from the filters of one instant.
Posterior combine(std::size_t laws, const std::vector<Node> &nodes, const std::vector<double> &ln_prior,
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
    out.probability.assign(laws, 0.0);
    out.mean.assign(laws, Eigen::Vector3d::Zero());
    out.covariance.assign(laws, Eigen::Matrix3d::Zero());
    out.bias_mean.assign(laws, 0.0);
    out.bias_var.assign(laws, 0.0);
    const auto value = [&](std::size_t j) {
        return Eigen::Vector3d(nodes[j].drift, nodes[j].second, nodes[j].sigma_v);
    };
    for (std::size_t j = 0; j < nodes.size(); ++j) { // (12), (13), not yet over Pr(H = h_k | Y_i)
        const auto k = nodes[j].hypothesis;
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
        const auto k = nodes[j].hypothesis;
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

double bandwidth(const Term &term, double second) {
    return term.stated ? term.bandwidth : term.bandwidth * second;
}

double deviation(const Law &law, const Term &term, double drift, double second) {
    const double own = term.deviation * drift * (term.by_ratio ? second : 1.0);
    const auto walks = [](const Term &other) { return other.kind == Kind::walk; };
    const bool beside_walk = std::any_of(law.terms.begin(), law.terms.end(), walks);
    return beside_walk ? own / std::sqrt(bandwidth(term, second)) : own;
}

Eigen::Matrix2d swing(const Term &oscillation, const Term &damping, double time_s) { // the matrix's exponential
    const double w = oscillation.bandwidth;
    Eigen::Matrix2d rate, term = Eigen::Matrix2d::Identity(), sum = term;
    rate << 0.0, w, -w, -2.0 * damping.bandwidth;
    for (int k = 1; k < 40; ++k) { // turns by less than 1
        term = term * rate * (time_s / k);
        sum += term;
    }
    return sum;
}

std::size_t order(const Law &law, std::size_t block) {
    const std::size_t of_terms = (block > 1 ? 2 : 1) * law.terms.size();
    return std::max<std::size_t>(1, of_terms + (law.coloured_noise ? 2 : 0));
}

Filtered run_filter(const Record &record, const Law &law, const Node &node, double *standardized) {
    Filtered out;
    with_filter(record, law, node, [&](auto &filter) {
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

std::vector<Filtered> run_filters(const Record &record, const std::vector<Law> &laws, const std::vector<Node> &nodes) {
    std::vector<Filtered> out(nodes.size());
    parallel_for(nodes.size(),
                 [&](std::size_t j) { out[j] = run_filter(record, laws[nodes[j].hypothesis], nodes[j]); });
    return out;
}

std::vector<Posterior> run_bank(const Record &record, const std::vector<Law> &laws, const std::vector<Node> &nodes,
                                const std::vector<double> &ln_prior, const std::vector<std::size_t> &after) {
    // (11) is recursive; its normalisation cancels between instants, so each filter runs through alone and the weights
    // are normalised where they are wanted.
    std::vector<std::vector<Filtered>> at(after.size(), std::vector<Filtered>(nodes.size()));
    parallel_for(nodes.size(), [&](std::size_t j) {
        with_filter(record, laws[nodes[j].hypothesis], nodes[j], [&](auto &filter) {
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
        out.push_back(combine(laws.size(), nodes, ln_prior, filtered));
    }
    return out;
}

} // namespace selfcal_reference
