"""The population of a batch: honest intervals of its mean and spread, and the units and groups that are unlike it.

Truth: the mean, the spread and the faults that the units were drawn with. Tolerances: those of binomial counts.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fleet_power import model_of, study
from numpy.typing import NDArray

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.bank.axis_result import HALF_90
from selfcal.bank.library import Bank
from selfcal.base.units import factor
from selfcal.batch.batch_summary import apart_words, seen_from_words
from selfcal.batch.drift import DriftSeries, drifts_of
from selfcal.batch.population import FALSE_NAME, TWO_GROUPS, Measured, Population, populations
from selfcal.logs.recording import save
from selfcal.model.file import DEFAULT, Model, read_yaml
from selfcal.model.tables import make_tables
from selfcal.readings.budget import FALSE_ALARM
from selfcal.verbs.fleet import fleet

from conftest import CASE_RECORDS, case_records, run

Array = NDArray[np.float64]
#: Units of a batch, bank samples of a record, and the population: middle and spread of ln N and ln K.
UNITS, SAMPLES = 30, 1800
TRUTH = {"N": (math.log(0.03), 0.05), "K": (math.log(2e-3), 0.2)}


def measured_batch(first_seed: int, random: np.random.Generator) -> tuple[list[Measured], dict[str, Array]]:
    """A batch of records simulated and identified, and its units' true ln N and ln K. A walk is the model's only law:
    its posterior is the same beside others."""
    tree = read_yaml(DEFAULT, "model file")
    tree["hypotheses"] = {"random_walk": 1}
    tables = make_tables(Model.of_tree(tree, DEFAULT), 1.0, ("gx",))
    truth = {name: middle + spread * random.standard_normal(UNITS) for name, (middle, spread) in TRUTH.items()}
    known: dict[str, list[tuple[float, float]]] = {name: [] for name in TRUTH}
    for unit in range(UNITS):
        at = {name: math.exp(truth[name][unit]) for name in TRUTH}
        y, _ = simulate_bank_samples("random_walk", at, 1.0, SAMPLES, first_seed + unit)
        bank = Bank(tables)
        bank.push(y[:, None])
        for name, e in bank.report(0).parameters["random_walk"].items():
            known[name].append((math.log(e.median), math.log(e.q95 / e.q05) / (2.0 * HALF_90)))
    found = [Measured(name, "", "random_walk", *np.array(known[name]).T, np.arange(UNITS)) for name in TRUTH]
    return found, truth


def test_intervals_of_the_population_are_honest() -> None:
    """Mean and spread within their 90 % intervals in 85.5 to 94.5 % of 400 batches, units' shrunken ones likewise.

    Fewer batches: three standard deviations of a binomial share instead. Shrunken estimates of K are nearer the truth
    than the records' own by a tenth at least: their errors are half the spread.
    """
    batches = case_records(30, 400)
    off = 0.045 if batches == 400 else 3.0 * math.sqrt(0.09 / batches)
    random = np.random.default_rng(47)
    hits: dict[str, list[tuple[bool, bool, float]]] = {name: [] for name in TRUTH}
    error = {name: [0.0, 0.0] for name in TRUTH}
    unlike = 0
    for batch in range(batches):
        measured, truth = measured_batch(1 + 1000 * batch, random)
        for one in populations(measured, []):
            name = one.measured.name
            middle, spread = TRUTH[name]
            units = [one.shrunken(k) for k in range(UNITS)]
            inside = np.mean([u.q05 <= x <= u.q95 for u, x in zip(units, truth[name], strict=True)])
            m, t = one.fit.middle, one.fit.spread
            hits[name].append((m.q05 <= middle <= m.q95, t.q05 <= spread <= t.q95, float(inside)))
            error[name][0] += float(np.mean((np.array([u.median for u in units]) - truth[name]) ** 2))
            error[name][1] += float(np.mean((one.measured.y - truth[name]) ** 2))
            unlike += len(one.unlike)
    for name, rows in hits.items():
        share = np.mean(np.array(rows, float), axis=0)
        ratio = math.sqrt(error[name][0] / error[name][1])
        print(f"{name}: mean {share[0]:.3f}, spread {share[1]:.3f}, units {share[2]:.3f}; rms error {ratio:.3f} of own")
        assert np.all(np.abs(share - 0.9) <= off), (name, share)
    print(f"unlike: {unlike} of {batches * UNITS} units")
    assert math.sqrt(error["K"][0] / error["K"][1]) <= 0.9
    # the stated rate, and the 1.3 sd that a skew posterior of K adds; 3 sd of a Poisson count
    expected = FALSE_NAME * batches
    assert unlike <= 2.0 * expected + 3.0 * math.sqrt(2.0 * expected)


def drawn(
    random: np.random.Generator, n: int, spread: float, s: float, *, name: str = "gx.K", add: Array | None = None
) -> Measured:
    """A quantity as records measure it."""
    y = 1.0 + spread * random.standard_normal(n) + s * random.standard_normal(n) + (0.0 if add is None else add)
    return Measured(name, "", "random_walk", y, np.full(n, s), np.arange(n))


def test_a_group_is_not_its_parts() -> None:
    """A station 3 spreads off: it is named, its units are not, and the spread is that of the parts."""
    random = np.random.default_rng(3)
    station = ["bad" if k % 5 == 0 else f"s{k % 5}" for k in range(100)]
    lot = [f"L{k // 34}" for k in range(100)]
    add = 0.3 * np.array([name == "bad" for name in station], float)
    add[7] += 1.5
    (found,) = populations([drawn(random, 100, 0.1, 0.05, add=add)], [("station", station), ("lot", lot)])
    assert [(one.kind, one.name) for one in found.apart] == [("station", "bad")]
    assert found.apart[0].offset == pytest.approx(0.3, abs=0.12)  # 4 sd of a median over 20 units
    others = {one.at for one in found.unlike} - {7}
    assert len(found.unlike) - len(others) == 1 and len(others) <= 1  # one batch of ten has a false one
    assert found.fit.spread.q05 < 0.1 < found.fit.spread.q95


def test_a_station_that_is_a_lot_is_said_to_be_both() -> None:
    random = np.random.default_rng(4)
    station = ["north" if k < 15 else "south" if k < 40 else "west" for k in range(60)]
    lot = ["L1" if k < 15 else "L2" for k in range(60)]
    add = 0.5 * np.array([name == "L1" for name in lot], float)
    (found,) = populations([drawn(random, 60, 0.1, 0.05, add=add)], [("station", station), ("lot", lot)])
    assert [(one.kind, one.name, one.also) for one in found.apart] == [("station", "north", ("lot L1",))]


def test_a_batch_without_groups_has_none() -> None:
    """At most one of 200 batches of 60 units in six stations and three lots is said to have a group."""
    random = np.random.default_rng(5)
    names = [("station", [f"s{k % 6}" for k in range(60)]), ("lot", [f"L{k // 20}" for k in range(60)])]
    batches = case_records(40, 200)
    found: list[Population] = []
    for _ in range(batches):
        found += populations([drawn(random, 60, 0.15, 0.1, name=f"gx.{p}") for p in ("N", "K")], names)
    assert sum(bool(one.apart) for one in found) <= 1
    # 3 sd of a Poisson count
    expected = FALSE_NAME * batches
    assert sum(bool(one.unlike) for one in found) <= expected + 3.0 * math.sqrt(expected) + 1.0


def test_of_two_stations_none_is_blamed() -> None:
    """Whichever is shifted, and whichever is larger: the line states that the two differ. Of three one is named."""
    random = np.random.default_rng(41)
    for sizes, shifted in (((30, 30), 0), ((30, 30), 1), ((20, 40), 0), ((20, 40), 1), ((6, 6), 1)):
        names = ["east"] * sizes[0] + ["west"] * sizes[1]
        add = 0.9 * np.array([name == ("east", "west")[shifted] for name in names], float)
        (found,) = populations([drawn(random, len(names), 0.1, 0.03, add=add)], [("station", names)])
        (apart,) = found.apart
        assert {apart.name, apart.against} == {"east", "west"}
        sign = 1.0 if apart.name == ("east", "west")[shifted] else -1.0
        assert apart.offset == pytest.approx(0.9 * sign, abs=0.25)  # 4 sd of a difference of six and six
        words = apart_words(found.measured, apart)
        assert f"station {apart.against}'s, the two differ, " in words and "not the parts'" not in words
        # neither is the reference: the middle is between both, within 4 sd of a mean of 6 and of the difference
        assert found.fit.middle.median == pytest.approx(1.45, abs=0.17)
    names = [("east", "west", "south")[k % 3] for k in range(60)]
    add = 0.9 * np.array([name == "west" for name in names], float)
    (found,) = populations([drawn(random, 60, 0.1, 0.03, add=add)], [("station", names)])
    (apart,) = found.apart
    assert (apart.name, apart.against) == ("west", None)
    assert "the station's, not the parts'" in apart_words(found.measured, apart)


@pytest.mark.parametrize("units", [6, 10])
def test_small_batches_have_no_false_station(units: int) -> None:
    """FALSE_ALARM a batch for a group, FALSE_NAME for a unit, by Student's tails. The numbers of odd units that are
    tried add a quarter to the second: 5.0 % of 1500 batches of ten at 4 %."""
    random, batches = np.random.default_rng(6), case_records(60, 2000)
    names = [("station", ["ab"[k % 2] for k in range(units)]), ("lot", ["xyz"[3 * k // units] for k in range(units)])]
    apart = unlike = 0
    for _ in range(batches):
        found = populations([drawn(random, units, 0.15, 0.05, name=f"gx.{p}") for p in ("N", "K")], names)
        apart += any(one.apart for one in found)
        unlike += any(one.unlike for one in found)
    # 3 sd of a Poisson count
    for count, expected in ((apart, FALSE_ALARM * batches), (unlike, 1.25 * FALSE_NAME * batches)):
        assert count <= expected + 3.0 * math.sqrt(expected) + 1.0, (apart, unlike)


@pytest.mark.parametrize("units", [6, 9, 30])
def test_how_far_off_a_unit_must_be_to_be_seen(units: int) -> None:
    """The unit nearest to the middle, moved by a tenth less or more than `seen_from`. Six units see a few times less
    than 30 do: Student's tail at 1 in 1000 of 4 degrees of freedom over the normal's is 8.6 / 3.3."""
    random, seen = np.random.default_rng(units), []
    for _ in range(12):
        one = drawn(random, units, 0.15, 0.02)
        (found,) = populations([one], [])
        if found.unlike:
            continue
        k = int(np.argmin(np.abs(one.y - np.median(one.y))))
        for times, there in ((0.9, False), (1.1, True)):
            y = one.y.copy()
            y[k] = np.delete(one.y, k).mean() + times * found.seen_from
            (moved,) = populations([replace(one, y=y)], [])
            assert (k in {far.at for far in moved.unlike}) is there, (units, times)
        seen.append(found.seen_from / 0.15)
    assert {6: 5.0, 9: 3.8, 30: 3.0}[units] < np.mean(seen) < {6: 13.0, 9: 8.0, 30: 4.6}[units]


def test_a_batch_that_sees_nothing_says_so() -> None:
    """Six units whose K differs by a spread of ln of 1.5: the fifth degree of freedom leaves no factor below 1000."""
    (found,) = populations([drawn(np.random.default_rng(61), 6, 1.5, 0.2)], [])
    assert found.seen_from > math.log(1000.0)
    assert seen_from_words(found).startswith("more than 1000 times")
    (found,) = populations([drawn(np.random.default_rng(61), 30, 0.3, 0.2)], [])
    assert seen_from_words(found).endswith(" times")


@pytest.mark.parametrize(("units", "odd"), [(14, 3), (30, 5)])
def test_odd_units_do_not_hide_each_other(units: int, odd: int) -> None:
    """Units nine sd off on one side. Student's tail of the others, the odd ones known, names each in 98 and 99.9 %:
    all of them in 94 % of the batches or more. 3 sd of a binomial count."""
    random, batches = np.random.default_rng(units), case_records(25, 400)
    add = np.where(np.arange(units) < odd, 9.0 * math.hypot(0.15, 0.05), 0.0)
    named = 0
    for _ in range(batches):
        (found,) = populations([drawn(random, units, 0.15, 0.05, add=add)], [])
        named += {one.at for one in found.unlike} >= set(range(odd))
    assert named >= 0.94 * batches - 3.0 * math.sqrt(0.94 * 0.06 * batches)


def test_a_unit_that_is_odd_elsewhere_widens_nothing() -> None:
    """Two of 20 units are 3 sd off in K: neither ordinary nor unlike. Once another law or N names them
    they leave K, and its spread is the sound units'."""
    random = np.random.default_rng(71)
    K = drawn(random, 20, 0.2, 0.05, name="gx.K")
    K.y[:2] = K.y[2:].mean() + 3.1 * K.y[2:].std()
    N = drawn(random, 20, 0.05, 0.02, name="gx.N", add=np.where(np.arange(20) == 1, 0.8, 0.0))
    bias = drawn(random, 20, 0.2, 0.01, name="gx.bias")
    (wide,) = populations([K], [])
    kept = {one.measured.name: one for one in populations([N, K, bias], [], {"gx": {0}})}
    assert np.flatnonzero(~kept["gx.K"].kept).tolist() == [0, 1] and not kept["gx.K"].unlike
    assert [one.at for one in kept["gx.N"].unlike] == [1] and kept["gx.bias"].kept.all()  # ordinary there
    (alone,) = populations([replace(K, y=K.y[2:], s=K.s[2:], at=K.at[2:])], [])
    assert kept["gx.K"].fit.spread.median == pytest.approx(alone.fit.spread.median, rel=1e-9)
    assert wide.kept.all() and wide.fit.spread.median > 1.2 * alone.fit.spread.median
    other = [replace(one, name=one.name.replace("gx", axis)) for one, axis in ((N, "gx"), (K, "gy"), (bias, "gx"))]
    assert populations(other, [], {"gx": {0}})[1].kept.all()  # another axis


def test_dates_do_not_hide_a_station() -> None:
    """A day of one unit each is no group: a station stands out with the dates or without them, by the same number."""
    random = np.random.default_rng(82)
    station = [("station", ["nswe"[k % 4] for k in range(28)])]
    more = [("day", [f"2026-04-{1 + k:02}" for k in range(28)]), ("lot", [f"L{k}" for k in range(28)])]
    add = 0.22 * np.array([k % 4 == 1 for k in range(28)], float)
    one = drawn(random, 28, 0.1, 0.03, add=add)
    found = [populations([one], groupings)[0].apart for groupings in (station, station + more)]
    assert [(group.kind, group.name) for group in found[0]] == [("station", "s")]
    assert found[0] == found[1]
    assert found[0][0].log_p > math.log(FALSE_ALARM / 60)  # what all days and lots as groups asked for


def test_two_groups_without_a_label_are_named() -> None:
    """Half of 18 units are 1.5 times the others, 5.6 sd: the line has the members, and no unit is odd for it. Batches
    of one normal, or of a uniform distribution, are one group: none of 99 is two, a limit of 1 in 1000 each."""
    random = np.random.default_rng(91)
    inside = random.permutation(18)[:9]
    add = np.where(np.isin(np.arange(18), inside), math.log(1.5), 0.0)
    (found,) = populations(
        [drawn(random, 18, 0.07, 0.02, name="gz.N", add=add)], [("lot", ["ab"[k % 2] for k in range(18)])]
    )
    (apart,) = found.apart
    assert apart.kind == TWO_GROUPS and not found.unlike and found.kept.all()
    # either half may be the smaller one where they are equal
    others = sorted(set(range(18)) - set(inside.tolist()))
    assert list(apart.members) in (sorted(inside.tolist()), others)
    assert abs(apart.offset) == pytest.approx(math.log(1.5), abs=4.0 * 0.073 * math.sqrt(2.0 / 9.0))
    assert found.fit.spread.median == pytest.approx(0.07, rel=0.53)  # 3 sd of a spread by 16 degrees of freedom
    words = apart_words(found.measured, apart, [f"SN{k:02}" for k in range(18)])
    assert f"gz.N of SN{apart.members[0]:02}, " in words and all(f"SN{k:02}" in words for k in apart.members)
    for units in (9, 18, 60):
        for _ in range(case_records(100, 1000) // 3):
            flat = drawn(random, units, 0.0, 0.01)
            (plain,) = populations([drawn(random, units, 0.07, 0.02)], [])
            (uniform,) = populations([replace(flat, y=flat.y + random.uniform(size=units))], [])
            assert not plain.apart and (units < 18 or not uniform.apart)


def test_n_is_compared_whatever_the_law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In 2.5 times the noise a unit's walk does not show in 14 min: its likeliest law is `constant`, and its N is
    unlike the batch's: 14 spreads of 18 units."""
    monkeypatch.chdir(tmp_path)
    random, samples = np.random.default_rng(7), 840
    for k in range(18):
        N = 0.02 * math.exp(0.06 * random.standard_normal()) * (2.5 if k == 4 else 1.0)
        K = 4e-4 * math.exp(0.12 * random.standard_normal()) * (0.3 if k == 4 else 1.0)
        y = N * random.standard_normal(samples) + np.cumsum(K * random.standard_normal(samples))
        y += 0.1 * random.standard_normal()
        save(f"p{k:02}.npz", {"gy": ("deg/s", y)}, 1.0)
    result = fleet(["p*.npz"], "t.csv")
    with Path("t.csv").open(newline="") as stream:
        laws = {row["device"]: row["law"] for row in csv.DictReader(stream)}
    assert laws["p04"] == "constant" and result["population"]["gy.N"]["law"] == "random_walk"
    assert list(result["unlike"]) == ["p04"] and result["unlike"]["p04"][0].startswith("gy.N 2.")
    assert result["population"]["gy.N"]["units"] == 18


def test_the_study_of_odd_units() -> None:
    """Three batches of 24 units: where the oracle is sure, nine of ten odd units are named (93 % of 1278 are), and one
    batch has a false name at most."""
    counts, false = study(model_of(), 24, case_records(3, 60), 5)
    _, _, sure, _, hit = np.sum(list(counts.values()), axis=0)
    assert (
        sure >= 3 and hit >= 0.93 * sure - 3.0 * math.sqrt(0.07 * sure) and false <= max(1, 0.1 * case_records(3, 60))
    )


def series(
    random: np.random.Generator, units: int, dates: int, *, again: float, slope: dict[int, float]
) -> list[DriftSeries]:
    """A bias of each unit at several dates: it comes out differently by `again` at each start."""
    found = []
    for at in range(units):
        days = np.sort(random.uniform(0.0, 90.0, dates))
        y = random.standard_normal() + slope.get(at, 0.0) * days + again * random.standard_normal(dates)
        found.append(
            DriftSeries(
                at, "gz.bias", "deg/s", False, days, y + 0.01 * random.standard_normal(dates), np.full(dates, 0.01)
            )
        )
    return found


def test_a_drifting_unit_is_named() -> None:
    """A slope of 15 of its standard deviations; a unit that scatters ten times as the others hides none and has none.
    Units without a slope have one in FALSE_ALARM of them: 3 sd of a Poisson count."""
    random = np.random.default_rng(12)
    sd = 0.05 / (26.0 * math.sqrt(4))  # of 4 dates spread over 90 days
    for units in (1, 12):
        made = series(random, units, 4 if units > 1 else 9, again=0.05, slope={0: 15.0 * sd})
        made += [
            replace(one, at=units, y=10.0 * one.y) for one in series(random, 1, 4, again=0.05, slope={})[: units - 1]
        ]
        found = {one.of.at: one for one in drifts_of(made)}
        assert [at for at, one in found.items() if one.significant] == [0]
        assert found[0].per_day == pytest.approx(15.0 * sd, abs=4.0 * found[0].sd)
    pairs = [replace(one, days=one.days[:2], y=one.y[:2], s=one.s[:2]) for one in made[:3]]
    assert drifts_of(pairs) == []  # nothing shows what a start changes
    assert {one.of.at for one in drifts_of([*pairs, *made[3:]])} == set(range(13))
    units = case_records(300, 10_000)
    false = 0
    for dates in (2, 3, 6):
        still = series(random, units, dates, again=0.05, slope={})
        false += sum(one.significant for one in drifts_of([*still, *series(random, 20, 3, again=0.05, slope={})]))
    expected = FALSE_ALARM * 3 * (units + 20)
    assert false <= expected + 3.0 * math.sqrt(expected)


def test_coefficients_are_a_population(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The amplitude at turn-on and the coefficient of the temperature, of units that read in deg/s and in mrad/s.

    Middle and spread are within 3 sd of theirs (the interval's half is 1.64). The unit with four times the coefficient
    is unlike, the table has both coefficients, and no prior comes of them."""
    monkeypatch.chdir(tmp_path)
    tree = read_yaml(DEFAULT, "model file")
    tree["regressors"] = [
        {
            "name": "temperature",
            "kind": "column",
            "column": "temp",
            "unit": "degC",
            "reference": 25,
            "sd": {"gyro": 0.1},
        },
        {"name": "settling", "kind": "turn_on", "tau_s": 120, "sd": {"gyro": 1.0}},
    ]
    Path("m.yaml").write_text(yaml.safe_dump(tree))
    random, n = np.random.default_rng(31), 900
    truth = {"temperature": (0.01, 0.001), "settling": (-0.3, 0.05)}
    rows = ["file,device,date"]
    for k in range(14):
        temp = 25.0 + 6.0 * np.sin(2.0 * math.pi * np.arange(n) / 300.0 + k) + 0.01 * random.standard_normal(n)
        of = {name: middle + spread * random.standard_normal() for name, (middle, spread) in truth.items()}
        of["temperature"] *= 4.0 if k == 5 else 1.0
        y = of["temperature"] * (temp - 25.0) + of["settling"] * np.exp(-np.arange(n) / 120.0)
        y += (
            0.2 * random.standard_normal()
            + 0.03 * random.standard_normal(n)
            + np.cumsum(5e-4 * random.standard_normal(n))
        )
        unit = ("deg/s", "mrad/s")[k % 2]
        save(f"u{k}.npz", {"gx": (unit, y * factor("deg/s", unit)), "temp": ("degC", temp)}, 1.0)
        rows.append(f"u{k}.npz,d{k},2026-03-{1 + k:02}")
    Path("units.csv").write_text("\n".join(rows))
    result = fleet(["u*.npz"], "t.csv", model="m.yaml", units_table="units.csv", report="t.html", write_model="b.yaml")
    assert list(result["unlike"]) == ["d5"] and "gx.temperature" in result["unlike"]["d5"][0]
    for name, (middle, spread) in truth.items():
        one = result["population"][f"gx.{name}"]
        assert one["units"] == 14 and one["unit"] == ("deg/s/degC" if name == "temperature" else "deg/s")
        for key, value in (("middle", middle), ("spread", spread)):
            low, at, high = (one[key][of] for of in ("q05", "median", "q95"))
            assert at - 1.9 * (at - low) < value < at + 1.9 * (high - at), (name, key, one[key])
    with Path("t.csv").open(newline="") as stream:
        units = {
            row["recording"]: row["parameter_unit"]
            for row in csv.DictReader(stream)
            if row["parameter"] == "temperature"
        }
    assert units["u0.npz"] == "deg/s/degC" and units["u1.npz"] == "mrad/s/degC"
    assert "gx.settling" in Path("t.html").read_text() and "own_priors" in Path("b.yaml").read_text()
    assert read_yaml(Path("b.yaml"), "model file")["regressors"] == tree["regressors"]


def batch_of_files(
    folder: Path, units: int, seed: int, odd: dict[int, str], samples: int = 3600, axes: Sequence[str] = ("gx",)
) -> None:
    """Recordings at 1 Hz on a lattice, spread of ln K 0.15; `odd` units with their fault on one of the `axes`."""
    random = np.random.default_rng(seed)
    folder.mkdir()
    for k in range(units):
        columns: dict[str, tuple[str, Array]] = {}
        faulty = axes[int(random.integers(len(axes)))] if len(axes) > 1 else axes[0]
        for axis in axes:
            kind = odd.get(k, "") if axis == faulty else ""
            N = 0.05 * math.exp(0.05 * random.standard_normal())
            K = 2e-3 * math.exp(0.15 * random.standard_normal()) * (3.0 if kind == "walk" else 1.0)
            y = 0.3 * random.standard_normal() + np.cumsum(K * random.standard_normal(samples))
            y += N * random.standard_normal(samples)
            lattice = 0.02 if kind == "range" else 0.01
            if kind == "step":
                y[samples // 3 :] += 1.0
            if kind == "noise":
                y += 0.05 * random.standard_normal(samples)
            y = np.rint(y / lattice) * lattice
            if kind == "clipped":
                y = np.clip(y, -np.inf, np.quantile(y, 0.9))
            if kind == "stuck":
                y[500:2000] = y[500]
            columns[axis] = ("deg/s", y) if axis.startswith("g") else ("m/s^2", 0.1 * y)  # within the priors
        save(folder / f"u{k:04}.npz", columns, 1.0)


def test_units_of_one_kind_are_one_population(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch in three units has the population of the same batch in one; a device's recordings join across units.

    The lattice is compared as well: of the units, only the one with twice the step is unlike. The table keeps each
    recording's own unit."""
    monkeypatch.chdir(tmp_path)
    random, samples = np.random.default_rng(21), 900
    rows = ["file,device"]
    for k in range(12):
        lattice = 0.008 if k == 7 else 0.004
        y = 0.2 * random.standard_normal() + np.cumsum(3e-3 * random.standard_normal(samples))
        y = np.rint((y + 0.04 * random.standard_normal(samples)) / lattice) * lattice
        unit = ("deg/s", "mrad/s", "deg/h")[0 if k == 7 else k % 3]
        for folder, own in (("same", "deg/s"), ("mixed", unit)):
            (tmp_path / folder).mkdir(exist_ok=True)
            save(tmp_path / folder / f"r{k:02}.npz", {"gz": (own, y * factor("deg/s", own))}, 1.0)
        rows.append(f"r{k:02}.npz,d{k // 2}")  # two recordings a device, in two units
    Path("units.csv").write_text("\n".join(rows))
    for table in (None, "units.csv"):
        same, mixed = (fleet([f"{name}/*"], f"{name}.csv", units_table=table) for name in ("same", "mixed"))
        assert set(same["population"]) >= {"gz.N", "gz.bias"}
        for name, one in same["population"].items():
            other = mixed["population"][name]
            assert (other["units"], other["unit"], other["left_out"]) == (one["units"], one["unit"], one["left_out"])
            for key in ("median", "q05", "q95"):  # identify works in float: 1e-7 of a reading, 1e-4 of an estimate
                scale = one["spread"]["median"] * (1.0 if one["of"] == "value" else one["middle"]["median"])
                assert other["middle"][key] == pytest.approx(one["middle"][key], abs=0.01 * scale)
        stepped = {name: [text for text in words if "steps of" in text] for name, words in mixed["unlike"].items()}
        assert {name: len(words) for name, words in stepped.items() if words} == {"r07" if table is None else "d3": 1}
    with Path("mixed.csv").open(newline="") as stream:
        read = {
            row["recording"][-7:-4]: row["parameter_unit"] for row in csv.DictReader(stream) if row["parameter"] == "N"
        }
    assert read["r01"] == "mrad/s/sqrt(Hz)" and read["r02"] == "deg/h/sqrt(Hz)"


AXES = ("gx", "gy", "gz", "ax", "ay", "az")
KINDS = ("walk", "step", "clipped", "stuck", "range", "noise")


def test_odd_units_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of each kind of fault are named, or have no result; hardly another unit is: a mean of one in 300. In `make
    cases` each is on one of six axes."""
    monkeypatch.chdir(tmp_path)
    batches, units = case_records(1, 2), case_records(60, 300)
    missed: list[str] = []
    false: list[str] = []
    for seed in range(batches):
        places = np.random.default_rng(seed).permutation(units)[: 2 * len(KINDS)]
        odd = {int(k): KINDS[n % len(KINDS)] for n, k in enumerate(places)}
        batch_of_files(tmp_path / f"b{seed}", units, 100 + seed, odd, axes=AXES if CASE_RECORDS else AXES[:1])
        result = fleet([f"b{seed}/*"], f"t{seed}.csv")
        named = {int(name[1:]): words for name, words in {**result["unlike"], **result["not_judged"]}.items()}
        missed += [f"{seed}: {k} {kind}" for k, kind in odd.items() if k not in named]
        false += [f"{seed}: {k} {words}" for k, words in named.items() if k not in odd]
    print(f"missed {missed}\nfalse {false}")
    assert len(missed) <= 0.025 * 2 * len(KINDS) * batches
    assert len(false) <= max(1, batches)


def test_a_shared_cause_is_the_stations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fan at one station: `periodic` there and not elsewhere. The parts are not unlike for it."""
    monkeypatch.chdir(tmp_path)
    random, rows, n = np.random.default_rng(8), ["file,device,station"], 2000
    for k in range(16):
        y = 0.05 * random.standard_normal(n)
        if k < 6:
            y += 0.05 * np.sin(0.7 * np.arange(n) + k)
        save(f"u{k}.npz", {"gx": ("deg/s", y)}, 1.0)
        rows.append(f"u{k}.npz,d{k},{'north' if k < 6 else 'south'}")
    Path("units.csv").write_text("\n".join(rows))
    result = fleet(["u*.npz"], "t.csv", units_table="units.csv", diagnose=True)
    shared = [(one["kind"], one["name"], one["cause"]) for one in result["shared_causes"]]
    assert ("station", "north", "periodic") in shared
    assert not any("periodic" in " ".join(words) for words in result["unlike"].values())


def test_the_command_names_them(tmp_path: Path) -> None:
    """On stdout, and in the JSON with the population and the shrunken estimates."""
    batch_of_files(tmp_path / "b", 20, 9, {4: "walk"})
    found = run("fleet", "b/*", "-o", "t.csv", "--json", "t.json", cwd=tmp_path)
    assert found.returncode == 0 and "unlike the batch: u0004: gx.K" in found.stdout
    document: dict[str, Any] = json.loads((tmp_path / "t.json").read_text())
    population = document["population"]["gx.N"]
    assert population["units"] == 20 and population["middle"]["q05"] < 0.05 < population["middle"]["q95"] * 1.05
    assert document["population"]["gx.K"]["left_out"] == ["u0004"]
    own = document["units"]["u0003"]["gx.K"]
    assert own["q05"] < own["median"] < own["q95"] and own["unit"] == "deg/s^2/sqrt(Hz)"
