"""Codes that are not alike, and readings that repeat in a stretch, are named with their size; others name none.

Truth: the numbers that each record was drawn with, sample by sample.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from selfcal.base.grid import Array
from selfcal.logs.recording import save
from selfcal.readings.budget import nats_of
from selfcal.readings.codes import UNEVEN, codes_of
from selfcal.readings.held import slower_stretches
from selfcal.readings.lattice import lattice_of
from selfcal.verbs.diagnose import diagnose

from conftest import case_records

SAMPLES = 3000
#: Noise of a reading, deg/s.
SD = 0.03


def quiet(random: np.random.Generator, n: int = SAMPLES) -> Array:
    """[n]: white noise and a random walk, deg/s."""
    level = random.uniform(-0.3, 0.3)
    return np.asarray(level + SD * (random.standard_normal(n) + 0.005 * random.standard_normal(n).cumsum()))


def rounded(y: Array, q: float) -> Array:
    return np.asarray(q * np.rint(y / q)) if q > 0.0 else y


def banded(y: Array, q: float, width: float) -> tuple[Array, float]:
    """Readings nearer than `width` to a value near their middle become it, and the share that do so."""
    value = float(rounded(np.array([np.median(y)]), q)[0])
    read = rounded(y, q)
    inside = (np.abs(read - value) < width) & (read != value)
    return np.where(inside, value, read), float(inside.mean())


def log_of(path: Path, y: Array, rate: float) -> Path:
    save(path, {"gx": ("deg/s", y)}, rate, {}, t=np.arange(y.size) / rate)
    return path


def axis_of(path: Path) -> dict[str, object]:
    found: dict[str, object] = diagnose(path)["axes"]["gx"]
    return found


@pytest.mark.parametrize("times", [300.0, 5000.0])
def test_a_step_in_the_very_middle_is_no_misreading(times: float) -> None:
    """As many readings at one level as at the other: their median lies between the two, far from all of them."""
    y = quiet(np.random.default_rng(4), 900)
    y[450:] += times * SD
    assert codes_of(y, lattice_of(y, 1.0)) is None


@pytest.mark.parametrize(("q", "width"), [(0.15, 0.4), (0.35, 0.8), (0.6, 0.7), (0.0, 0.25), (0.0, 1.3)])
def test_a_dead_band_is_named_with_its_place_and_share(q: float, width: float) -> None:
    """On a lattice of q noises or on none, half a band of `width` noises. The share of readings that it moves lies in
    three of its standard deviations, a tenth more: the counts beside the band say how many are gone."""
    for seed in range(case_records(2, 60)):
        random = np.random.default_rng([61, seed, round(100 * q), round(100 * width)])
        y, share = banded(quiet(random), q * SD, width * SD)
        found = codes_of(y, lattice_of(y, 1.0))
        assert found is not None and found.kind == "band" and found.undone is not None
        assert found.value is not None and found.width is not None
        assert np.count_nonzero(y == found.value) == np.unique(y, return_counts=True)[1].max()
        assert abs(found.share - share) < 3.0 * found.sd + 0.1 * share
        # The band swallowed noise, which drawn readings have again: to 4 standard deviations of a spread.
        assert abs(np.diff(found.undone).std() / math.sqrt(2.0) / math.hypot(SD, q * SD / 3.46) - 1.0) < 0.06


@pytest.mark.parametrize("q", [0.15, 0.4, 0.8])
def test_narrow_codes_are_named_with_the_share_that_they_lose(q: float) -> None:
    for seed in range(case_records(2, 60)):
        random = np.random.default_rng([62, seed, round(100 * q)])
        read = np.rint(quiet(random) / (q * SD))
        lost = (read % 2 == seed % 2) & (random.random(read.size) < random.uniform(0.25, 0.8))
        y = q * SD * (read + np.where(lost, random.choice([-1.0, 1.0], read.size), 0.0))
        found = codes_of(y, lattice_of(y, 1.0))
        assert found is not None and found.kind == "uneven"
        assert found.value is None
        # The odd ones are half of the readings to sqrt(n) / 2.
        assert abs(found.share - lost.mean()) < 3.0 * found.sd + 2.0 / math.sqrt(read.size)


KINDS = ("plain", "tails", "louder", "jump", "lost words", "limit", "outliers")


@pytest.mark.parametrize("kind", KINDS)
def test_codes_that_are_alike_are_not_named(kind: str) -> None:
    """Nor are heavy tails, a change of the noise, a jump, lost words, a limit or outliers: at most 1 of 200."""
    count, named = case_records(4, 200), 0
    for seed in range(count):
        random = np.random.default_rng([63, seed, KINDS.index(kind)])
        q = SD * float(np.exp(random.uniform(math.log(0.08), math.log(1.5))))
        y = quiet(random, int(random.choice([1200, 6000])))
        if kind == "tails":
            y += 0.5 * SD * random.standard_t(4.0, y.size)
        elif kind == "louder":
            y[y.size // 3 :] += random.uniform(0.5, 2.0) * SD * random.standard_normal(y.size - y.size // 3)
        elif kind == "jump":
            y[int(random.uniform(0.2, 0.8) * y.size) :] += random.uniform(-6.0, 6.0) * SD
        elif kind == "limit":
            y = np.minimum(y, np.median(y) + random.uniform(0.5, 2.0) * SD)
        elif kind == "outliers":
            hit = random.random(y.size) < 0.01
            y[hit] += 6.0 * SD * random.standard_normal(int(hit.sum()))
        y = rounded(y, q)
        if kind == "lost words":
            y[random.random(y.size) < 0.02] = y[random.integers(y.size)]
        found = codes_of(y, lattice_of(y, 1.0))
        named += found is not None and found.kind in UNEVEN
    assert named <= binom.isf(1e-3, count, 1.0 / 200.0)


def test_a_word_beside_the_level_is_no_dead_band() -> None:
    """Lost words two noises or so from the level, on lattices almost as coarse as the noise. Evidence was 20 nats off
    by where levels and noises lay between the steps of their search."""
    for seed in range(case_records(8, 60)):
        random = np.random.default_rng([73, seed])
        q, off, share = (random.uniform(*between) for between in ((0.65, 0.95), (1.6, 2.6), (0.02, 0.04)))
        y = rounded(random.uniform(-1.0, 1.0) + random.standard_normal(40_000), q)
        word = float(rounded(np.array([np.median(y) + random.choice([-off, off])]), q)[0])
        y[random.random(y.size) < share] = word
        found = codes_of(SD * y, lattice_of(SD * y, 100.0))
        assert found is not None and found.kind == "word"
        assert found.value == pytest.approx(SD * word, abs=1e-9)
        assert abs(found.share - share) < 0.15 * share + 4.0 * math.sqrt(np.count_nonzero(y == word)) / y.size


@pytest.mark.parametrize("q", [0.7, 0.8, 0.9])
@pytest.mark.parametrize("freedom", [10.0, 15.0])
def test_noise_that_is_not_normal_has_no_word(q: float, freedom: float) -> None:
    """A line that switches, and tails, on a lattice almost as coarse as the noise: the counts of many readings are not
    those of normal noise, by hundreds of nats. The best map took those for evidence of a lost word, from 16 on."""
    for seed in range(case_records(1, 20)):
        random = np.random.default_rng([72, seed])
        line = np.sign(np.sin(0.031 * np.arange(300_000)))
        y = rounded(random.standard_t(freedom, line.size) + random.uniform(0.25, 0.35) * line + random.random(), q)
        found = codes_of(y, lattice_of(y, 100.0))
        assert found is None or found.nats < nats_of("outliers")


@pytest.mark.parametrize(
    ("ratio", "count", "q"), [(2, 60, 0.2), (2, 40, 0.0), (3, 30, 0.4), (4, 25, 0.3), (3, 60, 0.7)]
)
def test_a_stretch_at_a_part_of_the_rate_is_named(ratio: int, count: int, q: float, tmp_path: Path) -> None:
    """`count` readings, each `ratio` times. An end may be a reading off: it may equal its neighbour by chance.

    A lattice coarser than half the noise is a finding of its own. No lattice here is near that limit: the noise that
    the record shows decides there."""
    for seed in range(case_records(1, 20)):
        random = np.random.default_rng([64, seed, ratio, count])
        y = rounded(quiet(random), q * SD)
        first = int(random.uniform(0.1, 0.9) * (y.size - ratio * count))
        held = y[first : first + ratio * count]
        held[:] = held[np.arange(held.size) // ratio * ratio]
        rate = float(random.choice([1.0, 4.0]))
        axis = diagnose(log_of(tmp_path / "held.npz", y, rate))["axes"]["gx"]
        found = {finding["cause"]: finding for finding in axis["findings"]}
        assert found.keys() == {"held_samples"} | ({"quantization"} if q > 0.5 else set())
        finding = found["held_samples"]
        assert finding["estimate"]["rate_hz"]["median"] == pytest.approx(rate / ratio)
        ((begin, end),) = finding["estimate"]["intervals"]
        assert abs(begin * rate - first) <= 2 * ratio
        assert abs(end * rate - first - held.size) <= 2 * ratio


@pytest.mark.parametrize("kind", ["lattice", "louder", "rest"])
def test_readings_that_are_equal_by_chance_are_no_stretch(kind: str) -> None:
    """On a lattice of up to 1.8 noises, beside a louder part, and where a bench comes to rest: at most 1 of 200."""
    count, named = case_records(20, 400), 0
    for seed in range(count):
        random = np.random.default_rng([65, seed, len(kind)])
        y, q = quiet(random), SD * random.uniform(0.05, 1.8)
        if kind != "lattice":
            level = float(np.median(y))
            part = slice(int(random.uniform(0.1, 0.8) * y.size), None)
            y[part] = level + (y[part] - level) * (random.uniform(2.0, 5.0) if kind == "louder" else 0.2)
        named += bool(slower_stretches(rounded(y, q)))
    assert named <= binom.isf(1e-3, count, 1.0 / 200.0)
