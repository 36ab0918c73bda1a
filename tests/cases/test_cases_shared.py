"""Noise that two axes share is found with its correlation and carries over; axes that share none show none.

Truth: the numbers that each record was drawn with, sample by sample. The real recordings are known to share noise.
"""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, poisson

from selfcal.base.grid import Array
from selfcal.diagnosis import score
from selfcal.diagnosis.causes import shared
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.record import Record, record_from
from selfcal.likelihood.state import NET_LEAST, P_LOOK, State
from selfcal.model.file import Model
from selfcal.verbs.diagnose import diagnose

from conftest import case_records, shared_recording

SAMPLES = 2000


def drift(random: np.random.Generator, n: int, ratio: float) -> Array:
    """A random walk whose step is `ratio` of the white noise of 1."""
    return ratio * random.standard_normal(n).cumsum()


def band(random: np.random.Generator, n: int, low: float, high: float) -> Array:
    """Noise of variance 1 between two frequencies, cycles a sample: a sum of waves of random phase, none a line."""
    waves = np.arange(math.ceil(low * n), math.floor(high * n) + 1) + random.uniform(-0.3, 0.3)
    phase = random.uniform(0.0, 2.0 * math.pi, waves.size)
    size = random.rayleigh(1.0, waves.size) / math.sqrt(waves.size)
    t = np.arange(n) / n
    found: Array = sum(
        (a * np.cos(2.0 * math.pi * f * t + p) for f, p, a in zip(waves, phase, size, strict=True)), np.zeros(n)
    )
    return found


def settled(axes: dict[str, Array], rate: float = 1.0) -> tuple[dict[str, Diagnosed], Record]:
    """Fitted axes after the look at their pairs."""
    present = np.ones(len(next(iter(axes.values()))), bool)
    states = {name: State(name, "deg/s", y, 1.0 / rate, 0.0, np.ones(y.size)).refit() for name, y in axes.items()}
    record = Record(rate, states, {}, {}, present, recorded_hz=rate)
    found = {name: Diagnosed(state, state, record) for name, state in states.items()}
    assert shared.CAUSE.grouping.settle is not None
    shared.CAUSE.grouping.settle(record, found)
    return found, record


def gain_of(finding: Finding, record: Record) -> float:
    """Held-out gain, nats a sample."""
    found = score.gain(finding.look, finding.before, finding.after, record, finding.partner).gain
    assert found is not None
    return float(found["log_score_per_sample"]["after"] - found["log_score_per_sample"]["before"])


@pytest.mark.parametrize("kind", ["plain", "gaps", "breathing", "event", "line"])
def test_axes_that_share_no_noise(kind: str) -> None:
    """No more than a look may show by chance; 1 of 200 where they have something in common that is no noise."""
    random = np.random.default_rng([42, len(kind)])
    pairs, n, count = case_records(100, 2000), SAMPLES, 0
    t = np.arange(n)
    for _ in range(pairs):
        u, v = random.standard_normal((2, n))
        if kind == "gaps":
            u[random.integers(0, n - 300) :][:300] = np.nan
            v[random.random(n) < 0.3] = np.nan
        elif kind == "breathing":  # the level of both, and no more
            u, v = ((1.0 + 0.7 * np.sin(2.0 * math.pi * t / 400.0)) * one for one in (u, v))
        elif kind == "event":
            begin = random.integers(0, n - 20)
            for one in (u, v):
                one[begin : begin + 20] += 4.0
        elif kind == "line":
            turns = 2.0 * math.pi * random.uniform(0.05, 0.45) * t
            u, v = (one + 0.5 * np.sin(turns) for one in (u, v))
        scaled = [one / np.nanstd(one) for one in (u, v)]
        found = shared.common(shared.pair_of(scaled[0], scaled[1], 1.0))
        count += found is not None and found.net >= NET_LEAST
    print(f"{kind}: {count} of {pairs} pairs")
    assert count <= poisson.isf(1e-3, pairs * (P_LOOK if kind == "plain" else 0.005))


def test_white_noise_of_a_common_source() -> None:
    """Found on both axes and on no third, with the correlation in its interval and a gain that carries over."""
    random = np.random.default_rng(43)
    records, n, held, ahead = case_records(6, 200), SAMPLES, 0, 0
    for _ in range(records):
        truth = float(random.choice([-1.0, 1.0]) * random.uniform(0.2, 0.6))
        u = random.standard_normal(n)
        v = truth * u + math.sqrt(1.0 - truth**2) * random.standard_normal(n)
        rows = {"gx": u, "gy": v, "gz": random.standard_normal(n)}
        found, record = settled({name: y + drift(random, n, 0.01) for name, y in rows.items()})
        assert [finding.look.estimate["other"] for finding in found["gx"].findings] == ["gy"]
        assert [finding.look.estimate["other"] for finding in found["gy"].findings] == ["gx"]
        assert not found["gz"].findings
        finding = found["gx"].findings[0]
        estimate = finding.look.estimate["correlation"]
        held += estimate["q05"] <= truth <= estimate["q95"]
        assert "band_hz" not in finding.look.estimate
        gain = gain_of(finding, record)
        # The half that is scored has an information of its own: three standard deviations of its mean.
        exact = -0.5 * math.log1p(-(truth**2))
        assert abs(gain - exact) < 3.5 * abs(truth) / math.sqrt(n / 2) + 0.01
        ahead += gain > 0.0
    print(f"white: {held} of {records} correlations in their 90 % interval")
    assert binom.cdf(held, records, 0.9) > 1e-3
    assert ahead == records


@pytest.mark.parametrize("rate", [1.0, 25.0])
def test_noise_in_a_band_of_a_common_source(rate: float) -> None:
    random = np.random.default_rng(44)
    records, n = case_records(3, 50), SAMPLES
    for _ in range(records):
        low = random.uniform(0.1, 0.2)
        high = 1.6 * low
        sign = float(random.choice([-1.0, 1.0]))
        common = band(random, n, low, high)
        rows = {"gx": common, "gy": sign * common}
        found, record = settled(
            {name: y + random.standard_normal(n) + drift(random, n, 0.01) for name, y in rows.items()}, rate
        )
        (finding,) = found["gy"].findings
        # Bands are thirds of an octave: each edge is one off at most.
        edge = np.log2(np.array(finding.look.estimate["band_hz"]) / (rate * np.array([low, high])))
        assert np.abs(edge).max() < 0.7
        assert finding.look.estimate["correlation"]["median"] * sign > 0.3
        assert finding.look.estimate["share"]["median"] < abs(finding.look.estimate["correlation"]["median"])
        assert gain_of(finding, record) > 0.0


def written(folder: Path, axes: dict[str, Array]) -> Path:
    """A log of 1 Hz."""
    path = folder / "pair.npz"
    columns = {f"{name}[{'deg/s' if name[0] == 'g' else 'm/s^2'}]": y for name, y in axes.items()}
    np.savez(path, allow_pickle=False, **{"t[s]": np.arange(len(columns["gx[deg/s]"])) * 1.0, **columns})
    return path


@pytest.mark.parametrize(("seed", "source"), [(11, "gx"), (12, "gy"), (13, "az")])
def test_one_source_of_several_axes_is_one_leak(tmp_path: Path, seed: int, source: str) -> None:
    """A share of one axis' readings in three others: by one pair alone the direction is a toss, by all it is not. Each
    shows 0.5 x 4000 x 0.12^2 = 29 nats."""
    random = np.random.default_rng(seed)
    names = ("gx", "gy", "gz", "ax", "az")
    axes = {name: random.standard_normal(2 * SAMPLES) + drift(random, 2 * SAMPLES, 0.02) for name in names}
    followers = {name for name in names if name != source and name != "gz"}
    axes |= {name: axes[name] + 0.12 * axes[source] for name in followers}
    leaks = [finding for finding in diagnose(written(tmp_path, axes))["findings"] if finding["cause"] == "cross_axis"]
    assert [(leak["estimate"]["other"], set(leak["axes"])) for leak in leaks] == [(source, followers)]


def test_a_source_that_no_pair_shows_is_a_leak(tmp_path: Path) -> None:
    """0.5 x 4000 x 0.038^2 = 3 nats of the white noise on each of four axes, and some of the drift: by itself gz alone
    shows it."""
    random = np.random.default_rng(14)
    names = ("gx", "gy", "gz", "ax", "ay")
    axes = {name: random.standard_normal(2 * SAMPLES) + drift(random, 2 * SAMPLES, 0.02) for name in names}
    axes |= {name: axes[name] + 0.038 * axes["gy"] for name in names if name != "gy"}
    (leak,) = diagnose(written(tmp_path, axes))["findings"]
    assert leak["cause"] == "cross_axis"
    assert leak["estimate"]["other"] == "gy"
    assert len(leak["axes"]) >= 3


@pytest.mark.parametrize("beside_f", [False, True])
def test_a_source_with_a_strong_drift_is_no_hidden_quantity(tmp_path: Path, *, beside_f: bool) -> None:
    """gx leaks 0.35 and 0.2 of its readings into two axes, K/N 0.1; beside a quantity that moves all six by 0.05 N a
    second the loadings hold the truth within 4 sd. A model that states the leak leaves nothing of it in its record."""
    random = np.random.default_rng([15, beside_f])
    n = 7200
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    f = np.cumsum(0.05 * random.standard_normal(n)) if beside_f else np.zeros(n)
    axes = {
        name: random.standard_normal(n) + drift(random, n, 0.03 if beside_f or name != "gx" else 0.1) + f
        for name in names
    }
    axes |= {name: axes[name] + share * axes["gx"] for name, share in (("gy", 0.35), ("ax", 0.2))}
    log, model = written(tmp_path, axes), tmp_path / "model.yaml"
    found = {finding["cause"]: finding for finding in diagnose(log, write_model=model)["findings"]}
    assert set(found) == {"cross_axis", "hidden_input"} if beside_f else {"cross_axis"}
    assert found["cross_axis"]["estimate"]["other"] == "gx"
    assert set(found["cross_axis"]["axes"]) == {"gy", "ax"}
    assert diagnose(log, model=model)["findings"] == []
    if beside_f:
        sizes = [axis["estimate"]["loading"] for axis in found["hidden_input"]["axes"].values()]
        assert len(sizes) == 6
        assert all(abs(size["mean"] - 0.05) < 4.0 * size["sd"] for size in sizes)


def test_a_leak_is_no_common_source(tmp_path: Path) -> None:
    """The drift of the other axis leaks as well; of a common source each axis has a drift of its own. Of 100 modules
    one has a finding by chance: two of eight have a probability of 0.3 %."""
    random = np.random.default_rng(45)
    n = 2 * SAMPLES
    records, alone, by_chance = case_records(1, 8), 0, 0
    for _ in range(records):
        other = random.standard_normal(n) + drift(random, n, 1.0)
        leaking = random.standard_normal(n) + 0.3 * other
        axes = diagnose(written(tmp_path, {"gx": leaking, "gy": other}), axes=("gx", "gy"))["axes"]
        causes = {name: [finding["cause"] for finding in axes[name]["findings"]] for name in axes}
        assert causes["gx"] == ["cross_axis"]
        by_chance += bool(causes["gy"])
        common = random.standard_normal(n)
        axes = diagnose(
            written(
                tmp_path,
                {
                    name: math.sqrt(0.7) * random.standard_normal(n) + math.sqrt(0.3) * common + drift(random, n, 1.0)
                    for name in ("gx", "gy")
                },
            ),
            axes=("gx", "gy"),
        )["axes"]
        findings = [finding for entry in axes.values() for finding in entry["findings"]]
        named = {finding["cause"] for finding in findings}
        possible = {cause for finding in findings for cause in finding["also_possible"]}
        assert "shared" in named | possible
        alone += named == {"shared"}
        if named == {"shared"}:
            for name, entry in axes.items():
                (finding,) = entry["findings"]
                assert finding["shared_with"] == [finding["estimate"]["other"]] == list(axes.keys() - {name})
                assert finding["gain"]["bias_rmse"]["horizon_s"] == {}
    # A leak of the one with the smaller drift explains some of the records as well.
    assert alone > records // 2
    assert by_chance <= records // 8


def test_the_real_accelerometers_share_noise() -> None:
    """Innovations of ax and ay go together by 0.33 to 0.46 at 1 Hz in all runs, beside a line on both."""
    for run in (1, 2, 4)[: case_records(1, 3)]:
        recording = shared_recording(f"adis16405_run{run}.npz").between(0.0, 4000.0)
        record = record_from(recording, Model.load(None), 1.0, ("ax", "ay"))
        states = {name: record.axes[name].refit() for name in ("ax", "ay")}
        found = {name: Diagnosed(state, state, record) for name, state in states.items()}
        assert shared.CAUSE.grouping.settle is not None
        shared.CAUSE.grouping.settle(record, found)
        for name, other in combinations(found, 2):
            (finding,) = found[name].findings
            assert finding.look.estimate["other"] == other
            assert 0.3 < finding.look.estimate["correlation"]["median"] < 0.6
            assert gain_of(finding, record) > 0.03
