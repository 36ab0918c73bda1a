#include "simulator.hpp"

#include "parallel.hpp"
#include "random.hpp"

#include <algorithm>
#include <cmath>
#include <functional>

namespace selfcal_reference {

namespace {

constexpr double pi = 3.14159265358979323846;

// What a stream of random numbers is for. Axis streams are numbered axis * 16 + purpose.
enum Purpose : std::uint64_t {
    white,
    drift,
    flicker,
    outliers,
    motion,
    temperature,
    supply,
    missing,
    intervals,
    earlier
};

Random stream(std::uint64_t seed, std::size_t axis, Purpose purpose) {
    return Random(seed, axis * 16 + purpose);
}

double on_lattice(double value, double lsb) {
    return lsb > 0.0 ? std::round(value / lsb) * lsb : value;
}

// A stationary Gauss-Markov process sampled every dt, exactly.
class GaussMarkov {
  public:
    GaussMarkov(double sigma, double alpha, double dt_s, Random &random)
        : phi_(std::exp(-alpha * dt_s)), gain_(sigma * std::sqrt(-std::expm1(-2.0 * alpha * dt_s))), random_(random),
          x_(sigma * random.normal()) {}

    double next() { return x_ = phi_ * x_ + gain_ * random_.normal(); }

  private:
    double phi_, gain_;
    Random &random_;
    double x_;
};

// White noise of density 1 after the Bartlett filter, averaged over each block. One tap changes nothing about the white
// noise, so the block's mean is drawn at once.
std::vector<double> white_noise(const Scene &scene, Random random) {
    std::vector<double> out(scene.samples);
    if (scene.filter_taps == 1) {
        const double sd = std::sqrt(scene.rate_hz);
        std::generate(out.begin(), out.end(), [&] { return sd * random.normal(); });
        return out;
    }
    const std::size_t taps = scene.filter_taps;
    const double sd = std::sqrt(scene.rate_hz * static_cast<double>(scene.block));
    std::vector<double> first(taps, 0.0), second(taps, 0.0); // the boxcars' memories, as rings
    double first_sum = 0.0, second_sum = 0.0;
    std::size_t at = 0;
    const auto filtered = [&] {
        const double v = sd * random.normal();
        first_sum += v - first[at];
        first[at] = v;
        const double mean = first_sum / static_cast<double>(taps);
        second_sum += mean - second[at];
        second[at] = mean;
        at = (at + 1) % taps;
        return second_sum / static_cast<double>(taps);
    };
    for (std::size_t i = 0; i < 2 * taps; ++i) { // until the memories are full
        filtered();
    }
    for (double &sample : out) {
        double sum = 0.0;
        for (std::size_t i = 0; i < scene.block; ++i) {
            sum += filtered();
        }
        sample = sum / static_cast<double>(scene.block);
    }
    return out;
}

// First-order colouring with lag-1 correlation rho whose spectrum at zero frequency stays as it was.
void colour(std::vector<double> &noise, double rho) {
    double before = noise.empty() ? 0.0 : noise[0] * std::sqrt((1.0 - rho) / (1.0 + rho));
    for (std::size_t i = 0; i < noise.size(); ++i) {
        before = i == 0 ? before : rho * before + (1.0 - rho) * noise[i];
        noise[i] = before;
    }
}

// Gauss-Markov terms of one variance sigma^2 whose time constants T are a factor q apart: their two-sided spectra sum
// to sigma^2 / (2 ln q f) between the ends of 1/T, which is B^2 / (2 pi f) for sigma^2 = B^2 ln q / pi. Each term's
// variance is lowered so that sampling keeps its spectrum at zero frequency, 2 sigma^2 T: the fast ones would alias
// otherwise.
std::vector<double> flicker_noise(const Scene &scene, double coefficient, Random random) {
    const double dt_s = 1.0 / scene.rate_hz;
    const double shortest_s = 0.1 * dt_s;
    const double longest_s = 10.0 * static_cast<double>(scene.samples) * dt_s;
    const double q = std::sqrt(10.0);
    const double sigma = coefficient * std::sqrt(std::log(q) / pi);
    std::vector<double> out(scene.samples, 0.0);
    const int terms = 1 + static_cast<int>(std::ceil(std::log(longest_s / shortest_s) / std::log(q)));
    for (int k = 0; k < terms; ++k) {
        const double time_constant_s = shortest_s * std::pow(q, k);
        const double x = dt_s / (2.0 * time_constant_s);
        GaussMarkov term(sigma * std::sqrt(std::tanh(x) / x), 1.0 / time_constant_s, dt_s, random);
        for (double &sample : out) {
            sample += term.next();
        }
    }
    return out;
}

// Warm-up by some 8 degC with a time constant of 20 min, and a room that wanders by 0.5 degC over 30 min.
std::vector<double> temperature_curve(const Scene &scene) {
    Random random = stream(scene.seed, 0, temperature);
    const double dt_s = 1.0 / scene.rate_hz;
    const double start = 24.0 + 4.0 * random.uniform();
    const double rise = 6.0 + 4.0 * random.uniform();
    GaussMarkov room(0.5, 1.0 / 1800.0, dt_s, random);
    std::vector<double> out(scene.samples);
    for (std::size_t i = 0; i < out.size(); ++i) {
        out[i] = start - rise * std::expm1(-static_cast<double>(i) * dt_s / 1200.0) + room.next();
    }
    return out;
}

// Nominal, off by up to 50 mV, wandering by 10 mV over 10 min.
std::vector<double> supply_curve(const Scene &scene) {
    Random random = stream(scene.seed, 0, supply);
    const double start = nominal_supply_v + 0.1 * (random.uniform() - 0.5);
    GaussMarkov regulator(0.01, 1.0 / 600.0, 1.0 / scene.rate_hz, random);
    std::vector<double> out(scene.samples);
    std::generate(out.begin(), out.end(), [&] { return start + regulator.next(); });
    return out;
}

std::vector<std::uint8_t> presence(const Scene &scene) {
    std::vector<std::uint8_t> present(scene.samples, 1);
    Random random = stream(scene.seed, 0, missing);
    const std::size_t last = scene.samples == 0 ? 0 : scene.samples - 1;
    std::size_t left = scene.samples < 3 ? 0 : std::min(scene.missing, scene.samples - 2);
    while (left > 0) {
        std::size_t run = 1 + static_cast<std::size_t>(20.0 * random.uniform());
        std::size_t i = 1 + static_cast<std::size_t>(random.uniform() * static_cast<double>(last - 1));
        for (; run > 0 && i < last && left > 0; ++i) {
            if (present[i] != 0) {
                present[i] = 0;
                --run;
                --left;
            }
        }
    }
    return present;
}

std::vector<std::uint8_t> motion_mask(const Scene &scene) {
    std::vector<std::uint8_t> moving(scene.samples, 0);
    Random random = stream(scene.seed, 0, intervals);
    for (std::size_t k = 0; k < scene.motion_intervals; ++k) {
        const double length_s = 2.0 + 8.0 * random.uniform();
        const auto begin = static_cast<std::size_t>(random.uniform() * static_cast<double>(scene.samples));
        const std::size_t end = std::min(scene.samples, begin + static_cast<std::size_t>(length_s * scene.rate_hz) + 1);
        std::fill_n(moving.begin() + static_cast<std::ptrdiff_t>(begin), end - begin, 1);
    }
    for (std::size_t k = 0; k + 1 < scene.motion_times.size(); k += 2)
        for (std::size_t i = 0; i < scene.samples; ++i) {
            const double t = static_cast<double>(i) / scene.rate_hz;
            if (t >= scene.motion_times[k] && t < scene.motion_times[k + 1])
                moving[i] = 1;
        }
    return moving;
}

std::vector<double> drift_curve(const Scene &scene, std::size_t index, const Axis &axis) {
    const double dt_s = 1.0 / scene.rate_hz;
    Random random = stream(scene.seed, index, drift);
    std::vector<double> out(scene.samples, 0.0);
    for (const Term &term : axis.law.terms) {
        if (term.kind == Kind::damping) {
            continue;
        }
        if (term.kind == Kind::oscillation) {
            const double sd = deviation(axis.law, term, axis.drift, axis.second);
            const Term &damping = *(&term + 1);
            const Eigen::Matrix2d F = swing(term, damping, dt_s);
            const Eigen::Matrix2d Q = Eigen::Matrix2d::Identity() - F * F.transpose();
            const double across = std::sqrt(Q(1, 1)), first = Q(0, 1) / across;
            const double rest = std::sqrt(std::max(Q(0, 0) - first * first, 0.0));
            Eigen::Vector2d x(random.normal(), random.normal());
            for (double &value : out) {
                value += sd * x(0);
                const double a = random.normal(), b = random.normal();
                x = F * x + Eigen::Vector2d(first * b + rest * a, across * b);
            }
        } else if (term.kind == Kind::walk) {
            double x = 0.0;
            for (double &value : out) {
                value += x += term.deviation * axis.drift * std::sqrt(dt_s) * random.normal();
            }
        } else {
            const double sd = deviation(axis.law, term, axis.drift, axis.second);
            GaussMarkov x(sd, bandwidth(term, axis.second), dt_s, random);
            for (double &value : out) {
                value += x.next();
            }
        }
    }
    return out;
}

// White noise e becomes (e_i + theta e_(i - block)) / (1 + theta): then means of `block` samples are a moving average
// of the means of e.
void average(std::vector<double> &noise, double spectral_ratio, double sd, std::size_t block, Random random) {
    const double theta = (spectral_ratio - 1.0) / (spectral_ratio + 1.0);
    for (std::size_t i = noise.size(); i-- > 0;) {
        const double before = i >= block ? noise[i - block] : sd * random.normal();
        noise[i] = (noise[i] + theta * before) / (1.0 + theta);
    }
}

// Adds everything of one axis but what comes from other channels and the read-out.
void add_noise_and_effects(const Scene &scene, std::size_t index, const Axis &axis,
                           const std::vector<std::uint8_t> &moving, std::vector<double> &out) {
    const double sd = axis.N * std::sqrt(scene.rate_hz);
    std::vector<double> noise = white_noise(scene, stream(scene.seed, index, white));
    if (axis.noise_lag1 != 0.0) {
        colour(noise, axis.noise_lag1);
    }
    if (axis.law.coloured_noise) {
        average(noise, axis.second, std::sqrt(scene.rate_hz), scene.bank_block, stream(scene.seed, index, earlier));
    }
    Random outlier = stream(scene.seed, index, outliers);
    Random shake = stream(scene.seed, index, motion);
    for (std::size_t i = 0; i < out.size(); ++i) {
        const double t = static_cast<double>(i) / scene.rate_hz;
        const bool changed = t >= axis.variance_time_s && t - axis.variance_time_s < axis.variance_duration_s;
        out[i] += axis.N * noise[i] * (changed ? axis.noise_ratio : 1.0);
        out[i] += axis.ramp_slope * t + (t >= axis.step_time_s ? axis.step_amplitude : 0.0);
        out[i] += axis.periodic_amplitude * std::sin(2.0 * pi * axis.periodic_frequency_hz * t);
        out[i] += axis.motion_amplitude * shake.normal() * moving[i];
        const bool is_outlier = outlier.uniform() < axis.outlier_fraction;
        const double size = (10.0 + 10.0 * outlier.uniform()) * (outlier.uniform() < 0.5 ? -sd : sd);
        out[i] += is_outlier ? size : 0.0;
    }
    if (axis.flicker_B != 0.0) {
        const std::vector<double> more = flicker_noise(scene, axis.flicker_B, stream(scene.seed, index, flicker));
        std::transform(out.begin(), out.end(), more.begin(), out.begin(), std::plus<>());
    }
}

double read_out(double value, const Axis &axis) {
    const double clipped = axis.range > 0.0 ? std::clamp(value, -axis.range, axis.range) : value;
    return on_lattice(clipped, axis.lsb);
}

} // namespace

Simulated simulate(const Scene &scene, const std::vector<Axis> &axes, const Added &added) {
    Simulated out;
    out.temperature = temperature_curve(scene);
    out.supply = supply_curve(scene);
    out.present = presence(scene);
    const std::vector<std::uint8_t> moving = motion_mask(scene);
    std::vector<std::vector<double>> error(axes.size());
    out.bias_now.resize(axes.size());
    parallel_for(axes.size(), [&](std::size_t a) {
        error[a] = drift_curve(scene, a, axes[a]);
        out.bias_now[a] = axes[a].bias + (error[a].empty() ? 0.0 : error[a].back());
        add_noise_and_effects(scene, a, axes[a], moving, error[a]);
    });
    out.axes.assign(axes.size(), std::vector<double>(scene.samples));
    for (std::size_t a = 0; a < axes.size(); ++a) {
        const Axis &axis = axes[a];
        for (std::size_t i = 0; i < scene.samples; ++i) {
            const double other = axis.cross_coefficient * error[axis.cross_axis][i];
            out.axes[a][i] = axis.bias + error[a][i] + other +
                             axis.temperature_coefficient * (out.temperature[i] - out.temperature[0]) +
                             axis.supply_coefficient * (out.supply[i] - nominal_supply_v);
        }
    }
    if (added) {
        added(out);
    }
    for (std::size_t a = 0; a < axes.size(); ++a) {
        for (double &value : out.axes[a]) {
            value = read_out(value, axes[a]);
        }
    }
    for (std::size_t i = 0; i < scene.samples; ++i) { // the temperature register's zero is 25 degC
        out.temperature[i] = on_lattice(out.temperature[i] - 25.0, temperature_lsb) + 25.0;
        out.supply[i] = on_lattice(out.supply[i], supply_lsb);
    }
    return out;
}

} // namespace selfcal_reference
