// The C library as Python sees it: one class over selfcal_t that owns its memory and tables. Compiled from the same
// sources as _library32 (the float of the firmware), _library64 (-DSELFCAL_REAL_DOUBLE, to tell rounding from
// method), and _fixed (-DSELFCAL_FIXED, the firmware of parts without an FPU).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "selfcal.h"
#include "tables.hpp"
#include "tumble.h"

namespace nb = nanobind;
using Rows = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// Not an anonymous namespace, see tables.hpp.
namespace MODULE_NAME {

class Bank : Tables {
  public:
    Bank(double dt_s, uint32_t block, const std::vector<AxisTuple> &axes,
         const std::vector<HypothesisTuple> &hypotheses, uint32_t id, const std::optional<RegressorsTuple> &regressors,
         double half_life_s, const std::tuple<double, bool, bool> &handling)
        : Tables(dt_s, block, axes, hypotheses, id, regressors, half_life_s, handling) {
        memory_.resize(size() / sizeof(double) + 1);
        check(selfcal_init(&bank_, &model_, memory_.data(), memory_.size() * sizeof(double)));
    }

    void push(const Rows &samples,
              const nb::ndarray<const uint64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu> &missing_before,
              const std::optional<Rows> &regressors) {
        if (regressors && (regressors->shape(0) != samples.shape(0) || regressors->shape(1) != reference_.size()))
            throw std::invalid_argument("regressors must be [n, regressors]");
        if (samples.shape(1) != axes_.size() || missing_before.shape(0) != samples.shape(0))
            throw std::invalid_argument("samples must be [n, axes] and missing_before [n]");
        nb::gil_scoped_release release;
        for (size_t i = 0; i < samples.shape(0); i++) {
            if (missing_before.data()[i] > 0)
                check(selfcal_skip(&bank_, missing_before.data()[i]));
            check(selfcal_push_with(&bank_, samples.data() + i * axes_.size(),
                                    regressors ? regressors->data() + i * reference_.size() : nullptr));
        }
    }

    // Judgements (axis, sample, state, suspect, score, samples) of a record, with a report on every axis just before
    // each epoch: a module reports every few seconds. `channels` [n, 2]: temperature and supply.
    // And the changes (axis, sample, cause, size, s since the onset) that the model handles.
    std::pair<std::vector<std::tuple<int, size_t, int, int, float, uint32_t>>,
              std::vector<std::tuple<int, size_t, int, float, float>>>
    watch(const Rows &samples,
          const nb::ndarray<const uint64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu> &missing_before,
          const std::optional<Rows> &channels) {
        if (samples.shape(1) != axes_.size() || missing_before.shape(0) != samples.shape(0) ||
            (channels && (channels->shape(0) != samples.shape(0) || channels->shape(1) != SELFCAL_ADEQUACY_CHANNELS)))
            throw std::invalid_argument("samples must be [n, axes], missing_before [n], channels [n, 2]");
        std::vector<std::tuple<int, size_t, int, int, float, uint32_t>> told;
        std::vector<std::tuple<int, size_t, int, float, float>> found;
        nb::gil_scoped_release release;
        auto adequacy = std::make_unique<selfcal_adequacy_t>();
        check(selfcal_adequacy_init(adequacy.get(), &bank_));
        auto changes = std::make_unique<selfcal_changes_t>();
        std::vector<float> learned(size_t{model_.nodes} * model_.axes);
        if (model_.handling && (model_.handling->steps || model_.handling->variance_changes))
            check(selfcal_changes_init(changes.get(), adequacy.get(), &bank_, learned.data()));
        size_t changed = samples.shape(0);
        selfcal_report_t report{};
        for (size_t i = 0; i < samples.shape(0); i++) {
            if (missing_before.data()[i] > 0)
                check(selfcal_skip(&bank_, missing_before.data()[i]));
            check(selfcal_push(&bank_, samples.data() + i * axes_.size()));
            const uint32_t before = adequacy->count;
            const float *beside = channels ? channels->data() + i * SELFCAL_ADEQUACY_CHANNELS : nullptr;
            selfcal_adequacy_push(adequacy.get(), &bank_, beside, nullptr);
            const bool ended = adequacy->count != before && adequacy->count == adequacy->length;
            for (uint8_t axis = 0; ended && axis < axes_.size(); axis++) {
                const selfcal_judgement_t j = selfcal_judgement(adequacy.get(), &bank_, axis);
                told.emplace_back(axis, i, j.state, j.suspect, j.score, j.samples);
            }
            const uint32_t at = selfcal_changes_handle(adequacy.get(), &bank_);
            for (uint8_t axis = 0; axis < axes_.size(); axis++)
                if ((at >> axis & 1U) != 0) {
                    const selfcal_change_t change = selfcal_judgement(adequacy.get(), &bank_, axis).change;
                    found.emplace_back(axis, i, change.cause, change.size, change.ago_s);
                    changed = i;
                }
            const bool again = i >= changed && (i - changed) % 64 == 0 && i - changed <= 512;
            const bool due = ended || again || (adequacy->length == 0 && (i + 1) % SELFCAL_EPOCH_MIN == 0);
            for (uint8_t axis = 0; due && axis < axes_.size(); axis++)
                if (selfcal_report(work_.get(), &bank_, axis, &report) == SELFCAL_OK)
                    selfcal_adequacy_report(adequacy.get(), &model_, &report, nullptr);
        }
        return {told, found};
    }

    void skip(uint64_t count) { check(selfcal_skip(&bank_, count)); }
    void shift(uint8_t axis, float amount) { check(selfcal_shift(&bank_, axis, amount)); }
    void moving() { check(selfcal_moving(&bank_)); }
    void push_moving(const Rows &samples) {
        if (samples.shape(1) != axes_.size())
            throw std::invalid_argument("samples must be [n, axes]");
        for (size_t i = 0; i < samples.shape(0); i++)
            check(selfcal_push_moving(&bank_, samples.data() + i * axes_.size()));
    }
    void rate(uint32_t block, float variance_ratio) { check(selfcal_rate(&bank_, block, variance_ratio)); }

    // Of each axis hypothesis, ln rho, ln of the second parameter, sigma_v, bias and its sd, see selfcal_reopening_t.
    void reopen(const std::vector<std::tuple<uint8_t, float, float, float, float, float>> &at, float keep) {
        if (at.size() != axes_.size())
            throw std::invalid_argument("one place an axis");
        selfcal_reopening_t given[SELFCAL_AXES_MAX]{};
        for (size_t axis = 0; axis < at.size(); axis++) {
            const auto [hypothesis, ln_rho, ln_second, sigma_v, bias, bias_sd] = at[axis];
            given[axis] = {hypothesis, ln_rho, ln_second, sigma_v, bias, bias_sd};
        }
        check(selfcal_reopen(&bank_, given, keep, nullptr));
    }

    bool retired(uint8_t axis) const {
        if (axis >= axes_.size())
            throw std::invalid_argument("axis out of range");
        return selfcal_retired(&bank_, axis);
    }

    // The bias over all laws is the one `ahead_s` after the last bank interval.
    nb::dict report(uint8_t axis, uint8_t mask, float ahead_s) {
        selfcal_report_t r{};
        std::vector<selfcal_coefficients_t> coefficients(hypotheses_.size());
        {
            nb::gil_scoped_release release;
            check(selfcal_report_begin_subset(work_.get(), &bank_, axis, mask, coefficients.data(), &r));
            selfcal_status_t status = SELFCAL_BUSY;
            while (status == SELFCAL_BUSY)
                status = selfcal_report_step(work_.get(), &r);
            check(status);
        }
        if (ahead_s > 0.0F)
            check(selfcal_predict(&r, &model_, ahead_s, &r.bias_mean, &r.bias_sd));
        nb::list hypotheses;
        for (size_t h = 0; h < hypotheses_.size(); h++) {
            const selfcal_posterior_t &p = r.hypothesis[h];
            nb::list parameters;
            for (const selfcal_estimate_t &e : p.parameter)
                parameters.append(nb::make_tuple(e.mean, e.median, e.sd, e.q05, e.q95, e.flags));
            nb::dict d;
            d["probability"] = p.probability;
            d["ln_evidence"] = p.ln_evidence;
            d["parameters"] = parameters;
            nb::list of_regressors;
            for (size_t k = 0; k < reference_.size(); k++)
                of_regressors.append(nb::make_tuple(coefficients[h].mean[k], coefficients[h].sd[k]));
            d["coefficients"] = of_regressors;
            d["bias_mean"] = p.bias_mean;
            d["bias_sd"] = p.bias_sd;
            hypotheses.append(d);
        }
        nb::dict out;
        out["n"] = r.n;
        out["bias_mean"] = r.bias_mean;
        out["bias_sd"] = r.bias_sd;
        out["hypotheses"] = hypotheses;
        return out;
    }

    // (bias, sd) at each time after the last bank interval, s.
    std::vector<std::tuple<float, float>> predict(uint8_t axis, const std::vector<float> &elapsed_s) {
        selfcal_report_t r{};
        check(selfcal_report(work_.get(), &bank_, axis, &r));
        std::vector<std::tuple<float, float>> found(elapsed_s.size());
        for (size_t k = 0; k < found.size(); k++)
            check(selfcal_predict(&r, &model_, elapsed_s[k], &std::get<0>(found[k]), &std::get<1>(found[k])));
        return found;
    }

    nb::dict node(uint8_t axis, uint16_t index) {
        selfcal_node_view_t v{};
        check(selfcal_node(&bank_, axis, index, &v));
        nb::dict d;
        d["hypothesis"] = static_cast<int>(v.hypothesis);
        d["ln_rho"] = v.ln_rho;
        d["ln_alpha"] = v.ln_alpha;
        d["a"] = v.a;
        d["b"] = v.b;
        d["c"] = v.c;
        d["ln_s"] = v.ln_s;
        d["drift"] = v.drift;
        d["bias_left"] = v.bias_left;
        d["drift_var"] = v.drift_var;
        return d;
    }

    double log_likelihood(uint8_t axis, uint16_t node, double sigma_v) {
        double ln_p = 0.0;
        check(selfcal_log_likelihood(&bank_, axis, node, sigma_v, &ln_p));
        return ln_p;
    }

    double log_likelihood_subset(uint8_t axis, uint16_t node, uint8_t mask, double sigma_v) {
        double ln_p = 0.0;
        check(selfcal_log_likelihood_subset(&bank_, axis, node, mask, sigma_v, &ln_p));
        return ln_p;
    }

    nb::dict counters() const {
        const selfcal_counters_t *c = selfcal_counters(&bank_);
        const size_t axes = axes_.size();
        auto list = [axes](const uint32_t *values) { return std::vector<uint32_t>(values, values + axes); };
        nb::dict d;
        d["samples"] = c->samples;
        d["missing"] = c->missing;
        d["gaps"] = c->gaps;
        d["blocks_lost"] = c->blocks_lost;
        d["blocks_part"] = c->blocks_part;
        d["blocks_moving"] = c->blocks_moving;
        d["not_finite"] = list(c->not_finite);
        d["outliers"] = std::vector<uint32_t>(c->outliers, c->outliers + axes);
        d["saturated"] = list(c->saturated);
        d["stuck"] = list(c->stuck);
        d["regressor_not_finite"] = c->regressor_not_finite;
        return d;
    }

#ifdef SELFCAL_FIXED
    nb::dict scale(uint8_t axis) const {
        if (axis >= axes_.size())
            throw std::invalid_argument("axis out of range");
        const selfcal_scale_t *s = selfcal_scale(&bank_, axis);
        nb::dict d;
        d["exponent"] = s->exponent;
        d["coarser"] = s->coarser;
        d["finer"] = s->finer;
        d["most_y"] = s->most_y;
        d["most_sum"] = s->most_sum;
        return d;
    }
#endif

    uint32_t count() const { return selfcal_count(&bank_); }
    double weight() const { return bank_.weight; }
    uint16_t nodes() const { return model_.nodes; }
    size_t size() const {
        return SELFCAL_SIZE(model_.nodes, model_.axes) +
               SELFCAL_REGRESSORS_SIZE(model_.nodes, model_.axes, reference_.size()) +
               SELFCAL_TERMS_SIZE(term_nodes_, model_.axes, reference_.size());
    }

    bool sound() const { return selfcal_check(&bank_) == SELFCAL_OK; }

    nb::bytes save() const {
        std::string bytes;
        const auto append = [](void *to, const void *from, size_t count) {
            static_cast<std::string *>(to)->append(static_cast<const char *>(from), count);
            return true;
        };
        bytes.reserve(selfcal_snapshot_size(&bank_));
        check(selfcal_save(&bank_, append, &bytes));
        return nb::bytes(bytes.data(), bytes.size());
    }

    void restore(const nb::bytes &snapshot) {
        check(selfcal_restore(&bank_, &model_, memory_.data(), memory_.size() * sizeof(double), snapshot.data(),
                              snapshot.size()));
    }

    float within_sd(uint8_t axis) const {
        if (axis >= axes_.size())
            throw std::invalid_argument("axis out of range");
        return selfcal_within_sd(&bank_, axis);
    }

  private:
    static void check(selfcal_status_t status) {
        switch (status) {
        case SELFCAL_OK: return;
        case SELFCAL_TOO_SHORT: throw std::length_error("too few bank samples for a report");
        case SELFCAL_AXIS_RETIRED: throw std::domain_error("the axis is retired: it failed for too long");
        case SELFCAL_BAD_ARGUMENT: throw std::invalid_argument("argument out of range");
        case SELFCAL_BAD_MODEL:
            throw std::invalid_argument("the model's tables contradict themselves or exceed "
                                        "what the library is built for");
        case SELFCAL_SNAPSHOT_TRUNCATED: throw std::invalid_argument("the snapshot is truncated");
        case SELFCAL_SNAPSHOT_TOO_LONG: throw std::invalid_argument("the snapshot is longer than it says");
        case SELFCAL_SNAPSHOT_DAMAGED: throw std::invalid_argument("the snapshot is damaged");
        case SELFCAL_SNAPSHOT_FOREIGN: throw std::invalid_argument("not a snapshot of this model and build");
        case SELFCAL_SNAPSHOT_VERSION: throw std::invalid_argument("the snapshot is of another format version");
        default: throw std::runtime_error("selfcal status " + std::to_string(static_cast<int>(status)));
        }
    }

    std::vector<double> memory_;
    selfcal_t bank_{};
    std::unique_ptr<selfcal_work_t> work_ = std::make_unique<selfcal_work_t>();
};

class Gate {
  public:
    Gate(uint32_t window, float false_alarm, uint32_t hold, uint32_t settle, uint32_t memory,
         const std::vector<float> &sigma, const std::vector<bool> &is_rate) {
        if (sigma.size() > SELFCAL_AXES_MAX || is_rate.size() != sigma.size())
            throw std::invalid_argument("one sigma and one kind an axis, up to SELFCAL_AXES_MAX");
        selfcal_gate_config_t config{
            static_cast<uint8_t>(sigma.size()), window, false_alarm, hold, settle, memory, {}, {}};
        std::copy(sigma.begin(), sigma.end(), config.sigma);
        std::copy(is_rate.begin(), is_rate.end(), config.is_rate);
        check(selfcal_gate_init(&gate_, &config));
    }

    // The state after each sample, one byte each: 1 at rest.
    nb::bytes push(const nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu> &samples) {
        if (samples.shape(1) != gate_.config.axes)
            throw std::invalid_argument("samples must be [n, axes]");
        std::string states(samples.shape(0), '\0');
        for (size_t i = 0; i < states.size(); i++)
            states[i] = static_cast<char>(selfcal_gate_push(&gate_, samples.data() + i * gate_.config.axes));
        return nb::bytes(states.data(), states.size());
    }

    int skip(uint64_t count) { return selfcal_gate_skip(&gate_, count); }

    void noise(uint8_t axis, float sigma, float within, float spread, float level) {
        const selfcal_gate_noise_t noise{sigma, within, spread, level};
        check(selfcal_gate_noise(&gate_, axis, &noise));
    }

    std::tuple<float, float, float, float> measured(uint8_t axis) const {
        selfcal_gate_noise_t n{};
        check(selfcal_gate_measured(&gate_, axis, &n));
        return {n.sigma, n.within, n.spread, n.level};
    }

    nb::dict last() const {
        const selfcal_gate_counters_t &c = gate_.counters;
        nb::dict d;
        d["position"] = gate_.position;
        d["t1"] = gate_.t1;
        d["t2"] = gate_.t2;
        d["shaken_above"] = gate_.shaken_above;
        d["moved_above"] = gate_.moved_above;
        d["windows"] = c.windows;
        d["shaken"] = c.shaken;
        d["moved"] = c.moved;
        d["blind"] = c.blind;
        d["alarms"] = c.alarms;
        d["measured"] = gate_.measured;
        return d;
    }

  private:
    static void check(selfcal_status_t status) {
        if (status != SELFCAL_OK)
            throw std::invalid_argument(status == SELFCAL_TOO_SHORT ? "too few windows" : "argument out of range");
    }

    selfcal_gate_t gate_{};
};

using SourceTuple = std::tuple<int, int, float, float>; // kind, channel, number, second

// The values [n, sources] of regressors over channels [n, c], after missing_before [n] samples each, the first one
// `powered` samples after power-on.
using Missing = nb::ndarray<const uint64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
static nb::ndarray<nb::numpy, float> form(const std::vector<SourceTuple> &tuples, double interval_s,
                                          const Rows &channels, const Missing &missing_before, uint64_t powered) {
    std::vector<selfcal_source_t> sources;
    for (const auto &[kind, channel, number, second] : tuples) {
        if (channel < 0 || static_cast<size_t>(channel) >= std::max<size_t>(channels.shape(1), 1))
            throw std::invalid_argument("a source is no channel");
        sources.push_back({static_cast<selfcal_column_kind_t>(kind), static_cast<uint8_t>(channel), number, second});
    }
    const size_t n = missing_before.shape(0), p = sources.size();
    if (channels.shape(0) != n || p == 0 || p > SELFCAL_REGRESSORS_MAX)
        throw std::invalid_argument("channels must be [n, c] and missing_before [n]");
    selfcal_regressors_t regressors{};
    regressors.count = static_cast<uint8_t>(p);
    regressors.source = sources.data();
    selfcal_model_t model{};
    model.dt_s = static_cast<float>(interval_s);
    model.block = 1;
    model.regressors = &regressors;
    selfcal_former_t former;
    if (selfcal_former_init(&former, &model) != SELFCAL_OK)
        throw std::invalid_argument("sources cannot be");
    former.powered = powered;
    auto *values = new float[n * p + 1];
    nb::capsule owner(values, [](void *v) noexcept { delete[] static_cast<float *>(v); });
    for (size_t i = 0; i < n; i++)
        selfcal_form(&former, static_cast<uint32_t>(std::min<uint64_t>(missing_before.data()[i], UINT32_MAX)), nullptr,
                     channels.data() + i * channels.shape(1), values + i * p);
    const size_t shape[] = {n, p};
    return {values, 2, shape, owner};
}

} // namespace MODULE_NAME

NB_MODULE(MODULE_NAME, m) {
    using MODULE_NAME::Bank;
    m.attr("version") = SELFCAL_VERSION;
    m.attr("GRID_MAX") = SELFCAL_GRID_MAX;
    m.attr("BATCH") = SELFCAL_BATCH;
    m.attr("GATE_MEASURED_MIN") = SELFCAL_GATE_MEASURED_MIN;
    m.attr("REGRESSORS_MAX") = SELFCAL_REGRESSORS_MAX;
    m.attr("REPORT_MIN") = SELFCAL_REPORT_MIN;
    m.attr("SAMPLE_MAX") = SELFCAL_SAMPLE_MAX;
    m.attr("HYPOTHESES_MAX") = SELFCAL_HYPOTHESES_MAX;
    m.attr("TERMS_MAX") = SELFCAL_TERMS_MAX;
    m.attr("GRID_MIN") = SELFCAL_GRID_MIN;
    m.attr("LN_LIMIT") = SELFCAL_LN_LIMIT;
    m.attr("LOG_NORMAL_REACH") = SELFCAL_LOG_NORMAL_REACH;
    m.attr("FACTORS") = nb::make_tuple(1.0 / SELFCAL_FACTOR_MAX, SELFCAL_FACTOR_MAX);
    m.attr("RATIOS") = nb::make_tuple(1.0 / SELFCAL_RATIO_MAX, SELFCAL_RATIO_MAX);
    m.attr("TIMES") = nb::make_tuple(1.0 / SELFCAL_ALPHA_DT_MAX, SELFCAL_TIME_MAX);
    m.attr("PERIOD_MIN") = SELFCAL_PERIOD_MIN;
    m.attr("DAMPINGS") = nb::make_tuple(SELFCAL_DAMPING_MIN, SELFCAL_DAMPING_MAX);
    m.attr("LIKELY") = SELFCAL_LIKELY;
    m.attr("TUMBLE_BIAS_SD") = SELFCAL_TUMBLE_BIAS_SD;
    m.attr("TUMBLE_SCALE_SD") = SELFCAL_TUMBLE_SCALE_SD;
    m.attr("TUMBLE_ANGLE_SD") = SELFCAL_TUMBLE_ANGLE_SD;
    m.attr("TUMBLE_SQUARE_SD") = SELFCAL_TUMBLE_SQUARE_SD;
    m.attr("TUMBLE_REACH") = SELFCAL_TUMBLE_REACH;
    m.attr("TUMBLE_LEFT") = SELFCAL_TUMBLE_LEFT;
    m.attr("TUMBLE_WIDER") = SELFCAL_TUMBLE_WIDER;
    m.attr("IDENTIFIED") = static_cast<int>(SELFCAL_IDENTIFIED);
    m.attr("AT_MIN") = static_cast<int>(SELFCAL_AT_MIN);
    m.attr("AT_MAX") = static_cast<int>(SELFCAL_AT_MAX);
    m.attr("OFF_GRID") = static_cast<int>(SELFCAL_OFF_GRID);
    nb::class_<Bank>(m, "Bank")
        .def(nb::init<double, uint32_t, const std::vector<AxisTuple> &, const std::vector<HypothesisTuple> &, uint32_t,
                      const std::optional<RegressorsTuple> &, double, const std::tuple<double, bool, bool> &>(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg("regressors") = nb::none(),
             nb::arg("half_life_s") = 0.0, nb::arg("handling") = std::make_tuple(0.0, false, false))
        .def("push", &Bank::push, nb::arg(), nb::arg(), nb::arg("regressors") = nb::none())
        .def("watch", &Bank::watch)
        .def("skip", &Bank::skip)
        .def("shift", &Bank::shift)
        .def("moving", &Bank::moving)
        .def("push_moving", &Bank::push_moving)
        .def("rate", &Bank::rate)
        .def("reopen", &Bank::reopen)
        .def("retired", &Bank::retired)
        .def("report", &Bank::report, nb::arg("axis"), nb::arg("mask") = 0, nb::arg("ahead_s") = 0.0F)
        .def("predict", &Bank::predict)
        .def("node", &Bank::node)
        .def("log_likelihood", &Bank::log_likelihood)
        .def("log_likelihood_subset", &Bank::log_likelihood_subset)
        .def("counters", &Bank::counters)
        .def("within_sd", &Bank::within_sd)
        .def("save", &Bank::save)
        .def("restore", &Bank::restore)
        .def_prop_ro("sound", &Bank::sound)
#ifdef SELFCAL_FIXED
        .def("scale", &Bank::scale)
#endif
        .def_prop_ro("count", &Bank::count)
        .def_prop_ro("weight", &Bank::weight)
        .def_prop_ro("nodes", &Bank::nodes)
        .def_prop_ro("size", &Bank::size);
    m.def("form", &MODULE_NAME::form);
    using MODULE_NAME::Gate;
    nb::class_<Gate>(m, "Gate")
        .def(nb::init<uint32_t, float, uint32_t, uint32_t, uint32_t, const std::vector<float> &,
                      const std::vector<bool> &>())
        .def("push", &Gate::push)
        .def("skip", &Gate::skip)
        .def("noise", &Gate::noise)
        .def("measured", &Gate::measured)
        .def("last", &Gate::last);
}
