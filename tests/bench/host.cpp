// Nanoseconds per (node, sample, axis) on the host: the library's bank with every filter settled, and the textbook
// bank. Prints `library NS` and `textbook NS`, the best of some rounds each. One thread.
#include "record.h"
#include "textbook_bank.hpp"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <vector>

namespace {

constexpr std::size_t axes = SELFCAL_MODEL_AXES, samples = 4096;
constexpr int rounds = 7;
using Sample = std::array<float, axes>;

template <typename Work> double nanoseconds(Work &&work) {
    const auto start = std::chrono::steady_clock::now();
    work();
    return std::chrono::duration<double, std::nano>(std::chrono::steady_clock::now() - start).count();
}

std::vector<Sample> make_record(record_t &record) {
    std::vector<Sample> out(samples);
    for (Sample &sample : out) {
        record_next(&record, sample.data());
    }
    return out;
}

} // namespace

int main() {
    record_t record;
    record_init(&record);
    selfcal_axis_t axis[axes];
    const selfcal_model_t model = record_narrow_model(true, axis);
    std::vector<std::uint64_t> memory(SELFCAL_SIZE(model.nodes, axes) / 8 + 1);
    selfcal_t bank;
    if (selfcal_init(&bank, &model, memory.data(), memory.size() * 8) != SELFCAL_OK) {
        return 2;
    }
    const auto push = [&](const std::vector<Sample> &all) {
        for (const Sample &sample : all) {
            (void)selfcal_push(&bank, sample.data());
        }
    };
    push(make_record(record));
    if (record_settled(&bank) != model.nodes) {
        return 2;
    }
    const std::vector<Sample> again = make_record(record);
    double library = std::numeric_limits<double>::infinity(), textbook = library;

    using namespace selfcal_reference;
    std::vector<double> y;
    for (const Sample &sample : again) {
        y.push_back(static_cast<double>(sample[0]));
    }
    const Record one_axis{y.data(), nullptr, y.size(), static_cast<double>(model.dt_s), 0.0, 10.0};
    const Law gauss_markov{{Term{Kind::markov}}};
    constexpr std::size_t filters = 8;
    volatile double ln_p = 0.0; // kept, so that nothing is left out
    for (int round = 0; round < rounds; ++round) {
        library = std::min(library, nanoseconds([&] { push(again); }));
        textbook = std::min(
            textbook, nanoseconds([&] {
                for (std::size_t j = 0; j < filters; ++j) {
                    ln_p = run_filter(one_axis, gauss_markov, {0, 0.01 * static_cast<double>(j + 1), 0.01, 0.04}).ln_p;
                }
            }));
    }
    std::printf("library %.4f\ntextbook %.4f\n", library / static_cast<double>(samples * model.nodes * axes),
                textbook / static_cast<double>(samples * filters));
}
