// The firmware's application (port/app) over a recording, in this process: its model is handed over at run time, and
// its frames are handed back. Time stands still while a report is worked out, as in the host's program (port/posix).
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <memory>
#include <string>

#include "tables.hpp"

extern "C" {
#include "app.h"
#include "command.h"
#include "replay.h"
const firmware_model_t *firmware_model;
}

namespace nb = nanobind;
using SourceTuple = std::tuple<int, uint8_t, float, float>; // selfcal_source_t
// [columns] source, [axes * columns] ln prior odds
using ColumnsTuple = std::tuple<std::vector<SourceTuple>, std::vector<float>>;
// window, false_alarm, hold, settle, memory, sigma [axes], is_rate [axes]
using GateTuple = std::tuple<uint32_t, float, uint32_t, uint32_t, uint32_t, std::vector<float>, std::vector<bool>>;

namespace MODULE_NAME {

class Module : Tables {
  public:
    Module(double dt_s, uint32_t block, const std::vector<AxisTuple> &axes,
           const std::vector<HypothesisTuple> &hypotheses, uint32_t id,
           const std::optional<RegressorsTuple> &regressors, double half_life_s,
           const std::tuple<double, bool, bool> &handling, const std::optional<ColumnsTuple> &columns,
           const std::optional<GateTuple> &gate, const std::vector<std::string> &names, double rate_hz,
           uint32_t channels, const std::string &rows, uint32_t period_ms, bool gated)
        : Tables(dt_s, block, axes, hypotheses, id, regressors, half_life_s, handling), names_(names) {
        if (names.size() != axes_.size() || channels > SELFCAL_REGRESSORS_MAX)
            throw std::invalid_argument("one name an axis, and a channel a regressor at most");
        for (const std::string &name : names_)
            name_.push_back(name.c_str());
        if (columns)
            form(*columns);
        const bool changes = handling_.steps || handling_.variance_changes;
        model_of_ = {{&model_, static_cast<float>(rate_hz), gate ? watch(*gate) : nullptr,
                      gate ? &selfcal_gate_code : nullptr, columns ? &selfcal_columns_code : nullptr,
                      &selfcal_judging_code, changes ? &selfcal_changes_code : nullptr},
                     name_.data(),
                     channels};
        firmware_model = &model_of_;
        file_.reset(std::fopen(rows.c_str(), "rb"));
        if (!file_)
            throw std::invalid_argument("cannot read the rows");
        replay_.read = [](void *file, void *bytes, size_t count) {
            return std::fread(bytes, count, 1, static_cast<FILE *>(file)) == 1;
        };
        replay_.context = file_.get();
        complain(replay_open(&replay_));
        if (app_init(app_.get(), &port_, period_ms) != SELFCAL_OK)
            throw std::invalid_argument("the model is refused by the library");
        app_power_on(app_.get(), replay_.powered);
        if (gated && !app_gate(app_.get()))
            throw std::invalid_argument("the model has no gate");
    }

    // Goes on by `rows` rows or to the end: the frames sent meanwhile, each its identifier (little-endian, 32 bit) and
    // 8 bytes. Only one module runs at a time: the interpreter's lock is kept.
    nb::bytes play(uint64_t rows) {
        firmware_model = &model_of_;
        sent_.clear();
        const uint64_t until = replay_.rows - std::min(rows, replay_.rows);
        while (more_ && (replay_.rows > until || until == 0)) {
            more_ = app_step(app_.get());
            complain(error_);
        }
        return nb::bytes(sent_.data(), sent_.size());
    }

    bool ended() const { return !more_; }

  private:
    void form(const ColumnsTuple &columns) {
        for (const auto &[kind, channel, number, second] : std::get<0>(columns))
            source_.push_back({static_cast<selfcal_column_kind_t>(kind), channel, number, second});
        ln_odds_ = std::get<1>(columns);
        if (source_.size() != reference_.size() || ln_odds_.size() != axes_.size() * source_.size())
            throw std::invalid_argument("a source for each regressor, and prior odds for every axis");
        regressors_.source = source_.data();
        regressors_.ln_odds = ln_odds_.data();
    }

    const selfcal_gate_config_t *watch(const GateTuple &gate) {
        const auto &[window, false_alarm, hold, settle, memory, sigma, is_rate] = gate;
        if (sigma.size() != axes_.size() || is_rate.size() != axes_.size())
            throw std::invalid_argument("one sigma and one kind an axis");
        gate_ = {static_cast<uint8_t>(sigma.size()), window, false_alarm, hold, settle, memory, {}, {}};
        std::copy(sigma.begin(), sigma.end(), gate_.sigma);
        std::copy(is_rate.begin(), is_rate.end(), gate_.is_rate);
        return &gate_;
    }

    static void complain(const char *error) {
        if (error != nullptr)
            throw std::invalid_argument(error);
    }

    static Module &of(void *context) { return *static_cast<Module *>(context); }

    static uint32_t time_ms(void *context) { return of(context).replay_.time_ms; }
    static port_sample_t sample(void *context, float reading[], uint32_t *missing) {
        return replay_sample(&of(context).replay_, reading, missing);
    }
    static bool send(void *context, const selfcal_frame_t *frame) {
        for (unsigned shift = 0; shift < 32; shift += 8)
            of(context).sent_.push_back(static_cast<char>(frame->id >> shift & 0xFFU));
        of(context).sent_.append(reinterpret_cast<const char *>(frame->data), sizeof frame->data);
        return true;
    }
    static void idle(void *context) { of(context).error_ = replay_next(&of(context).replay_); }

    struct Close {
        void operator()(FILE *file) const { (void)std::fclose(file); }
    };

    std::vector<std::string> names_;
    std::vector<const char *> name_;
    std::vector<selfcal_source_t> source_;
    std::vector<float> ln_odds_;
    selfcal_gate_config_t gate_{};
    firmware_model_t model_of_{};
    std::unique_ptr<FILE, Close> file_;
    replay_t replay_{};
    const char *error_ = nullptr;
    bool more_ = true;
    std::string sent_;
    port_t port_{this, time_ms, sample, send, idle};
    std::unique_ptr<app_t> app_ = std::make_unique<app_t>();
};

} // namespace MODULE_NAME

NB_MODULE(_firmware, m) {
    using MODULE_NAME::Module;
    nb::class_<Module>(m, "Module")
        .def(nb::init<double, uint32_t, const std::vector<AxisTuple> &, const std::vector<HypothesisTuple> &, uint32_t,
                      const std::optional<RegressorsTuple> &, double, const std::tuple<double, bool, bool> &,
                      const std::optional<ColumnsTuple> &, const std::optional<GateTuple> &,
                      const std::vector<std::string> &, double, uint32_t, const std::string &, uint32_t, bool>(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(),
             nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg())
        .def("play", &Module::play)
        .def_prop_ro("ended", &Module::ended);
    m.def("crc12",
          [](const nb::bytes &data) { return selfcal_crc12(static_cast<const uint8_t *>(data.data()), data.size()); });
    m.def("siphash", [](uint64_t low, uint64_t high, uint64_t message) {
        const uint64_t key[2] = {low, high};
        return command_siphash(key, message);
    });
}
