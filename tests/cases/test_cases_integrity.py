"""Readings that are none, and clocks that change: found in the raw readings, whatever the rate they are averaged to.

Truth: what was done to records of known noise. Shares of intervals that hold the truth have binomial limits: 90 % less
the 5 % that are allowed, less three standard deviations of the share. A few records are held to 5 sd instead.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from selfcal.adequacy.identify import identify_axis
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.loop import diagnose_record
from selfcal.diagnosis.record import record_from
from selfcal.logs.recording import Column, Recording, load, save
from selfcal.logs.sampling import rate_changes, sampling
from selfcal.model.file import Model
from selfcal.readings.changed_words import misread_of
from selfcal.readings.held import held_of as held_rows
from selfcal.readings.lattice import lattice_of
from selfcal.readings.lost_words import recurring_of
from selfcal.readings.readings import evened, look
from selfcal.verbs.diagnose import diagnose

from conftest import case_records, run, shared_case, shared_recording

Array = NDArray[np.float64]
MODEL = Model.load(None)
GYRO = MODEL.group_of("gx")
#: Median, 5 % and 95 % of a posterior in standard deviations.
HALF_90 = 1.645


def a_recording(values: Array, rate_hz: float, time: Array | None = None, axis: str = "gx") -> Recording:
    """One axis, deg/s, on an even grid or with the stamps `time`."""
    missing, off = np.zeros(values.size, np.int64), None
    if time is not None:
        step, missing = sampling(time, 1e-9, None)
        off = time - (np.arange(time.size) + np.cumsum(missing)) * step
        rate_hz = 1.0 / step
    return Recording(Path("a"), rate_hz, {axis: Column(axis, "deg/s", values)}, missing, {}, off)


def noise(random: np.random.Generator, n: int, rate_hz: float, K: float = 0.0) -> tuple[Array, Array]:
    """Readings of N 0.04 deg/s/sqrt(Hz) about a bias, and the bias with its walk."""
    bias = random.uniform(-5.0, 5.0) + np.cumsum(random.normal(size=n)) * K / math.sqrt(rate_hz)
    return bias + 0.04 * math.sqrt(rate_hz) * random.normal(size=n), bias


class Held:
    """Counts how often the 90 % intervals of `identify` hold the truth."""

    def __init__(self) -> None:
        self.held: dict[str, list[bool]] = {}
        self.far = 0.0

    def add(self, recording: Recording, bias: float, N: float, K: float = 0.0) -> dict[str, bool]:
        """The checks of the axis that failed."""
        found = identify_axis(recording, "gx", MODEL, "library", None)
        estimates = found.result.parameters["random_walk" if K else "constant"]
        for name, truth in (("N", N), ("K", K)):
            if truth and (one := estimates[name]).identified:
                self.held.setdefault(name, []).append(one.q05 <= truth <= one.q95)
                off = math.log(truth / one.median) / math.log((one.q95 if truth > one.median else one.q05) / one.median)
                self.far = max(self.far, HALF_90 * off if name == "N" else 0.0)
        distance = abs(found.result.bias_mean - bias) / found.result.bias_sd
        self.held.setdefault("bias", []).append(distance < HALF_90)
        self.far = max(self.far, distance)
        return {name: True for name, check in found.judged.checks.items() if not check["passed"]}

    def check(self) -> None:
        assert self.far < 5.0 or len(self.held["bias"]) >= 100
        for name, held in self.held.items():
            if len(held) >= 100:
                least = 0.85 - 3.0 * math.sqrt(0.85 * 0.15 / len(held))
                assert np.mean(held) > least, name


def judged(recording: Recording) -> Diagnosed:
    """What the diagnosis finds, without a library's warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return diagnose_record(record_from(recording, MODEL), ["gx"])["gx"]


def causes(one: Mapping[str, Any]) -> list[str]:
    """Of an axis of the document."""
    return [finding["cause"] for finding in one["findings"]]


# ------------------------------------------------------------------------------------------------------------- lattice

FORMS: dict[str, Callable[[Array], Array]] = {
    "8 digits": lambda y: np.array([float(f"{value:.8g}") for value in y]),
    "6 digits": lambda y: np.array([float(f"{value:.6g}") for value in y]),
    "5 digits": lambda y: np.array([float(f"{value:.5g}") for value in y]),
    "float32": lambda y: y.astype(np.float32).astype(np.float64),
}


@pytest.mark.parametrize("form", FORMS)
def test_the_digits_of_a_number_are_no_lattice(form: str) -> None:
    """Spacing that changes with the size of the reading: clean records about 0 to 10 at 1 to 100 Hz show nothing."""
    records, wrong = case_records(1, 200), 0
    for seed in range(records):
        random = np.random.default_rng([1, seed, len(form)])
        rate = float(random.choice([1.0, 10.0, 100.0]))
        y, bias = noise(random, 2500, rate, 2e-4)
        level = float(random.choice([-0.02, 0.0, 0.97, 1.01, 9.81, -9.99]))
        wrong += bool(judged(a_recording(FORMS[form](y - bias[0] + level), rate)).findings)
    assert wrong <= max(0, records // 200)


@pytest.mark.parametrize("block", [2, 5, 10, 16])
def test_means_of_readings_on_a_lattice_are_judged_by_it(block: int) -> None:
    """Means of `block` readings, as sums in floating point: their lattice is a part of the first one's. Truth: the
    noise is white, and no statistic of the lattice stands out. A coarse lattice is one to be told of."""
    records, wrong = case_records(1, 200), 0
    for seed in range(records):
        random = np.random.default_rng([2, seed, block])
        rate = float(random.choice([1.0, 10.0, 100.0]))
        y, _ = noise(random, 2500 * block, rate * block)
        q = 0.04 * math.sqrt(rate * block) * random.uniform(0.1, 1.8)
        means = (np.rint(y / q) * q).reshape(-1, block).mean(axis=1)
        wrong += any(finding.look.cause != "quantization" for finding in judged(a_recording(means, rate)).findings)
    assert wrong <= max(0, records // 200)


def test_the_means_of_the_real_runs_show_no_lattice_statistic() -> None:
    """Ten-sample means of a run whose readings lie on 0.05 deg/s: 2000 s, one axis (make cases: every axis, 4000 s).
    Judged against the plain drift; before they were judged by their own lattice they stood out by 1e-9 to 1e-130."""
    from selfcal.diagnosis.statistics import judged as statistics

    long = bool(case_records(0, 1))
    for number in (1, 2, 4) if long else (2,):
        recorded = shared_recording(f"adis16405_run{number}.npz")
        n = 400_000 if long else 200_000
        columns = {
            name: replace(one, values=one.values[:n].reshape(-1, 10).mean(axis=1))
            for name, one in recorded.columns.items()
            if long or name == "gx"
        }
        means = replace(recorded, rate_hz=10.0, columns=columns, missing_before=np.zeros(n // 10, np.int64))
        keys = ("repeated_readings", "equal_readings", "longest_repeat", "odd_even_codes")
        for name, state in record_from(means, MODEL).axes.items():
            rows = {row.name: row.p for row in statistics(state.refit(), count=24).statistics}
            assert min(rows[key] for key in keys if key in rows) > 1e-6, (number, name)


def test_a_dead_band_is_told_of_without_a_warning() -> None:
    """Readings near one value read as that value, on no lattice. Nothing claims most of the samples as exceptions."""
    for width in (0.3, 2.5):
        y, bias = noise(np.random.default_rng(3), 2500, 10.0)
        y = np.where(np.abs(y - bias[0]) < width * 0.04 * math.sqrt(10.0), bias[0], y)
        found = judged(a_recording(y, 10.0)).findings
        assert found, width
        assert "outliers" not in [finding.look.cause for finding in found]


# ------------------------------------------------------------------------------------------------------------ clipping


@pytest.mark.parametrize(
    ("share", "both", "rate", "q", "K"),
    [(0.05, False, 100.0, 0.0, 0.0), (0.2, True, 50.0, 0.0, 4e-3), (0.38, False, 20.0, 0.09, 4e-3),
     (0.6, False, 100.0, 0.0, 0.0)],
)  # fmt: skip
def test_clipped_readings_are_said_and_spoil_nothing(share: float, both: bool, rate: float, q: float, K: float) -> None:
    """A share of the readings is at the part's own rail, or at two: N, K and the bias are those of the unclipped."""
    held = Held()
    for seed in range(case_records(3, 120)):
        random = np.random.default_rng([4, seed, round(100 * share)])
        y, bias = noise(random, round(400 * rate), rate, K)
        sign = random.choice([-1.0, 1.0])
        limits = [float(np.quantile(sign * y, 0.1)) if both else -math.inf, float(np.quantile(sign * y, 1.0 - share))]
        if q:
            y, limits = (
                np.rint(y / q) * q,
                [q * round(limit / q) if math.isfinite(limit) else limit for limit in limits],
            )
        y = sign * np.clip(sign * y, *limits)
        N = math.sqrt(0.04**2 + q * q / 12.0 / rate)
        assert "saturation" in held.add(a_recording(y, rate), float(bias[-1]), N, K)
        found = look(a_recording(y, rate), "gx", GYRO).clipped
        assert found is not None
        assert len(found.limits) == 1 + both
        assert sign * limits[1] == pytest.approx(max(found.limits, key=lambda limit: sign * limit), abs=1e-9)
    held.check()


@pytest.mark.parametrize(
    ("share", "rate", "q", "at", "K"),
    [(0.02, 100.0, 0.05, 0.0, 0.0), (0.004, 50.0, 0.0, 0.0, 4e-3), (0.09, 20.0, 0.01, -7.5, 4e-3),
     (0.15, 100.0, 0.0, 32.768, 0.0)],
)  # fmt: skip
def test_lost_words_are_named_and_spoil_nothing(share: float, rate: float, q: float, at: float, K: float) -> None:
    """A share of the readings is one value, 8 times the noise from the bias or farther: the mask is those rows, and
    N, K and the bias are those of the others. `diagnose` names them in means, and at the full rate."""
    held = Held()
    for seed in range(case_records(2, 120)):
        random = np.random.default_rng([14, seed, round(1000 * share)])
        y, bias = noise(random, round(400 * rate), rate, K)
        far = 8.0 * 0.04 * math.sqrt(rate)
        y, bias = (one + (at + math.copysign(far, bias[-1] - at) - bias[-1] if abs(bias[-1] - at) < far else 0.0)
                   for one in (y, bias))  # fmt: skip
        y = np.rint(y / q) * q if q else y
        lost = random.uniform(size=y.size) < share
        y[lost] = at
        recording = a_recording(y, rate)
        assert "outliers" in held.add(recording, float(bias[-1]), math.sqrt(0.04**2 + q * q / 12.0 / rate), K)
        found = look(recording, "gx", GYRO).recurring
        assert found is not None and found.value == at
        np.testing.assert_array_equal(found.mask, lost)
        if seed == 0:
            for decimate in (1.0, None) if rate < 50.0 or case_records(0, 1) else (1.0,):
                one = diagnose_record(record_from(recording, MODEL, decimate), ["gx"])["gx"]
                assert [finding.look.cause for finding in one.findings] == ["outliers"]
    held.check()


@pytest.mark.parametrize(
    ("share", "rate", "q", "off", "K"),
    [(0.02, 100.0, 0.0, 4.0, 0.0), (0.1, 100.0, 0.4, 4.0, 0.0), (0.02, 50.0, 0.1, 3.0, 4e-3),
     (0.05, 100.0, 1e-3, 1.5, 4e-3), (0.03, 100.0, 0.3, 2.0, 0.0), (0.01, 20.0, 0.05, 4.5, 4e-3),
     (0.05, 100.0, 0.2, 1.0, 4e-3)],
)  # fmt: skip
@pytest.mark.parametrize("word", [0.0, 0.6])
def test_lost_words_within_the_noise_are_left_out(
    share: float, rate: float, q: float, off: float, K: float, word: float
) -> None:
    """A share of the readings is one value, less than 5 times the noise from the bias, on a lattice to the noise or
    none: as many are left out as were lost, to 15 % and four standard deviations of the noise's own count."""
    held, missed, records = Held(), 0, case_records(2, 60)
    for seed in range(records):
        random = np.random.default_rng([22, seed, round(100 * off)])
        y, bias = noise(random, round(400 * rate), rate, K)
        shift = word - bias[0] + off * 0.04 * math.sqrt(rate) * random.choice([-1.0, 1.0])
        y, bias = y + shift, bias + shift
        y = np.rint(y / q) * q if q else y
        value = y[np.argmin(np.abs(y - word))] if q else word
        own = np.count_nonzero(y == value)
        lost = random.uniform(size=y.size) < share
        y[lost] = value
        recording = a_recording(y, rate)
        failed = held.add(recording, float(bias[-1]), math.sqrt(0.04**2 + q * q / 12.0 / rate), K)
        found = look(recording, "gx", GYRO).recurring
        if found is None:
            missed += 1
            continue
        assert "outliers" in failed and found.value == value
        left_out, truth = np.count_nonzero(found.mask), np.count_nonzero(lost)
        assert abs(left_out - truth) < 0.15 * truth + 4.0 * math.sqrt(own)
    assert missed <= records // 20
    held.check()


@pytest.mark.parametrize(
    ("share", "q", "off", "K"),
    [(0.37, 0.0, 0.4, 0.0), (0.42, 0.015, 1.2, 4e-3), (0.46, 0.03, 0.8, 0.0), (0.47, 0.0, 2.5, 4e-3),
     (0.4, 0.02, 12.0, 0.0), (0.13, -0.03, 0.3, 0.0), (0.45, -0.03, 1.0, 4e-3)],
)  # fmt: skip
def test_lost_words_of_up_to_half_are_left_out(share: float, q: float, off: float, K: float) -> None:
    """One value, `off` times the noise from the bias, on the lattice `q` of the others or, where it is negative, beside
    it: N, K and the bias are those of the others."""
    held = Held()
    for seed in range(case_records(3, 120)):
        random = np.random.default_rng([41, seed, round(100 * share)])
        y, bias = noise(random, 9000, 20.0, K)
        step = abs(q)
        y = np.rint(y / step) * step if q else y
        value = float(bias[0] + off * 0.04 * math.sqrt(20.0))
        value = step * (round(value / step) + (0.4 if q < 0.0 else 0.0)) if q else value
        y[random.uniform(size=y.size) < share] = value
        recording = a_recording(y, 20.0)
        assert "outliers" in held.add(recording, float(bias[-1]), math.sqrt(0.04**2 + q * q / 12.0 / 20.0), K)
        found = look(recording, "gx", GYRO)
        assert found.clipped is None and found.recurring is not None
        assert found.recurring.value == pytest.approx(value, abs=1e-9)
        assert found.recurring.share == pytest.approx(share, abs=5.0 * math.sqrt(0.25 / y.size))
    held.check()


@pytest.mark.parametrize("share", [0.55, 0.62, 0.72, 0.88])
def test_lost_words_of_more_than_half_are_flagged(share: float) -> None:
    """Either the value or the others may be the noise: none is left out, and the check `outliers` fails."""
    for seed in range(case_records(2, 60)):
        random = np.random.default_rng([42, seed])
        y, bias = noise(random, 9000, 20.0, random.choice([0.0, 4e-3]))
        y[random.uniform(size=y.size) < share] = bias[0] + 0.1
        found = identify_axis(a_recording(y, 20.0), "gx", MODEL, "library", None)
        assert not found.judged.checks["outliers"]["passed"]
        assert found.judged.checks["outliers"]["value"] == pytest.approx(share, abs=0.03)
        recurring = look(a_recording(y, 20.0), "gx", GYRO).recurring
        assert recurring is not None and not recurring.mask.any()
        look_at = judged(a_recording(y, 20.0))
        assert "outliers" in [finding.look.cause for finding in look_at.findings]


#: One value that holds a large share of the readings, and is no lost word: noise, level, random numbers -> readings.
COMMON: dict[str, Callable[[Array, float, np.random.Generator], Array]] = {
    "coarse": lambda y, at, random: np.rint((y - at) / (q := random.uniform(1.5, 3.0)) + random.uniform(-0.1, 0.1)) * q,
    "dead band": lambda y, at, random: np.where(np.abs(y - at) < random.uniform(0.3, 2.0), at, y),
    "dead band of codes": lambda y, at, random: np.where(np.abs(y - at) < random.uniform(0.3, 2.0), at, y) // 0.1 * 0.1,
    "held": lambda y, at, random: np.rint(y[np.cumsum(random.random(y.size) < 0.5)] / 0.2) * 0.2,
    "frozen": lambda y, at, random: np.where(np.abs(np.arange(y.size) - 4000) < random.uniform(800, 2500), y[4000], y),
    "clipped": lambda y, at, random: np.minimum(y, np.quantile(y, random.uniform(0.4, 0.85))),
    "clipped codes": lambda y, at, random: np.rint(np.maximum(y, at - random.uniform(-0.3, 1.5)) / 0.3) * 0.3,
}


@pytest.mark.parametrize("kind", COMMON)
def test_a_common_value_is_no_lost_word(kind: str) -> None:
    records, fired = case_records(6, 200), 0
    for seed in range(records):
        random = np.random.default_rng([43, seed])
        at = random.uniform(-20.0, 20.0)
        y = at + np.cumsum(random.choice([0.0, 2e-3]) * random.normal(size=9000)) + random.normal(size=9000)
        fired += look(a_recording(0.1 * COMMON[kind](y, at, random), 20.0), "gx", GYRO).recurring is not None
    assert fired <= records // 200


def test_clipping_on_a_lattice_coarser_than_the_noise_is_named() -> None:
    """A third of the readings in the last code of three or more, and its clean twin of as coarse codes."""
    records, named, fired = case_records(8, 200), 0, 0
    for seed in range(records):
        random = np.random.default_rng([44, seed])
        q = random.uniform(1.5, 1.8)
        y = random.uniform(0.0, q) + np.cumsum(random.choice([0.0, 1e-3]) * random.normal(size=9000))
        y += random.normal(size=9000)
        limit = q * round(float(np.quantile(y, 0.67)) / q)
        clipped = np.minimum(np.rint(y / q) * q, limit)
        assert np.unique(clipped).size >= 3
        found = look(a_recording(0.1 * clipped, 20.0), "gx", GYRO).clipped
        named += found is not None and found.limit == pytest.approx(0.1 * limit)
        fired += look(a_recording(0.1 * np.rint(y / q * 0.6) * q / 0.6, 20.0), "gx", GYRO).clipped is not None
    assert named >= records - records // 50
    assert fired <= records // 200


def test_the_codes_of_the_real_runs_are_no_lost_words() -> None:
    for number in (1, 2, 4):
        recorded = shared_recording(f"adis16405_run{number}.npz")
        for name in recorded.columns if case_records(0, 1) else ("gx", "az"):
            if name in MODEL.axes:
                y = recorded.columns[name].values[:200_000]
                explained = misread_of(y, lattice_of(y, recorded.rate_hz))
                assert recurring_of(y, explained) is None, (number, name)


#: What moves readings far off, and is no lost word: n, noise, random numbers -> what is added.
FAR: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "nothing": lambda n, random: np.zeros(n),
    "step": lambda n, random: 20.0 * (np.arange(n) > n // 2),
    "motion": lambda n, random: 60.0 * np.sin(np.arange(n) / 9.0) * (np.abs(np.arange(n) - n // 3) < 300),
    "line": lambda n, random: 30.0 * np.sin(0.082 * np.arange(n)),
    "outliers": lambda n, random: np.where(random.uniform(size=n) < 0.02, 15.0 * random.normal(size=n), 0.0),
    "tails": lambda n, random: random.standard_t(3, n),
    "two levels": lambda n, random: 8.0 * (np.arange(n) // 1700 % 2),
}


@pytest.mark.parametrize("kind", FAR)
def test_far_readings_are_not_taken_for_lost_words(kind: str) -> None:
    """On fine and coarse lattices and without one, with few digits, clipped at the rails of the part in motion: at most
    1 of 200 records."""
    records, fired = case_records(6, 200), 0
    for seed in range(records):
        random = np.random.default_rng([15, seed])
        n = int(random.choice([3000, 20_000, 60_000]))
        drift = np.cumsum(random.choice([0.0, 1e-3, 1e-2]) * random.normal(size=n))
        y = random.uniform(-30.0, 30.0) + random.normal(size=n) + drift + FAR[kind](n, random)
        if kind in ("motion", "two levels"):
            y = np.clip(y, *np.quantile(y, [0.002, 0.998]))
        q = float(random.choice([0.0, 0.05, 0.3, 1.0, 2.0, 3.0]))
        y = np.rint(y / q) * q if q else y
        y = 0.37 * (np.array([float(f"{value:.4g}") for value in y]) if seed % 4 == 0 else y)
        fired += look(a_recording(y, 100.0), "gx", GYRO).recurring is not None
    assert fired <= records // 200


def test_clipping_at_the_models_range_is_clipping_too() -> None:
    """A range that the model states: readings at it are clipped, and those beyond it are none."""
    y, bias = noise(np.random.default_rng(5), 40_000, 100.0)
    limit = abs(float(bias[0])) + 0.1
    model = replace(MODEL, groups=tuple(replace(group, range=limit) for group in MODEL.groups))
    found = identify_axis(a_recording(np.clip(y, -limit, limit), 100.0), "gx", model, "library", None)
    assert abs(found.result.bias_mean - bias[0]) < 4.0 * found.result.bias_sd
    N = found.result.parameters["constant"]["N"]
    assert abs(N.median - 0.04) < 4.0 * N.sd
    assert not found.judged.checks["saturation"]["passed"]


@pytest.mark.parametrize("decimate", [1.0, 10.0] if case_records(0, 1) else [1.0])
def test_the_diagnosis_names_clipping_at_every_rate(decimate: float, tmp_path: Path) -> None:
    """38 % of the readings at the part's rail, far below the model's range: that alone, with the truth beside it."""
    axis = diagnose(shared_case("P26_clip_own.py", tmp_path), decimate=decimate)["axes"]["az"]
    assert causes(axis) == ["saturation"]
    assert axis["findings"][0]["estimate"]["limit"]["median"] == pytest.approx(19.6133, rel=1e-6)
    N = axis["posterior"]["parameters"]["constant"]["N"]
    assert N["q05"] < 0.02 < N["q95"]


# ---------------------------------------------------------------------------------------------------------- stuck, held


@pytest.mark.parametrize(
    ("rate", "q", "K"), [(100.0, 0.0, 0.0), (100.0, 0.01, 4e-3), (10.0, 0.12, 0.0), (1.0, 0.0, 4e-3)]
)
def test_stuck_stretches_are_left_out_whole(rate: float, q: float, K: float) -> None:
    """Two stretches of equal readings, on a lattice or none, each 2 to 10 % of the record: from the first one to the
    last they are found, and the rest has the truth."""
    held = Held()
    for seed in range(case_records(3, 120)):
        random = np.random.default_rng([6, seed, round(rate)])
        n = round(max(300.0 * rate, 2000.0))
        y, bias = noise(random, n, rate, K)
        if q:
            y = np.rint(y / q) * q
        truth = []
        for first in (0.1, 0.6):
            start, count = round(random.uniform(first, first + 0.3) * n), round(random.uniform(0.02, 0.1) * n)
            y[start : start + count] = y[start]
            truth.append((start / rate, (start + count) / rate))
        recording = a_recording(y, rate)
        failed = held.add(recording, float(bias[-1]), math.sqrt(0.04**2 + q * q / 12.0 / rate), K)
        found = look(recording, "gx", GYRO).intervals
        assert len(found) == 2
        # A neighbour may have the same code by chance: at most a few readings.
        assert np.abs(np.array(found) - truth).max() <= 8.0 / rate
        assert "lattice" not in failed
    held.check()


@pytest.mark.parametrize("ratio", [2.5, 3.0, 5.0, 10.0, 4.3])
def test_held_readings_are_taken_once(ratio: float) -> None:
    """A part on a lattice that is asked `ratio` times as often as it measures, at times that jitter by a tenth."""
    held, inadequate = Held(), 0
    for seed in range(case_records(3, 120)):
        random = np.random.default_rng([7, seed, round(10 * ratio)])
        y, bias = noise(random, 30_000, 100.0, 4e-3)
        y = np.rint(y / 0.01) * 0.01
        count = int(y.size * ratio) - 10
        asked = (np.arange(count) + random.uniform() + 0.1 * random.uniform(-0.5, 0.5, count)) / ratio
        recording = a_recording(y[np.clip(asked.astype(np.int64), 0, y.size - 1)], 100.0 * ratio)
        inadequate += bool(held.add(recording, float(bias[-1]), math.sqrt(0.04**2 + 1e-4 / 12.0 / 100.0), 4e-3))
        assert look(recording, "gx", GYRO).recording.rate_hz == pytest.approx(100.0, rel=1e-3)
    assert inadequate <= case_records(3, 120) // 50
    held.check()


@pytest.mark.parametrize(
    ("ratio", "q", "jitter", "stamped", "lost"),
    [(1.25, 0.0, 0.0, False, 0.0), (1.0 / 0.9, 1e-3, 0.1, False, 0.0), (1.0 / 0.7, 0.2, 0.1, True, 0.0),
     (1.25, 0.4, 0.4, False, 0.0), (1.0 / 0.9, 0.4, 0.2, True, 0.01), (1.05, 0.2, 0.1, False, 0.0),
     (1.6, 0.6, 0.1, False, 0.0), (1.85, 0.1, 0.2, True, 0.0)],
)  # fmt: skip
def test_a_logger_a_little_faster_than_the_part(
    ratio: float, q: float, jitter: float, stamped: bool, lost: float
) -> None:
    """The repeats come at the beat of two clocks that wander by 20 ppm, on a lattice of up to 1.5 times the noise or
    none, at polls that jitter with stamps or without."""
    held, inadequate, records = Held(), 0, case_records(3, 120)
    for seed in range(records):
        random = np.random.default_rng([18, seed, round(100 * ratio)])
        y, bias = noise(random, 24_000, 100.0, 4e-3)
        y = np.rint(y / q) * q if q else y
        count = int(y.size * ratio) - 10
        asked = np.arange(count) + random.uniform() + jitter * random.uniform(-0.5, 0.5, count)
        asked += 2e-5 * np.cumsum(np.sin(np.arange(count) / 5000.0))
        row = (asked / ratio).astype(np.int64)
        kept = random.random(count) >= lost
        time = np.round(asked[kept] / (100.0 * ratio), 6)
        recording = a_recording(y[row[kept]], 100.0 * ratio, time - time[0] if stamped else None)
        inadequate += bool(held.add(recording, float(bias[row[-1]]), math.sqrt(0.04**2 + q * q / 12.0 / 100.0), 4e-3))
        found = look(recording, "gx", GYRO)
        assert found.recording.rate_hz == pytest.approx(100.0, rel=2e-3)
        # The polls that were lost are one reading each, or a repeat; late polls that miss a reading are fewer.
        assert found.recording.missing_before.sum() <= (lost + 0.1 * jitter + 0.001) * y.size
        if seed == 0:
            both = (record_from(one, MODEL, 1.0) for one in (recording, a_recording(y, 100.0)))
            logged, own = ([f.look.cause for f in diagnose_record(one, ["gx"])["gx"].findings] for one in both)
            unread = 1.0 - np.unique(row[kept]).size / (row[-1] - row[0] + 1.0)
            if unread > 5e-4:  # `missing_samples` is from 1e-3 on
                logged = [cause for cause in logged if cause != "missing_samples"]
            assert logged == ["held_samples", *own]
    assert inadequate <= max(1, records // 50)
    held.check()


@pytest.mark.parametrize("ratio", [1.1, 1.4])
def test_repeats_at_no_beat_are_not_adequate_without_a_word(ratio: float) -> None:
    """Polls at random intervals: some readings are never seen, so the rate of the part is not known."""
    for seed in range(case_records(2, 50)):
        random = np.random.default_rng([19, seed])
        y, _ = noise(random, 24_000, 100.0, 4e-3)
        row = (np.cumsum(random.gamma(4.0, 0.25, round(y.size * ratio * 0.9))) / ratio).astype(np.int64)
        recording = a_recording(y[row], 100.0 * ratio)
        assert "held_samples" in Held().add(recording, 0.0, 0.04, 4e-3)
        assert look(recording, "gx", GYRO).recording.rate_hz < 100.0


@pytest.mark.parametrize("kind", ["white", "slow noise", "line", "dead band", "walk", "stuck", "means"])
def test_readings_that_are_equal_by_chance_are_not_held(kind: str) -> None:
    """On lattices up to 2.5 times the noise: at most 1 of 200 records."""
    records, fired = case_records(12, 400), 0
    for seed in range(records):
        random = np.random.default_rng([20, seed])
        n, q = int(random.choice([3000, 20_000, 80_000])), float(random.choice([0.0, 0.1, 0.5, 1.0, 1.5, 2.5]))
        y = random.uniform(-5.0, 5.0) + random.normal(size=n)
        if kind == "slow noise":
            a = float(random.choice([0.5, 0.9, 0.98]))
            y = lfilter([math.sqrt(1.0 - a * a)], [1.0, -a], y)
        elif kind == "line":
            y += random.choice([0.5, 2.0, 10.0]) * np.sin(2.0 * np.pi * random.uniform(0.01, 0.5) * np.arange(n))
        elif kind == "walk":
            y += np.cumsum(random.normal(size=n)) * random.choice([0.01, 0.1])
        elif kind == "stuck":
            for begin in random.integers(0, n, 5):
                y[begin : begin + random.integers(3, n // 10)] = y[begin]
        y = np.rint(y / q) * q if q else y
        if kind == "dead band":
            y = np.where(np.abs(y) < 1.2, 0.0, y)
        elif kind == "means":
            y = y[: n // 5 * 5].reshape(-1, 5).mean(axis=1)
        fired += held_rows([y], np.arange(y.size), None) is not None
    assert fired <= records // 200


def test_one_slow_axis_leaves_the_others_at_their_rate() -> None:
    """gx at 100 Hz beside gy that is new every fourth row: each has its truth, and gy alone is held."""
    random = np.random.default_rng(8)
    fast, slow = noise(random, 8000, 100.0)[0], np.repeat(noise(random, 2000, 25.0)[0], 4)
    both = a_recording(fast, 100.0)
    both = replace(both, columns={**both.columns, "gy": Column("gy", "deg/s", slow)})
    record = record_from(both, MODEL)
    found = diagnose_record(record, ["gx", "gy"])
    assert not found["gx"].findings
    assert [one.look.cause for one in found["gy"].findings] == ["held_samples"]
    assert record.readings["gy"].recording.rate_hz == pytest.approx(25.0)
    for one in found.values():
        assert one.state.best.sigma * math.sqrt(0.01) == pytest.approx(0.04 if one is found["gx"] else 0.02, rel=0.1)


@pytest.mark.parametrize(
    ("case", "cause", "truth"),
    [("P20c_hold_lattice.py", "held_samples", {"rate_hz": 200.0}),
     ("P35_i2c_freeze.py", "stuck", {"intervals": [[1200.0, 1800.0]]}),
     ("P85_rate_change.py", "rate_change", {"time_s": 900.0, "before_hz": 100.0, "after_hz": 50.0})],
)  # fmt: skip
def test_the_diagnosis_of_a_case_has_one_cause(
    case: str, cause: str, truth: dict[str, Any], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The shared cases as their README has them: the cause alone, N 0.04 beside it. On the terminal no line but one on
    the clock, whose rate changes."""
    axis = diagnose(shared_case(case, tmp_path), axes=["gx"], decimate=4.0)["axes"]["gx"]
    assert causes(axis) == [cause]
    estimate = axis["findings"][0]["estimate"]
    for key, value in truth.items():
        found = estimate[key]["median"] if key != "intervals" else np.array(estimate[key])
        assert found == pytest.approx(np.array(value) if key == "intervals" else value, rel=1e-3)
    N = axis["posterior"]["parameters"]["constant"]["N"]
    assert N["q05"] < 0.0402 < N["q95"]
    lines = capfd.readouterr().err.splitlines()
    assert ["the sampling rate changes: " in line for line in lines] == [True] * (cause == "rate_change")


# --------------------------------------------------------------------------------------------------------------- clock


@pytest.mark.parametrize(
    "rates",
    [(100.0, 50.0), (50.0, 200.0), (104.0, 83.0), (10.0, 9.6), (40.0, 20.0, 40.0), (100.0, 25.0, 100.0, 50.0),
     (50.0, 200.0, 104.0, 83.0), (10.0, 5.0) * 5],
    ids=str,
)  # fmt: skip
def test_changes_of_rate_are_found_and_spoil_nothing(rates: tuple[float, ...]) -> None:
    """Stamps of several rates with jitter and lost rows; the part has one N. The place of a change is known to a few
    intervals."""
    held, failed, records = Held(), 0, case_records(3, 120)
    for seed in range(records):
        random = np.random.default_rng([9, seed, round(rates[0])])
        each_s = max(40.0, 700.0 / min(rates))
        counts = [round(random.uniform(each_s, 2.5 * each_s) * rate) for rate in rates]
        if len(rates) == 2:
            counts = [round(random.uniform(200.0, 500.0) * rate) for rate in rates]
        dt = np.repeat(1.0 / np.array(rates), counts)
        bias = random.uniform(-5.0, 5.0) + np.cumsum(random.normal(size=dt.size) * 4e-3 * np.sqrt(dt))
        y = bias + 0.04 / np.sqrt(dt) * random.normal(size=dt.size)
        time = np.cumsum(dt) + 0.2 * dt * random.uniform(-0.5, 0.5, dt.size)
        kept = random.random(dt.size) > 0.005
        kept[0] = True
        time, y = np.round(time[kept] - time[0], 6), y[kept]
        recording = a_recording(y, 0.0, time)
        failed += bool(held.add(recording, float(bias[-1]), 0.04, 4e-3))
        changes = evened(recording)[1]
        assert [one.before_hz for one in changes] == pytest.approx(rates[:-1], rel=5e-3)
        assert [one.after_hz for one in changes] == pytest.approx(rates[1:], rel=5e-3)
        places = np.cumsum(np.array(counts) / rates)[:-1]
        assert [one.time_s for one in changes] == pytest.approx(places, abs=10.0 / min(rates))
        if seed == 0 and len(rates) == 3:
            found = diagnose_record(record_from(recording, MODEL, 1.0), ["gx"])["gx"]
            assert [one.look.cause for one in found.findings] == ["rate_change"] * 2 + ["missing_samples"]
    assert failed <= records // 50
    held.check()


def test_stretches_of_losses_and_a_wandering_clock_are_no_change_of_rate() -> None:
    """A third of the record loses up to 60 %, whole stretches are lost, or the rate wanders by up to 30 %: at most 1 of
    200 records."""
    records, fired = case_records(12, 600), 0
    for seed in range(records):
        random = np.random.default_rng([17, seed])
        n, rate = int(random.choice([2000, 9000, 40_000])), float(random.choice([10.0, 53.0, 100.0]))
        kept = random.random(n) > 0.01
        jitter = 0.1 * random.uniform(-0.5, 0.5, n)
        time = (np.arange(n) + jitter) / rate
        if seed % 3 == 0:
            begin = int(random.integers(0, n // 2))
            kept[begin : begin + n // 3] &= random.random(n // 3) > random.choice([0.3, 0.5, 0.6])
        elif seed % 3 == 1:
            for begin in random.integers(0, n, 8):
                kept[begin : begin + random.integers(5, 200)] = False
        else:
            walk = np.cumsum(random.normal(size=n)) * random.choice([1e-4, 1e-3, 3e-3]) / math.sqrt(n / 1000.0)
            time = np.cumsum(np.exp(np.clip(walk, -0.3, 0.3))) / rate
        fired += bool(rate_changes(np.round(time[kept] - time[0], 6)))
    assert fired <= records // 200


def test_readings_at_random_times_have_their_mean_rate() -> None:
    """Stamps of a Poisson process with a gap of 100 mean intervals: N is that at the mean rate."""
    held = Held()
    for seed in range(case_records(3, 120)):
        random = np.random.default_rng([10, seed])
        rate = float(random.choice([20.0, 100.0]))
        dt = random.exponential(1.0 / rate, 8000)
        dt[random.integers(1000, 7000)] = 100.0 / rate
        bias = random.uniform(-5.0, 5.0)
        y = bias + 0.04 * math.sqrt(rate) * random.normal(size=dt.size)
        recording = a_recording(y, 0.0, np.round(np.cumsum(dt) - dt[0], 6))
        assert recording.rate_hz == pytest.approx(rate, rel=5.0 / math.sqrt(8000))
        assert recording.missing_before.max() == pytest.approx(99, rel=0.06)
        held.add(recording, bias, 0.04)
    held.check()


def test_bursts_of_a_bus_have_the_rate_of_the_part(tmp_path: Path) -> None:
    """Five samples together every 50 ms, stamped close to each other."""
    recording = load(shared_case("P99_usb_stamps.py", tmp_path))
    assert recording.rate_hz == pytest.approx(99.31, rel=1e-3)
    assert not recording.missing_before.any()


@pytest.mark.parametrize("engine", ["library", "fixed", *(["reference"] if case_records(0, 1) else [])])
def test_an_offset_of_a_million_times_the_noise_costs_nothing(engine: str) -> None:
    """Steps of float32 are 1.25 times the noise there. Without the offset the answer is the same to its digits."""
    offset, random = 5e5, np.random.default_rng(11)
    y = 0.05 * random.normal(size=1200)
    groups = tuple(
        replace(group, range=0.0, priors={**group.priors, "bias": replace(group.priors["bias"], sd=1e6)})
        for group in MODEL.groups
    )
    wide = replace(MODEL, groups=groups)
    far = identify_axis(a_recording(y + offset, 1.0), "gx", wide, engine, None)
    near = identify_axis(a_recording(y, 1.0), "gx", wide, engine, None)
    assert far.result.bias_mean - offset == pytest.approx(near.result.bias_mean, abs=0.1 * near.result.bias_sd)
    for law, parameters in near.result.parameters.items():
        assert far.result.parameters[law]["N"].median == pytest.approx(parameters["N"].median, rel=2e-3)
    assert far.adequate


# ---------------------------------------------------------------------------------------------------------- clean twins


def test_clean_records_show_none_of_it() -> None:
    """White noise and a walk on lattices up to three times the noise, at even, jittering and lossy stamps. Without the
    effect each look fires in 1 of 200 at most; together in 1 of 100."""
    records, found = case_records(5, 600), 0
    for seed in range(records):
        random = np.random.default_rng([12, seed])
        rate = float(random.choice([1.0, 10.0, 100.0]))
        y, _ = noise(random, 4000, rate, float(random.choice([0.0, 1e-3])))
        q = 0.04 * math.sqrt(rate) * float(random.choice([0.0, 0.01, 0.3, 1.0, 2.0, 3.0]))
        y = np.rint(y / q) * q if q else y
        time = np.arange(y.size) / rate
        if random.random() < 0.7:
            time = time + random.choice([0.0, 0.1, 0.4]) / rate * random.uniform(-0.5, 0.5, y.size)
            kept = random.random(y.size) > random.choice([0.0, 0.003, 0.05])
            kept[0] = True
            y, time = y[kept], np.round(time[kept] - time[0], 6)
        recording = a_recording(y, rate, time)
        one = look(recording, "gx", GYRO)
        found += bool(one.intervals) + (one.clipped is not None) + (one.held is not None) + bool(one.changes)
    assert found <= records // 100


def test_no_warning_of_a_library_reaches_the_user(tmp_path: Path) -> None:
    """A dead band that holds nearly every reading: whatever is found, numpy keeps silent."""
    y, bias = noise(np.random.default_rng(13), 1000, 10.0)
    save(tmp_path / "log.csv", {"gx": ("deg/s", np.where(np.abs(y - bias) < 0.32, bias[0], y))}, 10.0)
    for verb in ("identify", "diagnose"):
        assert "Warning" not in run(verb, tmp_path / "log.csv").stderr


@pytest.mark.parametrize("limit", [1.1769249, 0.30000149, 27.182849, -2.7182849])
def test_a_limit_of_many_digits_leaves_the_posterior_right(limit: float, tmp_path: Path) -> None:
    """The extended model has the range to six digits, which may be less than the limit: the clipped readings are still
    clipped ones. Without them N was 8 % low. Its sd is 1.3 %: 5 % is four of them. A range is the same on both sides of
    zero, so an upper limit below zero is none."""
    noise = 0.04 * abs(limit)
    y = np.minimum(limit - 1.4 * noise + np.random.default_rng(81).normal(0.0, noise, 3600), limit)
    log = tmp_path / "log.csv"
    rows = np.column_stack([np.arange(3600.0), y])
    np.savetxt(log, rows, delimiter=",", header="t[s],gx[deg/s]", comments="", fmt="%.9g")
    axis = diagnose(log)["axes"]["gx"]
    assert [finding["cause"] for finding in axis["findings"]] == ["saturation"]
    assert axis["posterior"]["parameters"]["constant"]["N"]["median"] == pytest.approx(noise, rel=0.05)
