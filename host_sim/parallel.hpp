// Independent pieces of work over the machine's cores.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <thread>
#include <vector>

namespace selfcal_reference {

// Calls work(i) for i = 0 ... count - 1, in any order. `work` must not throw.
template <typename Work> void parallel_for(std::size_t count, const Work &work) {
    const std::size_t cores = std::max(1U, std::thread::hardware_concurrency());
    std::atomic<std::size_t> next{0};
    const auto loop = [&] {
        for (std::size_t i = next++; i < count; i = next++) {
            work(i);
        }
    };
    std::vector<std::thread> others;
    for (std::size_t i = 1; i < std::min(cores, count); ++i) {
        others.emplace_back(loop);
    }
    loop();
    for (std::thread &other : others) {
        other.join();
    }
}

} // namespace selfcal_reference
