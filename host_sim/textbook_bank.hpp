// The bank of Kalman filters as printed in Stepanov & Motorin, IFAC-PapersOnLine 50-1 (2017) 2830-2835: double
// precision, the bias a filter state, one full filter per node, a covariance at every step. It is what lib/ is measured
// against, so it takes none of lib/'s short cuts and shares no code with it. Equation numbers are the paper's.
//
// One axis, sampled every dt:  y_i = x0 + x_i + v_i  (22),  x0 ~ N(bias mean, P0),  v_i ~ N(0, r_i sigma_v^2).
// Known disturbances z (temperature, time, ...) enter as the paper's bias does: constant states with a row of H each.
// y_i = x0 + x_i + c' z_i + v_i,  c ~ N(0, diag(sd^2)).
// A reading may be the mean of `block` samples of the drift and of white noise (Record::block). The drift is then the
// state at the last of them, and its mean over them a second state, which is read. Where r_i is not 1 the block has
// block/r_i readings, those of a random part of it: their mean scatters about the block's.
// Two deviations from the print:
//   - the Gauss-Markov noise gain is the exact sigma_m sqrt(1 - phi^2); the printed one,
//     sigma_m sqrt(2 / (alpha dt)) (1 - phi), is (alpha dt)^2 / 24 off it, relatively;
//   - the covariance update has Joseph's form: algebraically the same, and P0 >> sigma_v^2 does not cancel in it.
#pragma once

// The matrices have 2 to 10 rows. Vector instructions slow them down: what one stores whole is read in parts.
#define EIGEN_DONT_VECTORIZE
#include <Eigen/Core>

#include <cstddef>
#include <vector>

namespace selfcal_reference {

// The law of x_i: a sum of terms, each a random walk, a Gauss-Markov process or an oscillator, with the
// drift parameter d (K, sigma_m or B) of the node. The paper's laws have one term or none; its filter takes any linear
// law.
//   walk:   x_i = x_(i-1) + deviation d sqrt(dt) w_i
//   markov: its standard deviation is deviation d, its bandwidth `bandwidth` times the node's alpha (if stated: 1/s).
//           Beside a walk, where d is a K, its standard deviation is deviation d / sqrt(bandwidth).
//   oscillation, then damping: x'' + 2 rate x' + w^2 x = white noise, of two states, x and x'/w. `bandwidth` of the
//           first is w, of the second the rate. Its standard deviation is that of a Gauss-Markov term of bandwidth w.
//   by_ratio: the node's second parameter multiplies the deviation.
// Coloured noise: (e_i + theta e_(i-1)) / (1 + theta) instead of v_i, e_i ~ N(0, r_i sigma_v^2), r = 1 where a sample
// is missing. The second parameter is (1 + theta) / (1 - theta): the spectrum's amplitude at 0 Hz over its amplitude at
// 1/(2 dt).
enum class Kind { walk, markov, oscillation, damping }; // as selfcal_term_kind_t
struct Term {
    Kind kind = Kind::walk;
    double deviation = 1.0;
    double bandwidth = 1.0;
    bool stated = false;
    bool by_ratio = false;
};
struct Law {
    std::vector<Term> terms;
    bool coloured_noise = false;
};
constexpr std::size_t terms_max = 3;
constexpr std::size_t order_max = 8; // states of x_i: its terms, their means, and e_i, e_(i-1) of coloured noise
constexpr std::size_t regressors_max = 6;

// Of a term at one value of the law's parameters: bandwidth, 1/s, and standard deviation of a Gauss-Markov process.
double bandwidth(const Term &term, double second);
double deviation(const Law &law, const Term &term, double drift, double second);

// Of an oscillation over a time: transition of x and x'/w.
Eigen::Matrix2d swing(const Term &oscillation, const Term &damping, double time_s);

// One value theta^kj of the parameters of hypothesis k.
struct Node {
    std::size_t hypothesis; // k, an index into the laws
    double drift;           // K, unit/s/sqrt(Hz), if the law has a walk; else sigma_m or B, unit
    double second;          // alpha, 1/s, or the ratio
    double sigma_v;         // unit, per sample
};

// States of x_i: at least one. Beside means of a block each term has two, first all terms, then all means.
std::size_t order(const Law &law, std::size_t block);

// One axis of a recording. A sample that is NaN is missing: the filter predicts over it.
struct Record {
    const double *y; // [n] unit
    const double *r; // [n] factor on sigma_v^2, or null for 1
    std::size_t n;
    double dt_s;
    double bias_mean, bias_sd;              // prior of x0, unit
    std::size_t regressors = 0;             // at most regressors_max
    const double *z = nullptr;              // [n][regressors], finite where y is
    const double *coefficient_sd = nullptr; // [regressors] prior of each coefficient, unit per unit of its regressor
    std::size_t block = 1; // samples that y is the mean of; x_0 = 0 is one dt before the middle of the first block
};

// What a filter knows after its last sample: ln p(Y | h_k, theta_kj), and the state [drift; x0; c] given them.
// `drift` has order(law, block) elements.
struct Filtered {
    double ln_p;
    Eigen::VectorXd mean;
    Eigen::MatrixXd covariance;
    // Of x0 + x_i + c' z_i (a moving average is no part of x_i), with z of the last sample that is not missing.
    double now_mean, now_var;
};

// One filter over the whole record. If `standardized` is not null it receives nu_i / sqrt(s_i) [n], NaN where missing.
Filtered run_filter(const Record &record, const Law &law, const Node &node, double *standardized = nullptr);

// run_filter() for every node, spread over the machine's cores.
std::vector<Filtered> run_filters(const Record &record, const std::vector<Law> &laws, const std::vector<Node> &nodes);

// Posterior of the whole bank after one sample. A hypothesis of probability 0 has NaN moments.
struct Posterior {
    std::vector<double> weight;              // [nodes], sum 1: mu_i^kj Pr(H = h_k | Y_i)          (11), (13)
    std::vector<double> probability;         //                                                     (13)
    std::vector<Eigen::Vector3d> mean;       // of (drift, second, sigma_v) under each hypothesis   (12)
    std::vector<Eigen::Matrix3d> covariance; //                                                     (14)
    std::vector<double> bias_mean, bias_var; // of x0 + x_i + c' z_i under each hypothesis          (12), (14)
};

// The bank at chosen samples. `ln_prior` [nodes] is ln(mu_0^kj Pr(H = h_k)) up to one constant; `after` [m] ascending,
// each the number of samples seen, 0 to n.
std::vector<Posterior> run_bank(const Record &record, const std::vector<Law> &laws, const std::vector<Node> &nodes,
                                const std::vector<double> &ln_prior, const std::vector<std::size_t> &after);

} // namespace selfcal_reference
