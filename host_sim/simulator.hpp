// A recording of a resting inertial sensor with known truth: white noise, drift of a known law, temperature, supply,
// the sensor's read-out, and any of the effects that a diagnosis should find (their ids in the comments).
//
// Truth is in continuous time (units of lib/selfcal.h). A recorded sample is the mean of the sensor's own samples since
// the one before, `block` of them. The sensor's Bartlett filter works on its own samples: two cascaded boxcars of
// filter_taps. Its gain at zero frequency is one, so N, K, sigma_m, alpha are those of the filtered record at low
// frequency; it only colours neighbouring samples. Drift and effects are slow against the sensor's rate and enter at
// the recorded rate, drift by its exact transition over 1/rate.
#pragma once

#include "textbook_bank.hpp"

#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <vector>

namespace selfcal_reference {

struct Axis {
    Law law;             // no term: the bias is constant
    double bias = 0.0;   // unit
    double N = 0.0;      // unit/sqrt(Hz)
    double drift = 0.0;  // the law's K, unit/s/sqrt(Hz), or its sigma_m or B, unit
    double second = 1.0; // the law's alpha, 1/s, or its ratio
    double range = 0.0;  // unit, readings are clipped to +-range; 0: none
    double lsb = 0.0;    // unit, readings are whole multiples of it; 0: none

    double temperature_coefficient = 0.0; // temperature: unit/degC, about the first sample's temperature
    double supply_coefficient = 0.0;      // supply: unit/V, about the nominal supply
    double ramp_slope = 0.0;              // ramp: unit/s
    double step_time_s = 0.0;             // step
    double step_amplitude = 0.0;
    double periodic_frequency_hz = 0.0; // periodic: a sine
    double periodic_amplitude = 0.0;
    double flicker_B = 0.0;       // flicker: Gauss-Markov terms half a decade apart, spectrum B^2 / (2 pi f)
    double noise_lag1 = 0.0;      // colored_noise: correlation of neighbours; level at low frequency stays N
    double variance_time_s = 0.0; // variance_change: white noise times noise_ratio from here, for so long
    double variance_duration_s = std::numeric_limits<double>::infinity();
    double noise_ratio = 1.0;
    double outlier_fraction = 0.0; // outliers: this share of samples is off by +-10 to 20 sd of the white noise
    double motion_amplitude = 0.0; // motion: sd of the disturbance in the intervals all axes share
    std::size_t cross_axis = 0;    // cross_axis: index of the axis whose deviation from its bias enters
    double cross_coefficient = 0.0;
};

struct Scene {
    std::uint64_t seed = 0;
    double rate_hz = 1.0;
    std::size_t samples = 0;
    std::size_t block = 1;            // sensor samples per recorded one
    std::size_t filter_taps = 1;      // of each boxcar
    std::size_t bank_block = 1;       // recorded samples a bank interval, whose means a moving average is stated of
    std::size_t missing = 0;          // missing_samples: dropped in runs of 1 to 20, never the first or the last
    std::size_t motion_intervals = 0; // motion: this many, 2 to 10 s long
    std::vector<double> motion_times; // motion: begin and end of each further one, s
};

struct Simulated {
    std::vector<std::vector<double>> axes; // [axes][samples] unit
    std::vector<double> bias_now;          // [axes] bias + drift at the last sample, unit
    std::vector<double> temperature;       // [samples] degC on the sensor's lattice of 0.14
    std::vector<double> supply;            // [samples] V on the sensor's lattice of 2.418 mV
    std::vector<std::uint8_t> present;     // [samples] 0 where missing_samples dropped it
};

constexpr double nominal_supply_v = 5.0;
constexpr double temperature_lsb = 0.14; // ADIS16405
constexpr double supply_lsb = 2.418e-3;

// What a caller adds to the readings of all axes before the read-out.
using Added = std::function<void(Simulated &)>;

// The same arguments give the same recording, and an effect leaves everything else of it as it was.
Simulated simulate(const Scene &scene, const std::vector<Axis> &axes, const Added &added = {});

} // namespace selfcal_reference
