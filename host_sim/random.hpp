// Random numbers that are the same on every machine: SplitMix64 (Steele, Lea & Flood 2014) and Box-Muller (1958),
// written out because std::normal_distribution is free to differ between libraries.
#pragma once

#include <cmath>
#include <cstdint>

namespace selfcal_reference {

class Random {
  public:
    // Streams of one seed are independent of each other, so that what one draws does not shift the next.
    Random(std::uint64_t seed, std::uint64_t stream)
        : state_(mix(seed + golden) ^ mix(mix(stream + golden) + golden)) {}

    double uniform() { // in (0, 1)
        return (static_cast<double>(next() >> 11) + 0.5) * 0x1.0p-53;
    }

    double normal() {
        if (have_spare_) {
            have_spare_ = false;
            return spare_;
        }
        const double radius = std::sqrt(-2.0 * std::log(uniform()));
        const double angle = 6.283185307179586476925 * uniform();
        spare_ = radius * std::sin(angle);
        have_spare_ = true;
        return radius * std::cos(angle);
    }

  private:
    static constexpr std::uint64_t golden = 0x9E3779B97F4A7C15U;

    static std::uint64_t mix(std::uint64_t z) {
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9U;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBU;
        return z ^ (z >> 31);
    }

    std::uint64_t next() { return mix(state_ += golden); }

    std::uint64_t state_;
    double spare_ = 0.0;
    bool have_spare_ = false;
};

} // namespace selfcal_reference
