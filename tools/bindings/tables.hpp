// A model's tables, as Python hands them over (bank/library.py, firmware.py). They live as long as C looks at them.
#ifndef TABLES_HPP
#define TABLES_HPP

#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "selfcal.h"

using GridTuple = std::tuple<uint16_t, std::vector<double>>; // nodes, fit[nodes * nodes]
using AxisTuple = std::tuple<std::vector<double>, std::vector<double>, std::vector<int>, double, double, uint32_t>;
using PriorTuple = std::tuple<double, double, int, bool>;      // ln_min, ln_max, law, measured
using TermTuple = std::tuple<int, double, double, bool, bool>; // kind, deviation, bandwidth, stated, by_ratio
using LawTuple = std::tuple<std::vector<TermTuple>, bool>;     // terms, coloured_noise
using HypothesisTuple = std::tuple<LawTuple, double, std::optional<GridTuple>, std::optional<GridTuple>,
                                   std::vector<std::vector<PriorTuple>>>; // priors [axes][parameters], or none

// reference[p], coefficient_sd[axes * p], coefficient_mean[axes * p]
using RegressorsTuple = std::tuple<std::vector<float>, std::vector<float>, std::vector<float>>;

// Not an anonymous namespace: two builds of one name in one process would be the same type to nanobind.
namespace MODULE_NAME {

struct Grid {
    explicit Grid(const GridTuple &t)
        : fit(std::get<1>(t).begin(), std::get<1>(t).end()), grid{std::get<0>(t), fit.data()} {
        if (fit.size() != size_t{grid.nodes} * grid.nodes)
            throw std::invalid_argument("the spline matrix does not fit its nodes");
    }
    std::vector<selfcal_real_t> fit;
    selfcal_grid_t grid;
};

class Tables {
  public:
    Tables(double dt_s, uint32_t block, const std::vector<AxisTuple> &axes,
           const std::vector<HypothesisTuple> &hypotheses, uint32_t id,
           const std::optional<RegressorsTuple> &regressors, double half_life_s,
           const std::tuple<double, bool, bool> &handling) {
        for (const auto &[lo, hi, laws, bias_sd, range, stuck] : axes) {
            selfcal_axis_t axis{};
            if (lo.size() != SELFCAL_PARAMETERS || hi.size() != SELFCAL_PARAMETERS || laws.size() != SELFCAL_PARAMETERS)
                throw std::invalid_argument("an axis needs one prior a parameter");
            for (size_t p = 0; p < SELFCAL_PARAMETERS; p++)
                axis.prior[p] = {static_cast<float>(lo[p]), static_cast<float>(hi[p]),
                                 static_cast<selfcal_prior_law_t>(laws[p]), false};
            axis.bias_sd = static_cast<float>(bias_sd);
            axis.range = static_cast<float>(range);
            axis.stuck_limit = stuck;
            axes_.push_back(axis);
        }
        size_t nodes = 0;
        for (const auto &[law, ln_probability, rho, alpha, priors] : hypotheses) {
            const selfcal_hypothesis_t h{add(law), static_cast<float>(ln_probability), add(rho), add(alpha),
                                         add(priors)};
            const size_t count = size_t{h.rho ? h.rho->nodes : 1u} * (h.alpha ? h.alpha->nodes : 1u);
            nodes += count;
            term_nodes_ += selfcal_law_is_sum(h.law) ? count : 0;
            hypotheses_.push_back(h);
        }
        model_ = {id,
                  static_cast<float>(dt_s),
                  block,
                  static_cast<uint8_t>(axes_.size()),
                  static_cast<uint8_t>(hypotheses_.size()),
                  static_cast<uint16_t>(nodes),
                  axes_.data(),
                  hypotheses_.data(),
                  nullptr,
                  nullptr,
                  &selfcal_states_code,
                  nullptr};
        if (axes_.size() > SELFCAL_AXES_MAX || hypotheses_.size() > SELFCAL_HYPOTHESES_MAX || nodes > UINT16_MAX)
            throw std::invalid_argument("more axes, hypotheses or nodes than the library is built for");
        if (regressors) {
            std::tie(reference_, coefficient_sd_, coefficient_mean_) = *regressors;
            if (reference_.size() > SELFCAL_REGRESSORS_MAX ||
                coefficient_sd_.size() != axes_.size() * reference_.size() ||
                coefficient_mean_.size() != coefficient_sd_.size())
                throw std::invalid_argument("regressors need a reference each and a prior for every axis");
            regressors_ = {&selfcal_regressors_code,
                           static_cast<uint8_t>(reference_.size()),
                           reference_.data(),
                           coefficient_sd_.data(),
                           nullptr,
                           nullptr,
                           coefficient_mean_.data()};
            model_.regressors = &regressors_;
        }
        forgetting_ = {&selfcal_forgetting_code, static_cast<float>(half_life_s)};
        if (half_life_s != 0.0)
            model_.forgetting = &forgetting_;
        const auto [outlier_sd, steps, variance_changes] = handling;
        handling_ = {static_cast<float>(outlier_sd), steps, variance_changes};
        if (outlier_sd != 0.0 || steps || variance_changes)
            model_.handling = &handling_;
    }
    Tables(const Tables &) = delete;
    Tables &operator=(const Tables &) = delete;

  protected:
    const selfcal_law_t *add(const LawTuple &t) {
        const auto &[terms, coloured_noise] = t;
        if (terms.size() > SELFCAL_LAW_TERMS)
            throw std::invalid_argument("a law has at most " + std::to_string(SELFCAL_LAW_TERMS) + " terms");
        selfcal_law_t &law = *laws_.emplace_back(std::make_unique<selfcal_law_t>());
        law.coloured_noise = coloured_noise;
        for (const auto &[kind, deviation, bandwidth, stated, by_ratio] : terms)
            law.term[law.terms++] = {static_cast<selfcal_term_kind_t>(kind), static_cast<float>(deviation),
                                     static_cast<float>(bandwidth), stated, by_ratio};
        return &law;
    }

    const selfcal_grid_t *add(const std::optional<GridTuple> &t) {
        if (!t)
            return nullptr;
        grids_.push_back(std::make_unique<Grid>(*t));
        return &grids_.back()->grid;
    }

    const selfcal_prior_t *add(const std::vector<std::vector<PriorTuple>> &priors) {
        if (priors.empty())
            return nullptr;
        auto &table = priors_.emplace_back(std::make_unique<std::vector<selfcal_prior_t>>());
        for (const std::vector<PriorTuple> &axis : priors) {
            if (axis.size() != SELFCAL_PARAMETERS || priors.size() != axes_.size())
                throw std::invalid_argument("a hypothesis needs one prior a parameter for every axis, or none");
            for (const auto &[lo, hi, law, measured] : axis)
                table->push_back(
                    {static_cast<float>(lo), static_cast<float>(hi), static_cast<selfcal_prior_law_t>(law), measured});
        }
        return table->data();
    }

    std::vector<selfcal_axis_t> axes_;
    std::vector<selfcal_hypothesis_t> hypotheses_;
    std::vector<std::unique_ptr<selfcal_law_t>> laws_;
    std::vector<std::unique_ptr<Grid>> grids_;
    std::vector<std::unique_ptr<std::vector<selfcal_prior_t>>> priors_;
    size_t term_nodes_ = 0;
    std::vector<float> reference_, coefficient_sd_, coefficient_mean_;
    selfcal_regressors_t regressors_{};
    selfcal_forgetting_t forgetting_{};
    selfcal_handling_t handling_{};
    selfcal_model_t model_{};
};

} // namespace MODULE_NAME

#endif
