"""A noise level that follows a channel is named with the channel and its size; one that follows none names none. Axes
that one source shakes for a while are one finding.

Truth: the numbers that each record was drawn with, sample by sample.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, poisson

from selfcal import diagnose
from selfcal.base.grid import Array
from selfcal.diagnosis import module
from selfcal.diagnosis.causes import variance_change
from selfcal.diagnosis.record import Record
from selfcal.likelihood.state import NET_LEAST, P_LOOK, Look, State
from selfcal.model.forms import variance_of

from conftest import case_records

SAMPLES = 2400


def wave(random: np.random.Generator, n: int, turns: float) -> Array:
    """[n]: three slow waves of random phase, the mean 0 and the deviation 1."""
    t = np.arange(n) / n
    waves = [np.sin(2.0 * math.pi * (f * turns * t + random.uniform())) for f in (1.0, 1.7, 2.6)]
    found = sum(waves, np.zeros(n))
    return np.asarray((found - found.mean()) / found.std())


def switched(random: np.random.Generator, n: int) -> Array:
    """[n]: a machine that is on for a while and off for a while, 0 and 1."""
    edges = np.cumsum(random.uniform(n / 20.0, n / 6.0, 40))
    return np.asarray((np.searchsorted(edges, np.arange(n)) % 2).astype(np.float64))


def drift(random: np.random.Generator, n: int) -> Array:
    if random.random() < 0.5:
        return np.asarray(0.01 * random.standard_normal(n).cumsum())
    keep, x, found = math.exp(-1.0 / 200.0), 0.0, np.zeros(n)
    for k in range(n):
        x = keep * x + 0.3 * math.sqrt(1.0 - keep**2) * random.standard_normal()
        found[k] = x
    return found


def drawn(random: np.random.Generator, follows: str, n: int = SAMPLES) -> tuple[Array, Array, Array, float]:
    """Axis, temperature, other axis that a machine shakes, and d ln(sd) by the channel: 0 of "nothing"."""
    temperature = 25.0 + 3.0 * wave(random, n, random.uniform(0.8, 3.0))
    loud = 1.0 + random.uniform(1.0, 3.0) * switched(random, n)
    other = 2.0 * loud * random.standard_normal(n) + drift(random, n)
    ln_level, size = np.zeros(n), 0.0
    if follows == "temperature":
        size = float(random.choice([-1.0, 1.0])) * random.uniform(0.05, 0.12)
        ln_level = size * (temperature - 25.0)
    elif follows == "vibration":
        size = random.uniform(0.15, 0.4)  # of ln(variance)
        ln_level = 2.0 * size * np.log(loud)
    return np.exp(ln_level) * random.standard_normal(n) + drift(random, n), temperature, other, size


def looked(y: Array, temperature: Array, other: Array) -> list[Look]:
    states = {
        name: State(name, "deg/s", values - values.mean(), 1.0, 0.0, np.ones(y.size)).refit()
        for name, values in (("gx", y), ("gy", other))
    }
    roughness = {name: variance_of(one.y) for name, one in states.items()}
    names, present = {"temperature": "temp"}, np.ones(y.size, bool)
    record = Record(1.0, states, {"temperature": temperature}, names, present, recorded_hz=1.0, roughness=roughness)
    return [look for look in variance_change.looks(states["gx"], record) if look.when is None]


def test_a_level_that_follows_nothing() -> None:
    """Two channels beside it change, and the other axis is shaken: no more look so than a look may by chance."""
    random = np.random.default_rng(71)
    records = case_records(60, 1000)
    count = sum(any(look.net >= NET_LEAST for look in looked(*drawn(random, "nothing")[:3])) for _ in range(records))
    print(f"clean: {count} of {records}")
    assert count <= poisson.isf(1e-3, records * P_LOOK)


@pytest.mark.parametrize("kind", ["leak", "late", "square", "common"])
def test_noise_that_axes_share_is_no_level(kind: str) -> None:
    """One axis is in the other, at once, a sample late, or by its square, or both have noise of one wild source. The
    levels are constant: neither follows the other, beyond the looks that may by chance."""
    random = np.random.default_rng([76, len(kind)])
    records, count = case_records(6, 120), 0
    for _ in range(records):
        gy, own = random.standard_normal((2, SAMPLES))
        source = random.standard_t(4, SAMPLES)
        part = {"leak": gy, "late": np.roll(gy, 1), "square": 0.5 * gy**2, "common": source}[kind]
        gx = own + random.uniform(0.6, 2.5) * part
        gy += random.uniform(0.8, 2.0) * source * (kind == "common")
        for pair in ((gx, gy), (gy, gx)):
            count += any(look.net >= NET_LEAST for look in looked(pair[0], np.full(SAMPLES, 25.0), pair[1]))
    print(f"{kind}: {count} of {2 * records}")
    assert count <= poisson.isf(1e-3, 2 * records * P_LOOK)


@pytest.mark.parametrize("follows", ["temperature", "vibration"])
def test_a_level_that_follows_a_channel(follows: str) -> None:
    """The channel is the strongest; the coefficient of a temperature lies in its interval in 90 % of the records.

    The short-term variance of another axis is known from some samples, so its coefficient has no exact truth."""
    random = np.random.default_rng([72, len(follows)])
    records, right, inside = case_records(12, 150), 0, 0
    column = {"temperature": "temp", "vibration": "gy"}[follows]
    for _ in range(records):
        *axes, size = drawn(random, follows)
        look = max(looked(*axes), key=lambda one: one.net, default=None)
        if look is None or look.estimate["channel"] != column or look.net < NET_LEAST:
            continue
        right += 1
        found = look.estimate["coefficient"]
        inside += found["q05"] <= size <= found["q95"]
        assert found["median"] * size > 0.0
        assert look.estimate["ratio"]["median"] > 1.0
    print(f"{follows}: {right} of {records} right, {inside} inside")
    assert right >= binom.isf(1.0 - 1e-3, records, 0.95)
    if follows == "temperature":
        assert binom.isf(1.0 - 1e-3, right, 0.9) <= inside


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("quiet", ["throughout", "at first"])
def test_an_axis_without_noise_is_no_channel(quiet: str) -> None:
    """Another axis that reads one value has no variance to follow, and no library warns of its logarithm. One that is
    quiet for a part of the record has one."""
    random = np.random.default_rng(74)
    y, _, other, _ = drawn(random, "nothing")
    other[: None if quiet == "throughout" else y.size // 2] = 0.0
    axes = {
        "gx": State("gx", "deg/s", y, 1.0, 0.0, np.ones(y.size)).refit(),
        "gy": State("gy", "deg/s", other, 1.0, 0.0, np.ones(y.size)),
    }
    roughness = {name: variance_of(one.y) for name, one in axes.items()}
    record = Record(1.0, axes, {}, {}, np.ones(y.size, bool), recorded_hz=1.0, roughness=roughness)
    levels = {one.column: one.values for one in variance_change.levels(axes["gx"], record)}
    assert set(levels) == (set() if quiet == "throughout" else {"gy"})
    assert all(np.isfinite(values).all() for values in levels.values())
    variance_change.looks(axes["gx"], record)


def test_a_source_that_shakes_several_axes_for_a_while(tmp_path: Path) -> None:
    """A fan is on for a third of the record: two of three axes have twice the noise, two thirds of what is more are
    common. One finding has these axes and no other, and no axis follows another one.

    Ratios and N of the calm part lie within four deviations of what was drawn, 2.4 halves of their intervals. The
    evidence of a sample about an end is 0.81 +- 2.1 nats: of one axis alone 3 deviations of 60 samples."""
    random, t = np.random.default_rng(7), np.arange(800.0)
    begin, length, ratio = 400.0, 260.0, 2.0
    on, source = (t >= begin) & (t < begin + length), random.standard_normal(t.size)
    columns = {"t[s]": t}
    for name, loud in (("gx", True), ("gz", False), ("ax", True)):
        more = math.sqrt(ratio**2 - 1.0) * on * loud
        own, beside = random.standard_normal((2, t.size))
        y = (
            own
            + more * (source + math.sqrt(0.5) * beside) / math.sqrt(1.5)
            + 0.01 * random.standard_normal(t.size).cumsum()
        )
        columns[f"{name}[deg/s]" if name[0] == "g" else f"{name}[m/s^2]"] = 0.01 * y
    np.savez(tmp_path / "log.npz", allow_pickle=False, **columns)
    document = diagnose(tmp_path / "log.npz", write_model=tmp_path / "model.yaml")
    (finding,) = document["findings"]
    assert finding["cause"] == "variance_change" and set(finding["axes"]) == {"gx", "ax"}
    shape = {key: value["median"] for key, value in finding["estimate"].items()}
    assert shape == {"time_s": pytest.approx(begin, abs=60.0), "duration_s": pytest.approx(length, abs=60.0)}
    known = [(axis["estimate"]["ratio"], ratio) for axis in finding["axes"].values()]
    known += [(axis["numbers"]["N"]["after"], 0.01) for axis in document["axes"].values()]
    for estimate, truth in known:
        assert abs(estimate["median"] - truth) < 1.2 * (estimate["q95"] - estimate["q05"])
    assert "duration_s" in (tmp_path / "model.yaml").read_text(encoding="utf-8")


def test_noise_of_two_kinds_becomes_noise_of_one() -> None:
    """Two axes that one source shakes for a third of the record: there the noise that is left has the calm deviation,
    and the axes go together no more. Truth: 1, and 0 by n samples to four deviations."""
    random, n = np.random.default_rng(8), 3000
    on = (np.arange(n) >= 1000) & (np.arange(n) < 2000)
    source, level = random.standard_normal(n), np.where(on, 9.0, 1.0)
    rows = [random.standard_normal(n) + math.sqrt(8.0) * on * source for _ in range(2)]
    states = {
        name: State(name, "deg/s", row + drift(random, n), 1.0, 0.0, level).refit()
        for name, row in zip(("gx", "gy"), rows, strict=True)
    }
    loud = np.array([module.calmed(states, dict.fromkeys(states, on))[name] for name in states])
    apart = np.diff(loud[:, on], axis=1) / math.sqrt(2.0)
    assert np.std(apart, axis=1) == pytest.approx(1.0, abs=4.0 * math.sqrt(0.75 / 1000.0))
    assert abs(np.corrcoef(apart)[0, 1]) < 4.0 * math.sqrt(1.5 / 1000.0)


@pytest.mark.parametrize(("begin", "end", "ratio"), [(900, 1300, 1.6), (0, 800, 0.5), (1500, SAMPLES, 2.0)])
def test_a_level_for_a_while(begin: int, end: int, ratio: float) -> None:
    """Each time lies within four deviations of the drawn one and two samples; a level from the first sample on is a
    change where it ends."""
    random = np.random.default_rng([77, begin])
    level = np.where((np.arange(SAMPLES) >= begin) & (np.arange(SAMPLES) < end), ratio, 1.0)
    state = State(
        "gx", "deg/s", level * random.standard_normal(SAMPLES) + drift(random, SAMPLES), 1.0, 0.0, np.ones(SAMPLES)
    )
    record = Record(1.0, {"gx": state}, {}, {}, np.ones(SAMPLES, bool))
    look = max(variance_change.looks(state.refit(), record), key=lambda one: one.net)
    truth = {"time_s": float(begin or end), "ratio": ratio if begin else 1.0 / ratio}
    truth |= {"duration_s": float(end - begin)} if begin and end < SAMPLES else {}
    assert look.estimate.keys() == truth.keys()
    for key, value in truth.items():
        assert abs(look.estimate[key]["median"] - value) < 4.0 * look.estimate[key]["sd"] + 2.0 * (key != "ratio")
