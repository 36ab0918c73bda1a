"""The GPS/INS filter: no error without noise, consistent with the true noise, the flight by its own physics.

Truth: the flight in closed form, the simulated noise, and chi-squared.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from selfcal.bank.library import Bank
from selfcal.base.grid import Array
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.model.file import Model
from selfcal.model.simulated_parts import AXES, LAWS
from selfcal.model.tables import make_tables
from selfcal.studies.navigate import FIGURES, HORIZONS_S, TIMES, TITLES, identified_noise, matched, sheet_noise, show
from selfcal.studies.navigation import (
    GPS_S,
    JUDGED,
    LATENCY_SD_S,
    RATE_HZ,
    SCALE,
    TAKE_OFF_S,
    FilterNoise,
    Filters,
    Part,
    flight,
    nees,
    true_noise,
)
from selfcal.verbs.navigate import navigate

from conftest import run

Judged = list[tuple[Array, Array]]


def flown(part: Part, noise: FilterNoise) -> Judged:
    filters = Filters(noise, part)
    filters.rest()
    return filters.fly()


def test_the_flight_is_in_coordinated_turns() -> None:
    """A coordinated turn has no lateral force, and v w = g tan(bank). There is no turn before TAKE_OFF_S, and no
    height. Steps of 0.1 s shift rate and force by half a step: in swings of 60 s by 0.5 % of their greatest."""
    truth = flight()
    assert np.abs(truth.force[:, 1]).max() < 0.005 * STANDARD_GRAVITY
    still = slice(0, round(TAKE_OFF_S * RATE_HZ) - 1)
    assert np.abs(truth.rate[still]).max() < 1e-12
    middle = (truth.attitude[:-1] + truth.attitude[1:]) / 2.0
    turn = np.einsum("nj,nj->n", middle[:, 2], truth.rate)
    speed = np.linalg.norm(truth.velocity, axis=1)[:-1]
    tangent = -middle[:, 2, 1] / middle[:, 2, 2]
    assert np.abs(speed * turn / STANDARD_GRAVITY - tangent).max() < 0.005 * np.abs(tangent).max()
    assert np.abs(truth.position[:, 2]).max() == 0.0


@pytest.mark.parametrize("law", LAWS)
def test_without_errors_there_are_none(law: str) -> None:
    """Every reading is the truth. What is left is the rounding of 3600 steps over kilometres: 1e-16 of each."""
    for errors, _ in flown(Part.of(law, [1], noise=0.0), FilterNoise.of([true_noise(law)])):
        assert np.abs(errors).max() < 1e-8


def test_the_latency_is_found() -> None:
    """Positions of 0.15 s earlier and no other error. The prior keeps the share of the error that its variance is of
    the stated one's, 8 ms. The filter takes the velocity for constant over the latency: of 4 m/s^2 that is 0.05 m, of
    20 m/s 2 ms."""
    part = Part.of("constant", [1], noise=0.0)
    t = np.arange(len(flight().position)) / RATE_HZ
    heard = np.stack([np.interp(np.arange(GPS_S) - 0.15, t, axis) for axis in flight().position.T], axis=1)
    late = replace(part, gps=heard[None], latency=np.array([[0.15]]))
    errors, covariance = flown(late, FilterNoise.of([true_noise("constant")]))[0]
    assert errors[0, -1] == pytest.approx(0.15 * covariance[0, -1, -1] / LATENCY_SD_S**2, abs=0.002)
    assert covariance[0, -1, -1] < (0.3 * LATENCY_SD_S) ** 2


def test_consistent_with_the_true_noise_alone() -> None:
    """50 parts of each law, seeds 1 to 50. With the true noise the mean NEES of all 150 lies in the 95 % band of
    chi-squared. The parts' drifts are larger than the data sheet's, ten times its noise is larger than theirs."""
    seeds, mean = range(1, 51), {}
    for name in ("true", "sheet", "inflated"):
        found: list[list[Array]] = []
        for law in LAWS if name == "true" else ("random_walk",):
            noise = {"true": true_noise(law), "sheet": sheet_noise(), "inflated": sheet_noise(10.0)}[name]
            judged = flown(Part.of(law, seeds), FilterNoise.of([noise] * len(seeds)))
            found.append([nees(*one) for one in judged])
        mean[name] = np.concatenate(found, axis=1).mean(axis=1)
    count = len(LAWS) * len(seeds)
    low, high = stats.chi2.ppf([0.025, 0.975], JUDGED * count) / count
    assert ((low < mean["true"]) & (mean["true"] < high)).all()
    assert (mean["sheet"] > 1.5 * high).all() and (mean["inflated"] < low / 1.5).all()


def test_what_the_bank_identifies_for_it() -> None:
    """The medians after half an hour: N within 7 %, four of its sd 1 / sqrt(2 n)."""
    part = Part.of("constant", [3])
    for found, true in zip(identified_noise(part.rest[0] / SCALE), true_noise("constant"), strict=True):
        assert found["N"] == pytest.approx(true["N"], rel=0.07)


@pytest.mark.parametrize("alpha", (1.0 / 90.0, 1.0 / 700.0))
def test_the_drift_of_predicted_variances(alpha: float) -> None:
    """Variances of a Gauss-Markov drift give its parameters, those of a walk its K."""
    now, variance = 0.3, 2.0
    later = [variance - (variance - now) * math.exp(-2.0 * alpha * ahead) for ahead in HORIZONS_S]
    found = matched(now, *later)
    assert (found["sigma_m"] ** 2, found["alpha"]) == (pytest.approx(variance), pytest.approx(alpha))
    assert matched(now, *(now + 0.01 * ahead for ahead in HORIZONS_S)) == {"K": pytest.approx(0.1)}


def test_the_identified_drift_is_as_uncertain_as_the_bank_states() -> None:
    """A walk and the bank's variance of its bias 60 and 360 s ahead, of all laws: the filter's drift has the same.
    A walk has one parameter, so that it has the far one alone."""
    rest = Part.of("random_walk", [4]).rest[0] / SCALE
    bank = Bank(make_tables(Model.load(), 1.0, tuple(AXES), bank_rate_hz=1.0))
    bank.push(rest)
    for k, found in enumerate(identified_noise(rest)):
        now, *later = (bank.report(k, ahead_s=ahead).bias_sd ** 2 for ahead in (0.0, *HORIZONS_S))
        assert now > 0.0
        for ahead, variance, tolerance in zip(HORIZONS_S, later, (0.02, 1e-3), strict=True):
            kept, grown = FilterNoise.of([[found] * len(AXES)]).step(ahead)
            assert kept[0, k] ** 2 * now + grown[0, k] / SCALE[k] ** 2 == pytest.approx(variance, rel=tolerance)


def test_the_document(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    document = navigate(records=2, json=out)
    assert json.loads(out.read_text()) == document
    show(document)
    assert list(document["laws"]) == list(LAWS)
    for filters in document["laws"].values():
        assert list(filters) == list(TITLES)
        for times in filters.values():
            assert {time: list(figures) for time, figures in times.items()} == {time: list(FIGURES) for time in TIMES}
            assert times["after_outage"]["position_m"] > times["with_gps"]["position_m"] > 0.0
    done = run("navigate", "--records", "1")
    assert (done.returncode, done.stderr) == (2, "selfcal: error: --records must be at least 2\n")
