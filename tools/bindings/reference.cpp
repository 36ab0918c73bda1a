// host_sim/ as Python sees it: the textbook bank and the simulator. Arrays are described in selfcal/_reference.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "random.hpp"
#include "simulator.hpp"
#include "textbook_bank.hpp"

namespace nb = nanobind;
namespace sr = selfcal_reference;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Columns = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Laws = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// A numpy array that owns what it is filled with.
template <typename T> class Array {
  public:
    explicit Array(std::vector<std::size_t> shape) : shape_(std::move(shape)) {
        for (const std::size_t n : shape_)
            size_ *= n;
        data_ = new T[size_ > 0 ? size_ : 1];
        owner_ = nb::capsule(data_, [](void *p) noexcept { delete[] static_cast<T *>(p); });
    }
    T *data() const { return data_; }
    nb::ndarray<nb::numpy, T> numpy() const { return {data_, shape_.size(), shape_.data(), owner_}; }

  private:
    std::vector<std::size_t> shape_;
    std::size_t size_ = 1;
    T *data_;
    nb::capsule owner_;
};

using Output = nb::ndarray<nb::numpy, double>;

sr::Record record(const Vector &y, const std::optional<Vector> &r, double dt_s, double bias_mean, double bias_sd,
                  const std::optional<Columns> &z, const std::optional<Vector> &coefficient_sd, std::size_t block) {
    if (block < 1)
        throw std::invalid_argument("block must be at least 1");
    if (r && r->shape(0) != y.shape(0))
        throw std::invalid_argument("r must have the length of y");
    if (!(dt_s > 0.0) || !(bias_sd >= 0.0) || !std::isfinite(bias_mean))
        throw std::invalid_argument("dt_s must be positive, bias_sd at least 0 and bias_mean finite");
    sr::Record out{y.data(), r ? r->data() : nullptr, y.shape(0), dt_s, bias_mean, bias_sd};
    out.block = block;
    if (z.has_value() != coefficient_sd.has_value())
        throw std::invalid_argument("z and coefficient_sd come together");
    if (!z)
        return out;
    out.regressors = z->shape(1);
    if (z->shape(0) != y.shape(0) || coefficient_sd->shape(0) != out.regressors || out.regressors > sr::regressors_max)
        throw std::invalid_argument("z must be [n, regressors] with at most " + std::to_string(sr::regressors_max) +
                                    " regressors, and coefficient_sd [regressors]");
    for (std::size_t i = 0; i < y.shape(0); i++)
        for (std::size_t k = 0; k < out.regressors; k++)
            if (!std::isnan(y(i)) && !std::isfinite((*z)(i, k)))
                throw std::invalid_argument("z must be finite where y is");
    for (std::size_t k = 0; k < out.regressors; k++)
        if (!((*coefficient_sd)(k) >= 0.0))
            throw std::invalid_argument("coefficient_sd must be at least 0");
    out.z = z->data();
    out.coefficient_sd = coefficient_sd->data();
    return out;
}

// (kind, deviation, bandwidth, stated, by_ratio) of each term, and whether the noise is coloured.
using LawTuple = std::tuple<std::vector<std::tuple<int, double, double, bool, bool>>, bool>;

sr::Law law_of(const LawTuple &t) {
    sr::Law law;
    law.coloured_noise = std::get<1>(t);
    for (const auto &[number, deviation, bandwidth, stated, by_ratio] : std::get<0>(t)) {
        const auto kind = static_cast<sr::Kind>(number);
        const bool after = !law.terms.empty() && law.terms.back().kind == sr::Kind::oscillation;
        if (number < 0 || number > 3 || after != (kind == sr::Kind::damping))
            throw std::invalid_argument("an oscillation has a damping behind it, and no other term has");
        const bool has_bandwidth = kind == sr::Kind::walk || (bandwidth > 0.0 && std::isfinite(bandwidth));
        if (!(deviation > 0.0) || !std::isfinite(deviation) || !has_bandwidth)
            throw std::invalid_argument("deviations and bandwidths of a law must be positive");
        law.terms.push_back({kind, deviation, bandwidth, stated, by_ratio});
    }
    if (!law.terms.empty() && law.terms.back().kind == sr::Kind::oscillation)
        throw std::invalid_argument("an oscillation has a damping behind it, and no other term has");
    if (law.terms.size() > sr::terms_max)
        throw std::invalid_argument("a law has at most " + std::to_string(sr::terms_max) + " terms");
    return law;
}

LawTuple tuple_of(const sr::Law &law) {
    LawTuple t;
    std::get<1>(t) = law.coloured_noise;
    for (const sr::Term &term : law.terms)
        std::get<0>(t).emplace_back(static_cast<int>(term.kind), term.deviation, term.bandwidth, term.stated,
                                    term.by_ratio);
    return t;
}

std::vector<sr::Law> laws_of(const std::vector<LawTuple> &tuples) {
    std::vector<sr::Law> laws;
    std::transform(tuples.begin(), tuples.end(), std::back_inserter(laws), law_of);
    return laws;
}

sr::Node node(const std::vector<sr::Law> &laws, int hypothesis, double drift, double second, double sigma_v) {
    if (hypothesis < 0 || hypothesis >= static_cast<int>(laws.size()))
        throw std::invalid_argument("hypothesis must be 0 to " + std::to_string(laws.size() - 1) +
                                    ", an index into the laws");
    const sr::Node out{static_cast<std::size_t>(hypothesis), drift, second, sigma_v};
    const sr::Law &law = laws[out.hypothesis];
    const auto takes_second = [](const sr::Term &term) {
        return term.by_ratio || (term.kind != sr::Kind::walk && !term.stated);
    };
    const bool has_second = law.coloured_noise || std::any_of(law.terms.begin(), law.terms.end(), takes_second);
    if (!(sigma_v > 0.0) || (!law.terms.empty() && !(drift >= 0.0)) || (has_second && !(second > 0.0)))
        throw std::invalid_argument("sigma_v and alpha or a ratio must be positive, drift at least 0");
    return out;
}

std::vector<sr::Node> node_list(const std::vector<sr::Law> &laws, const Laws &hypothesis, const Vector &drift,
                                const Vector &second, const Vector &sigma_v) {
    const std::size_t m = hypothesis.shape(0);
    if (drift.shape(0) != m || second.shape(0) != m || sigma_v.shape(0) != m)
        throw std::invalid_argument("hypothesis, drift, second and sigma_v must have one length");
    std::vector<sr::Node> nodes;
    for (std::size_t j = 0; j < m; j++)
        nodes.push_back(node(laws, hypothesis(j), drift(j), second(j), sigma_v(j)));
    return nodes;
}

std::tuple<Output, Output, Output> run_filters(const Vector &y, double dt_s, double bias_mean, double bias_sd,
                                               const std::vector<LawTuple> &law_tuples, const Laws &hypothesis,
                                               const Vector &drift, const Vector &second, const Vector &sigma_v,
                                               const std::optional<Vector> &r, const std::optional<Columns> &z,
                                               const std::optional<Vector> &coefficient_sd, std::size_t block) {
    const std::vector<sr::Law> laws = laws_of(law_tuples);
    const std::vector<sr::Node> nodes = node_list(laws, hypothesis, drift, second, sigma_v);
    for (const sr::Node &one : nodes)
        if (sr::order(laws[one.hypothesis], block) != sr::order(laws[nodes[0].hypothesis], block))
            throw std::invalid_argument("the laws of one call must have as many states each");
    const sr::Record rec = record(y, r, dt_s, bias_mean, bias_sd, z, coefficient_sd, block);
    std::vector<sr::Filtered> filtered;
    {
        nb::gil_scoped_release release;
        filtered = sr::run_filters(rec, laws, nodes);
    }
    const std::size_t size = (nodes.empty() ? 1 : sr::order(laws[nodes[0].hypothesis], block)) + 1 + rec.regressors;
    const Array<double> ln_p({nodes.size()}), mean({nodes.size(), size}), covariance({nodes.size(), size, size});
    for (std::size_t j = 0; j < nodes.size(); j++) {
        ln_p.data()[j] = filtered[j].ln_p;
        std::copy_n(filtered[j].mean.data(), size, mean.data() + size * j);
        std::copy_n(filtered[j].covariance.data(), size * size, covariance.data() + size * size * j); // symmetric
    }
    return {ln_p.numpy(), mean.numpy(), covariance.numpy()};
}

std::tuple<Output, Output, Output, Output, Output, Output>
run_bank(const Vector &y, double dt_s, double bias_mean, double bias_sd, const std::vector<LawTuple> &law_tuples,
         const Laws &hypothesis, const Vector &drift, const Vector &second, const Vector &sigma_v,
         const std::vector<double> &ln_prior, const std::vector<std::size_t> &after, const std::optional<Vector> &r,
         const std::optional<Columns> &z, const std::optional<Vector> &coefficient_sd, std::size_t block) {
    const std::vector<sr::Law> laws = laws_of(law_tuples);
    const std::vector<sr::Node> nodes = node_list(laws, hypothesis, drift, second, sigma_v);
    if (ln_prior.size() != nodes.size())
        throw std::invalid_argument("ln_prior must have one value a node");
    for (std::size_t m = 0; m < after.size(); m++)
        if (after[m] > y.shape(0) || (m > 0 && after[m] < after[m - 1]))
            throw std::invalid_argument("after must ascend and stay within the record");
    const sr::Record rec = record(y, r, dt_s, bias_mean, bias_sd, z, coefficient_sd, block);
    std::vector<sr::Posterior> posterior;
    {
        nb::gil_scoped_release release;
        posterior = sr::run_bank(rec, laws, nodes, ln_prior, after);
    }
    const std::size_t t = posterior.size(), k = laws.size();
    const Array<double> weight({t, nodes.size()}), probability({t, k}), mean({t, k, 3}), covariance({t, k, 3, 3}),
        bias_mean_now({t, k}), bias_var_now({t, k});
    for (std::size_t m = 0; m < t; m++) {
        const sr::Posterior &p = posterior[m];
        std::copy(p.weight.begin(), p.weight.end(), weight.data() + m * nodes.size());
        std::copy(p.probability.begin(), p.probability.end(), probability.data() + m * k);
        std::copy(p.bias_mean.begin(), p.bias_mean.end(), bias_mean_now.data() + m * k);
        std::copy(p.bias_var.begin(), p.bias_var.end(), bias_var_now.data() + m * k);
        for (std::size_t h = 0; h < k; h++) {
            Eigen::Map<Eigen::Vector3d>(mean.data() + (m * k + h) * 3) = p.mean[h];
            Eigen::Map<Eigen::Matrix3d>(covariance.data() + (m * k + h) * 9) = p.covariance[h];
        }
    }
    return {weight.numpy(),     probability.numpy(),   mean.numpy(),
            covariance.numpy(), bias_mean_now.numpy(), bias_var_now.numpy()};
}

Output innovations(const Vector &y, double dt_s, double bias_mean, double bias_sd, const LawTuple &law, double drift,
                   double second, double sigma_v, const std::optional<Vector> &r, const std::optional<Columns> &z,
                   const std::optional<Vector> &coefficient_sd, std::size_t block) {
    const std::vector<sr::Law> laws = laws_of({law});
    const sr::Node one = node(laws, 0, drift, second, sigma_v);
    const sr::Record rec = record(y, r, dt_s, bias_mean, bias_sd, z, coefficient_sd, block);
    const Array<double> out({rec.n});
    {
        nb::gil_scoped_release release;
        sr::run_filter(rec, laws[0], one, out.data());
    }
    return out.numpy();
}

std::tuple<Output, Output, Output, nb::ndarray<nb::numpy, bool>, std::vector<double>>
simulate(const sr::Scene &scene, const std::vector<sr::Axis> &axes, nb::object added) {
    if (!(scene.rate_hz > 0.0) || scene.block < 1 || scene.filter_taps < 1)
        throw std::invalid_argument("rate_hz, block and filter_taps must be positive");
    for (const sr::Axis &axis : axes)
        if (axis.cross_axis >= axes.size())
            throw std::invalid_argument("cross_axis is not an axis");
    sr::Simulated simulated;
    {
        nb::gil_scoped_release release;
        // A callable gets the readings [axes][samples], the temperature and the supply, and adds to the first.
        const sr::Added own = [&](sr::Simulated &made) {
            const nb::gil_scoped_acquire acquire;
            const std::size_t length = scene.samples;
            const Array<double> values({axes.size(), length}), temperature({length}), supply({length});
            for (std::size_t a = 0; a < axes.size(); a++)
                std::copy(made.axes[a].begin(), made.axes[a].end(), values.data() + a * length);
            std::copy(made.temperature.begin(), made.temperature.end(), temperature.data());
            std::copy(made.supply.begin(), made.supply.end(), supply.data());
            added(values.numpy(), temperature.numpy(), supply.numpy());
            for (std::size_t a = 0; a < axes.size(); a++)
                std::copy_n(values.data() + a * length, length, made.axes[a].begin());
        };
        simulated = sr::simulate(scene, axes, added.is_none() ? sr::Added{} : own);
    }
    const std::size_t n = scene.samples;
    const Array<double> values({axes.size(), n}), temperature({n}), supply({n});
    const Array<bool> present({n});
    for (std::size_t a = 0; a < axes.size(); a++)
        std::copy(simulated.axes[a].begin(), simulated.axes[a].end(), values.data() + a * n);
    std::copy(simulated.temperature.begin(), simulated.temperature.end(), temperature.data());
    std::copy(simulated.supply.begin(), simulated.supply.end(), supply.data());
    for (std::size_t i = 0; i < n; i++)
        present.data()[i] = simulated.present[i] != 0;
    return {values.numpy(), temperature.numpy(), supply.numpy(), present.numpy(), simulated.bias_now};
}

} // namespace

NB_MODULE(_reference, m) {
    using namespace nb::literals;
    m.doc() = "The textbook bank of Stepanov & Motorin (2017) and the simulator (host_sim).";
    m.def("run_filters", &run_filters, "y"_a, "dt_s"_a, "bias_mean"_a, "bias_sd"_a, "laws"_a, "hypothesis"_a, "drift"_a,
          "second"_a, "sigma_v"_a, "r"_a = nb::none(), "z"_a = nb::none(), "coefficient_sd"_a = nb::none(),
          "block"_a = 1);
    m.def("run_bank", &run_bank, "y"_a, "dt_s"_a, "bias_mean"_a, "bias_sd"_a, "laws"_a, "hypothesis"_a, "drift"_a,
          "second"_a, "sigma_v"_a, "ln_prior"_a, "after"_a, "r"_a = nb::none(), "z"_a = nb::none(),
          "coefficient_sd"_a = nb::none(), "block"_a = 1);
    m.def("innovations", &innovations, "y"_a, "dt_s"_a, "bias_mean"_a, "bias_sd"_a, "law"_a, "drift"_a, "second"_a,
          "sigma_v"_a, "r"_a = nb::none(), "z"_a = nb::none(), "coefficient_sd"_a = nb::none(), "block"_a = 1);

    nb::class_<sr::Scene>(m, "Scene")
        .def(nb::init<>())
        .def_rw("seed", &sr::Scene::seed)
        .def_rw("rate_hz", &sr::Scene::rate_hz)
        .def_rw("samples", &sr::Scene::samples)
        .def_rw("block", &sr::Scene::block)
        .def_rw("filter_taps", &sr::Scene::filter_taps)
        .def_rw("bank_block", &sr::Scene::bank_block)
        .def_rw("missing", &sr::Scene::missing)
        .def_rw("motion_intervals", &sr::Scene::motion_intervals)
        .def_rw("motion_times", &sr::Scene::motion_times);
    nb::class_<sr::Axis>(m, "Axis")
        .def(nb::init<>())
        .def_prop_rw(
            "law", [](const sr::Axis &axis) { return tuple_of(axis.law); },
            [](sr::Axis &axis, const LawTuple &law) { axis.law = law_of(law); })
        .def_rw("bias", &sr::Axis::bias)
        .def_rw("N", &sr::Axis::N)
        .def_rw("drift", &sr::Axis::drift)
        .def_rw("second", &sr::Axis::second)
        .def_rw("range", &sr::Axis::range)
        .def_rw("lsb", &sr::Axis::lsb)
        .def_rw("temperature_coefficient", &sr::Axis::temperature_coefficient)
        .def_rw("supply_coefficient", &sr::Axis::supply_coefficient)
        .def_rw("ramp_slope", &sr::Axis::ramp_slope)
        .def_rw("step_time_s", &sr::Axis::step_time_s)
        .def_rw("step_amplitude", &sr::Axis::step_amplitude)
        .def_rw("periodic_frequency_hz", &sr::Axis::periodic_frequency_hz)
        .def_rw("periodic_amplitude", &sr::Axis::periodic_amplitude)
        .def_rw("flicker_B", &sr::Axis::flicker_B)
        .def_rw("noise_lag1", &sr::Axis::noise_lag1)
        .def_rw("variance_time_s", &sr::Axis::variance_time_s)
        .def_rw("variance_duration_s", &sr::Axis::variance_duration_s)
        .def_rw("noise_ratio", &sr::Axis::noise_ratio)
        .def_rw("outlier_fraction", &sr::Axis::outlier_fraction)
        .def_rw("motion_amplitude", &sr::Axis::motion_amplitude)
        .def_rw("cross_axis", &sr::Axis::cross_axis)
        .def_rw("cross_coefficient", &sr::Axis::cross_coefficient);
    m.def("simulate", &simulate, "scene"_a, "axes"_a, "added"_a = nb::none());
    nb::class_<sr::Random>(m, "Random")
        .def(nb::init<std::uint64_t, std::uint64_t>(), "seed"_a, "stream"_a)
        .def("uniform", &sr::Random::uniform)
        .def("normal", &sr::Random::normal);
    m.attr("TEMPERATURE_LSB") = sr::temperature_lsb;
    m.attr("SUPPLY_LSB") = sr::supply_lsb;
}
