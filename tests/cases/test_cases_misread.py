"""Readings that firmware or logger changed are named with their kind, and undone where they can be; sound ones are not.

Truth: what was done to records of known noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from selfcal.adequacy.identify import identify_axis
from selfcal.base.errors import UserError
from selfcal.diagnosis.loop import diagnose_record
from selfcal.diagnosis.record import record_from
from selfcal.logs.recording import Column, Recording
from selfcal.model.file import Model
from selfcal.readings.budget import SHARES
from selfcal.readings.changed_words import spans_of
from selfcal.readings.faults import FAULTS
from selfcal.readings.moves import moves_of
from selfcal.readings.readings import look

from conftest import case_records

Array = NDArray[np.float64]
Random = np.random.Generator
MODEL = Model.load(None)
RATE = 40.0


def a_recording(rate: float = RATE, **axes: Array) -> Recording:
    columns = {name: Column(name, "deg/s" if name[0] == "g" else "m/s^2", row) for name, row in axes.items()}
    n = next(iter(axes.values())).size
    return Recording(Path("a"), rate, columns, np.zeros(n, np.int64), {})


def sign_lost(x: Array, random: Random) -> Array:
    return np.where((x < 0.0) & (x > -1.0), -x, x)


def truncated(x: Array, random: Random) -> Array:
    step = float(x.std()) * random.uniform(0.4, 0.9)
    return np.asarray(step * np.trunc(x / step))


def digits_lost(x: Array, random: Random) -> Array:
    counts = np.rint(1000.0 * np.abs(x)).astype(int)
    return np.sign(x) * np.array([float(f"{one // 1000}.{one % 1000}") for one in counts])


def unsigned(x: Array, random: Random) -> Array:
    return np.asarray((np.rint(x * 2048.0).astype(np.int64) % 65536) / 2048.0)


def overflow(x: Array, random: Random) -> Array:
    counts = np.rint((x - x.mean()) * 2048.0).astype(np.int64) + 32768 + random.integers(-300, 300)
    return np.asarray(((counts + 32768) % 65536 - 32768) / 2048.0)


def torn(x: Array, random: Random) -> Array:
    """The upper byte of one in 50 readings is the one before's."""
    code = np.rint((x - x.mean()) / 0.02).astype(np.int64) + 1024
    upper, late = code >> 8, np.flatnonzero(random.random(code.size) < 0.02)
    upper[late[1:]] = code[late[1:] - 1] >> 8
    return np.asarray(0.02 * (upper * 256 + (code & 255)))


def range_change(x: Array, random: Random) -> Array:
    at = int(random.uniform(0.2, 0.8) * x.size)
    step = np.where(np.arange(x.size) < at, 1.0, 2.0) * 0.15 * x.std()
    return np.asarray(step * np.rint(x / step))


MAPS: tuple[Callable[[Array, Random], Array], ...] = (
    sign_lost,
    truncated,
    digits_lost,
    unsigned,
    overflow,
    torn,
    range_change,
)


def drawn(random: Random, n: int) -> tuple[Array, float]:
    """Noise about a level near zero, and its N."""
    sd = random.uniform(0.05, 0.12)
    return random.uniform(-0.4, 0.4) * sd + sd * random.standard_normal(n), sd / math.sqrt(RATE)


@pytest.mark.parametrize("read", MAPS, ids=lambda one: one.__name__)
def test_a_map_of_the_readings_is_named_in_both_verbs(read: Callable[[Array, Random], Array]) -> None:
    """`identify` is not adequate by `misread` with its kind, `diagnose` of the means names it too. N of those that are
    undone holds the truth within 4 of its sd; of the others no number does, and both call the axis inadequate."""
    for seed in range(case_records(2, 40)):
        random = np.random.default_rng([91, seed])
        x, N = drawn(random, 24_000)
        recording = a_recording(gx=read(x, random))
        found = identify_axis(recording, "gx", MODEL, "library", None)
        check = found.judged.checks["misread"]
        assert (check["kind"], check["passed"]) == (read.__name__, False)
        if read in (unsigned, overflow, torn):
            estimate = found.result.parameters["constant"]["N"]
            assert abs(estimate.mean - N) < 4.0 * estimate.sd
        if seed == 0:
            one = diagnose_record(record_from(recording, MODEL, 1.0), ["gx"])["gx"]
            assert [finding.look.estimate["kind"] for finding in one.findings if finding.look.cause == "misread"] == [
                read.__name__
            ]
            undone = next(
                finding.look.estimate["undone"] for finding in one.findings if finding.look.cause == "misread"
            )
            assert undone == check["undone"]


@pytest.mark.parametrize("share", [0.012, 0.11, 0.28])
@pytest.mark.parametrize("digits", [None, 4])
def test_torn_bytes_in_any_share_are_undone(share: float, digits: int | None) -> None:
    """Noise of 11 codes about the edge of an upper byte, in full or printed with digits that round the lattice. Undone
    readings have the noise of the true ones, to 4 of its sd."""
    random = np.random.default_rng([98, round(1000 * share)])
    code = np.rint(11.0 * random.standard_normal(12_000)).astype(int) + 768
    upper, late = code >> 8, np.flatnonzero(random.random(code.size) < share)
    upper[late[1:]] = code[late[1:] - 1] >> 8
    y = 0.0037 * (upper * 256 + (code & 255))
    found = spans_of(y if digits is None else np.round(y, digits))
    assert found is not None and found.kind == "torn" and found.undone is not None
    assert abs(found.undone.std() / (0.0037 * code.std()) - 1.0) < 4.0 / math.sqrt(2.0 * code.size)


@pytest.mark.parametrize("coarse", [1.05, 1.2])
@pytest.mark.parametrize("kind", ["truncated", "sign_lost", None])
def test_maps_about_zero_show_on_coarse_lattices(coarse: float, kind: str | None) -> None:
    """Steps of more than a noise; rounded as they should be they name none."""
    y = (0.37 + np.random.default_rng([99, round(100 * coarse)]).standard_normal(20_000)) / coarse
    code = np.trunc(y) if kind == "truncated" else np.abs(np.rint(y)) if kind else np.rint(y)
    found = look(a_recording(40.0, gx=0.03 * code), "gx", MODEL.group_of("gx")).misread
    assert (None if found is None else found.kind) == kind


def test_two_levels_are_no_count_that_runs_over() -> None:
    """Both ends of the readings are met, and noise beside each. No noise crosses the seam of a circle of that span."""
    random = np.random.default_rng(100)
    y = random.standard_normal(20_000) + 27.0 * (np.cumsum(random.random(20_000) < 0.02) % 2)
    assert spans_of(y) is None


@pytest.mark.parametrize(("bit", "noise"), [(1, 14.0), (3, 14.0), (4, 9.0)])
@pytest.mark.parametrize("level", [0, 613, 793])
def test_a_bit_that_never_changes_is_named(bit: int, noise: float, level: int) -> None:
    """Codes of noise of some steps with one bit at 1, or at 0. Codes with every bit are sound. Of 793 a bit of 16 steps
    changes in the tails alone."""
    x = np.rint(noise * np.random.default_rng([96, bit]).standard_normal(9000)).astype(int) + level
    for kind, code in (("bit_set", x | (1 << bit)), ("bit_clear", x & ~(1 << bit)), (None, x)):
        found = look(a_recording(40.0, gx=0.02 * code), "gx", MODEL.group_of("gx")).misread
        assert (None if found is None else found.kind) == kind


@pytest.mark.parametrize("share", [0.04, 0.15])
@pytest.mark.parametrize("level", [7.4, -3.2, 0.9])
def test_a_lost_fraction_is_no_limit(level: float, share: float) -> None:
    """A share of the readings of two decimals is printed without them. A whole number comes too often: that is named,
    and not a limit."""
    random = np.random.default_rng([97, round(100.0 * share)])
    y = np.round(level + 0.25 * random.standard_normal(9000), 2)
    lost = random.random(y.size) < share
    seen = look(a_recording(25.0, gx=np.where(lost, np.trunc(y), y)), "gx", MODEL.group_of("gx"))
    assert seen.clipped is None
    assert seen.recurring is not None
    assert seen.recurring.value == round(seen.recurring.value)
    assert 0.0 < seen.recurring.share < 1.1 * share


@pytest.mark.parametrize("share", [0.25, 0.4])
def test_a_word_far_off_is_no_dead_band(share: float) -> None:
    """A share of the readings is 17 in place of some 1.5, on a lattice that is fine beside their spread."""
    random = np.random.default_rng([98, round(100.0 * share)])
    y = 0.012 * np.rint((1.5 + 0.2 * random.standard_normal(9000)) / 0.012)
    seen = look(a_recording(25.0, gx=np.where(random.random(y.size) < share, 17.004, y)), "gx", MODEL.group_of("gx"))
    assert seen.uneven is None and seen.clipped is None
    assert seen.recurring is not None
    assert seen.recurring.value == pytest.approx(17.004)
    assert abs(seen.recurring.share - share) < 0.02


@pytest.mark.parametrize(("noise", "undone"), [(5.0, True), (22.0, True), (47.0, False)])
@pytest.mark.parametrize(
    ("base", "away", "kind"), [(768, 1.7, "low_bits"), (128, -1.5, "overflow"), (0, 0.3, "unsigned")]
)
def test_a_count_of_eight_bits_that_goes_round_is_named(
    noise: float, undone: bool, base: int, away: float, kind: str
) -> None:
    """The low byte alone of a level so many noises away from its end. Noise below an eighth of the circle is undone."""
    random = np.random.default_rng([97, base])
    true = np.rint(noise * (away + random.standard_normal(12_000))).astype(int) + base
    code = (true + 128) % 256 - 128 if kind == "overflow" else true % 256
    found = look(a_recording(40.0, gx=0.02 * code), "gx", MODEL.group_of("gx")).misread
    assert found is not None and found.kind == kind
    assert (found.undone is not None) == undone
    if found.undone is not None:
        off = np.rint(found.undone / 0.02) - true
        assert np.mean(off == np.median(off)) > 0.999  # four noises in the circle: some turn is missed in 16 000


@pytest.mark.parametrize("q", [0.0, 0.12, 0.6])
@pytest.mark.parametrize("long", [0, 40])
def test_many_short_holds_are_named(q: float, long: int) -> None:
    """3 to 12 repeats of high readings, 2 % of the time: found, and N and the bias as without them within 5 sd. One run
    that is `long` enough by itself does not hide the others."""
    for seed in range(case_records(2, 40)):
        random = np.random.default_rng([92, seed])
        x = random.standard_normal(60_000)
        y = x.copy()
        for at in np.flatnonzero((x > 1.0) & (random.random(x.size) < 0.02)):
            y[at : at + random.integers(4, 14)] = y[at]
        y[31_000 : 31_000 + long] = y[31_000]
        y = 0.02 + 0.1 * (q * np.rint(y / q) if q else y)
        found = identify_axis(a_recording(400.0, gx=y), "gx", MODEL, "library", None)
        assert not found.judged.checks["stuck"]["passed"]
        assert not {"quantization", "misread"} & found.judged.checks.keys()
        N = found.result.parameters["constant"]["N"]
        assert abs(N.mean - 0.1 * math.hypot(1.0, q / math.sqrt(12.0)) / 20.0) < 5.0 * N.sd
        assert abs(found.result.bias_mean - 0.02) < 5.0 * found.result.bias_sd


@pytest.mark.parametrize(("factor", "digits"), [(-2.0, 12), (1.0, 3), (-0.4, 2), (7.5, 1)])
def test_a_copied_axis_has_no_number(factor: float, digits: int) -> None:
    """A multiple of another axis, both printed with so many digits. What differs is rounding alone."""
    random = np.random.default_rng(93)
    x = random.standard_normal(6000)
    copy = np.round(0.3 + factor * x, digits)
    recording = a_recording(gx=np.round(x, digits), gy=copy, gz=np.round(random.standard_normal(6000), digits))
    with pytest.raises(UserError, match="its readings are those of gx, but for a factor"):
        identify_axis(recording, "gy", MODEL, "library", None)
    assert not moves_of(recording)
    assert identify_axis(recording, "gx", MODEL, "library", None).judged.checks.get("motion") is None


@pytest.mark.parametrize("beyond", [1.1, 1.7, 2.3])
def test_readings_beyond_the_range_are_clipped_ones(beyond: float) -> None:
    """1.6 to 27 % of them: not adequate, and N as of all within 5 of its sd."""
    sd = 1.0 / beyond
    y = sd * np.random.default_rng(94).standard_normal(20_000)
    model = replace(MODEL, groups=tuple(replace(group, range=1.0) for group in MODEL.groups))
    found = identify_axis(a_recording(gx=y), "gx", model, "library", None)
    assert not found.judged.checks["saturation"]["passed"]
    N = found.result.parameters["constant"]["N"]
    assert abs(N.mean - sd / math.sqrt(RATE)) < 5.0 * N.sd


def sound(random: Random, k: int) -> Recording:
    """Three axes at rest: white noise with a walk, Gauss-Markov or 1/f drift, on a fine or a coarse lattice or none."""
    rate = (1.0, 10.0, 100.0)[k % 3]
    n = round(rate * (1200.0, 1200.0, 300.0)[k % 3])
    axes = {}
    for name in ("gx", "gy", "az"):
        y = random.standard_normal(n)
        drift = random.standard_normal(n) / math.sqrt(rate)
        if k // 3 % 3 == 0:
            y += math.exp(random.uniform(-6.0, -3.0)) * np.cumsum(drift)
        else:
            spectrum = np.fft.rfft(random.standard_normal(n))
            f = np.arange(1, spectrum.size + 1) / n
            y += np.fft.irfft(spectrum * (0.05 / np.sqrt(f) if k // 3 % 3 == 1 else 0.1 / np.hypot(f, 0.01)), n) / 3.0
        q = (0.0, 0.1, 0.5, 1.4)[k // 9 % 4]
        y += random.uniform(-3.0, 3.0)
        y = q * np.rint(y / q) if q else y if k % 2 else np.array([float(f"{value:.8g}") for value in y])
        axes[name] = 0.1 * y
    return a_recording(rate, **axes)


def test_sound_readings_are_called_so() -> None:
    """In at most 2 of 1000 axes, a binomial bound of 0.1 %; no test in more than its own share allows."""
    count, named = case_records(6, 700), dict.fromkeys(SHARES, 0)
    for k in range(count):
        recording = sound(np.random.default_rng([95, k]), k)
        for axis in recording.columns:
            seen = look(recording, axis, MODEL.group_of(axis))
            for fault in FAULTS:
                named[fault.name] += fault.statistic(seen) > 0.0
    print(named)
    assert sum(named.values()) <= binom.isf(1e-3, 3 * count, 2e-3)
    for name, share in SHARES.items():
        assert named[name] <= binom.isf(1e-3, 3 * count, share), name


@pytest.mark.parametrize("axes", [6, 3, 1])
@pytest.mark.parametrize("seconds", [0.4, 2.0, 15.0])
@pytest.mark.parametrize("louder", [5.0, 14.0])
def test_shaken_stretches_are_left_out_in_both_verbs(axes: int, seconds: float, louder: float) -> None:
    """The axes that are shaken, to 1 s and its margin; of the others one in 20 joins them. N within 4 of its sd."""
    random = np.random.default_rng([96, axes, round(10 * seconds), round(louder)])
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    t = np.arange(24_000) / RATE
    shaken = (t >= 371.3) & (t < 371.3 + seconds)
    rows = {name: 0.1 * random.standard_normal(t.size) for name in names}
    moved = names if axes == 6 else names[3:] if axes == 3 else ("gy",)
    for name in moved:
        rows[name][shaken] *= louder
    recording = a_recording(**{name: 0.01 * np.rint(row / 0.01) for name, row in rows.items()})
    found = moves_of(recording)
    if axes > 1 or seconds * louder > 4.0:  # one axis alone: 11 of 12
        assert len({*moved} & {*found}) >= len(moved) - (seconds < 1.0 and axes > 1)
        assert len(found) <= len(moved) + 1
    record = record_from(recording, MODEL, 1.0)
    for name in found:
        ((begin, end),) = found[name].intervals
        assert abs(begin - 371.3) < 1.5 and abs(end - 371.3 - seconds) < 1.5
        readings = record.readings[name]
        assert readings.moved is not None and np.allclose(readings.moved.intervals, found[name].intervals, atol=0.5)
    for name in (moved[0], "gx"):
        N = identify_axis(recording, name, MODEL, "library", None).result.parameters["constant"]["N"]
        assert abs(N.mean - 0.1 / math.sqrt(RATE)) < 4.0 * N.sd
