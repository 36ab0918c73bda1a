"""The library itself: the firmware's bank in float."""

from __future__ import annotations

from dataclasses import replace

from selfcal.bank.library import Bank
from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.studies.methods.problem import Answer, Problem, Value


def library(problem: Problem) -> Answer:
    """Posterior medians, 5 % and 95 % points, and the posterior probability of each law."""
    default = Model.load()
    share = 1.0 / len(problem.laws)
    model = replace(
        default, groups=(problem.group,), hypotheses=dict.fromkeys(problem.laws, share), regressors=(), half_life_s=0.0
    )
    rate = 1.0 / problem.dt_s
    bank = Bank(make_tables(model, rate, problem.group.axes[:1], bank_rate_hz=rate))
    bank.push(problem.y[:, None])
    report = bank.report(0)
    return Answer(
        {
            law: {name: Value(e.median, e.q05, e.q95) for name, e in estimates.items()}
            for law, estimates in report.parameters.items()
        },
        {"Bayes": report.probability},
    )
