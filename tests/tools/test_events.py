"""Events and sources of all axes: what is one, and which of them matter."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from selfcal.adequacy.identify_document import Identified
from selfcal.adequacy.summary import SheetNumber, noisier
from selfcal.bank.axis_result import Estimate
from selfcal.batch.fail_on import outcome
from selfcal.diagnosis import events, words
from selfcal.diagnosis.alias import alias_of
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.channel_looks import FORMS, side_at
from selfcal.diagnosis.events import EventMember, grouped
from selfcal.diagnosis.finding import Finding
from selfcal.diagnosis.record import Record, record_from
from selfcal.diagnosis.suspicion import suspicions
from selfcal.likelihood.state import Look, State, log_normal, normal_entry
from selfcal.logs.recording import load, save
from selfcal.model.file import Model
from selfcal.model.forms import formed
from selfcal.show import identification
from selfcal.show.diagnosis_lines import show
from selfcal.verbs import identify as identify_verb
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify


def member(axis: str, cause: str, net: float, time_s: float | None = None, **estimate: Any) -> EventMember:
    """A finding that only its look tells apart."""
    when = None if time_s is None else (time_s, time_s)
    look = Look(cause, net, net, estimate, {}, when=when)
    state = cast(State, None)
    entry = {"when": None if when is None else list(when), "estimate": estimate, "gain": None}
    return EventMember(axis, Finding(look, 1, state, state), entry, 1.0)


def line(hz: float) -> dict[str, Any]:
    return {"frequency_hz": normal_entry(hz, 1e-4 * hz, "Hz"), "amplitude": normal_entry(1.0, 0.1, "deg/s")}


def parts(members: list[EventMember], quantity: dict[str, Any] | None = None) -> set[tuple[str, ...]]:
    """Each event: its cause, then axis and net of every member."""
    return {
        (one.cause, *sorted(f"{each.axis} {each.finding.look.net:g}" for each in one.members))
        for one in grouped(members, quantity)
    }


def test_jumps_of_one_time_are_one_event() -> None:
    """Two jumps 19 s apart on three axes each: an axis shows an event once, and the nearest one takes it."""
    times = {"ax": (540.2, 559.1), "ay": (541.0, 558.7), "gz": (539.8, 560.2)}
    members = [member(axis, "step", 50.0 - k, each) for axis, both in times.items() for k, each in enumerate(both)]
    assert parts(members) == {("step", "ax 50", "ay 50", "gz 50"), ("step", "ax 49", "ay 49", "gz 49")}


def test_a_line_its_harmonics_and_side_bands_are_one_source() -> None:
    found = [("gx", 0.23), ("gy", 0.46), ("gy", 0.215), ("az", 0.2301), ("az", 0.33)]
    members = [member(axis, "periodic", 40.0 - k, **line(hz)) for k, (axis, hz) in enumerate(found)]
    assert parts(members) == {("periodic", "az 37", "gx 40", "gy 38", "gy 39"), ("periodic", "az 36")}


def test_pairs_that_meet_are_one_group() -> None:
    """Also where the pair that joins two groups comes last."""
    pairs = [("gx", "gy"), ("gz", "ax"), ("ay", "az"), ("gy", "gz")]
    members = [member(one, "shared", 30.0 - k, other=two) for k, (one, two) in enumerate(pairs)]
    assert parts(members) == {("shared", "gx 30", "gy 27", "gz 29"), ("shared", "ay 28")}


def test_a_law_and_a_channel_are_one_source_and_other_causes_are_not() -> None:
    members = [member(axis, "flicker", 20.0) for axis in ("gy", "az")]
    members += [member(axis, "temperature", 30.0) for axis in ("gx", "az")]
    members += [member("gx", "cross_axis", 25.0, other="ay"), member("gz", "cross_axis", 24.0, other="ay")]
    members += [member("gy", "cross_axis", 23.0, other="az")]
    assert parts(members) == {
        ("flicker", "az 20", "gy 20"),
        ("temperature", "az 30", "gx 30"),
        ("cross_axis", "gx 25", "gz 24"),
        ("cross_axis", "gy 23"),
    }


def test_pieces_of_a_hidden_quantity_are_its_own() -> None:
    """Jumps of its times, leaks among its axes that it explains, and the slow noise that these share. Not its white
    noise, nor a leak that comes beside it, nor an axis that it does not move."""
    quantity = {"axes": {"gx": {}, "gy": {}, "ax": {}}, "estimate": {"jumps": [{"time_s": 812.0, "size": 3.0}]}}
    slow, white = {"band_hz": [0.0, 0.04]}, {}
    members = [
        member("gx", "step", 60.0, 815.0),
        member("gx", "step", 59.0, 1100.0),
        member("az", "step", 58.0, 813.0),
        member("ax", "cross_axis", 57.0, other="gy", source="hidden_input"),
        member("gy", "cross_axis", 56.5, other="ax"),
        member("ax", "cross_axis", 56.0, other="gz"),
        member("gy", "shared", 55.0, other="gx", **slow),
        member("gx", "shared", 54.0, other="gy", **white),
    ]
    assert parts(members, quantity) == {
        ("hidden_input", "ax 57", "gx 60", "gy 55"),
        ("step", "gx 59"),
        ("step", "az 58"),
        ("cross_axis", "gy 56.5"),
        ("cross_axis", "ax 56"),
        ("shared", "gx 54"),
    }


@pytest.mark.parametrize(
    ("half", "identified", "factor", "moved", "matters"),
    [
        (0.1, True, 1.21, 0.21, True),
        (0.1, True, 1.08, 0.08, False),
        (0.01, True, 0.93, -0.07, True),
        (0.1, True, math.inf, 0.3, True),
        (0.4, False, 1.9, 0.6, False),
        (0.4, False, math.inf, 0.8, True),
    ],
)
def test_a_number_must_move_by_more_than_half_its_interval(
    half: float, identified: bool, factor: float, moved: float, matters: bool
) -> None:
    """Stated: 1 with this half of its interval; one that is not identified has an upper limit, here 1 + half."""
    estimate = Estimate(1.0, 1.0, half / 1.6449, 1.0 - half, 1.0 + half, identified)
    known = cast(Identified, SimpleNamespace(summary={"rrw": SheetNumber(estimate)}, group_unit="deg/s", unit="deg/s"))
    assert (events._times("K", factor, moved, known) is not None) == matters


def test_numbers_in_words_have_two_digits_and_no_lists() -> None:
    told = words.inflation_sentence({"N": 1.2345, "K": math.inf, "B": 296.23})
    assert "N 23 % too large" in told and "K not identified" in told and "B 300 times too large" in told
    assert "K hidden" in words.inflation_sentence({"K": 0.0})  # without the cause there is no walk at all
    estimate = {
        "coefficient": normal_entry(0.031100000000000003, 0.0, "deg/s/degC"),
        "intervals": [[1199.5, 1200.8], [1300.0, 1302.25]],
        "form_also_possible": ["rate", "square"],
        "statistic": "jumps_of_the_bias",
        "duration_s": normal_entry(3.25, 0.0, "s"),
        "angle_y_deg": normal_entry(0.4, 0.0, "deg"),
        "measured": 12.32,
    }
    text = words.sizes(estimate)
    assert "0.0311 deg/s/degC" in text and "from 1199.5 s to 1200.8 s, 1300 s to 1302.25 s, 3.55 s in all" in text
    assert "not to be told from its rate, its square" in text and "the bias jumps" in text
    assert "duration 3.25 s" in text and "angle y 0.4 deg" in text
    assert not set(text) & set("[]'_") and "12.32" not in text


def test_a_finding_reads_as_it_is_said() -> None:
    """A level by its noise, a settling by its name. What happened once has no other time that could confirm it."""
    loud = {"ratio": {"median": 4.71, "unit": "1"}}
    motion = {"cause": "motion", "axes": {"ay": {"estimate": loud}}, "estimate": {"intervals": [[3.0, 9.0]]}}
    assert words.what(motion) == "motion on ay: from 3 s to 9 s" and words.how_much(motion) == "ay 4.7 times the noise"
    assert "4.71 times the noise" in words.sizes(loud)
    settling = {"cause": "turn_on", "axes": {"gz": {"estimate": {}}}, "estimate": {}}
    assert words.what(settling) == "turn-on transient on gz"
    assert words.small([settling]).startswith("1 small finding (turn-on transient on gz)")
    of_time, always = {"time_s": normal_entry(70.0, 1.0, "s")}, {"channel": "temp"}
    once, again = "an event: no other time can confirm it", "not confirmed on held-out time"
    for cause, estimate, told in (
        ("tilt", of_time, once),
        ("variance_change", of_time, once),
        ("variance_change", always, again),
        ("flicker", {}, again),
    ):
        finding = {"cause": cause, "estimate": estimate, "changes": {}}
        assert words.effects({**finding, "confirmed": False}) == told
        assert words.effects({**finding, "confirmed": True}) == ""


@pytest.mark.parametrize(
    ("hz", "samples", "temperature", "told"),
    [
        (1.0 / 940.0, 2600, False, "Record longer, with the temperature at the sensor: 2.8 turns"),
        (1.0 / 510.0, 3000, True, "Record longer: 5.9 turns"),
        (0.07, 3000, False, "Look for what turns"),
        (0.41, 3000, False, "Record at another rate"),
    ],
)
def test_a_line_is_advised_by_its_frequency(hz: float, samples: int, temperature: bool, told: str) -> None:
    """At 1 Hz. One of few turns may be a drift, one near half the rate an alias; another is looked for where it is."""
    channels = {"temperature": np.zeros(samples)} if temperature else {}
    record = Record(1.0, {}, channels, {}, np.ones(samples, bool))
    advice = CAUSES["periodic"].advice(Look("periodic", 20.0, 10.0, line(hz), {}), record)
    assert advice.startswith(told)


@pytest.mark.parametrize(("line", "jump", "hz"), [(0.03, 0.1, 0.13), (0.025, 0.4, 0.21), (0.0, 0.12, 0.1)])
def test_a_row_and_the_table_leave_out_the_same(line: float, jump: float, hz: float, tmp_path: Path) -> None:
    """480 s of white noise of 0.01 with a line and a jump, without which the most likely walk takes all of the white
    noise, so that none is stated. Where a row says that N is too small the table does, and of one finding as much.
    Truth: N as drawn, which 480 samples know by 3.2 %; three times that."""
    random, t = np.random.default_rng(6), np.arange(480)
    values = 0.01 * random.standard_normal(t.size) + line * np.sin(2.0 * math.pi * hz * t) + jump * (t >= 300)
    save(tmp_path / "log.npz", {"gy": ("deg/s", values), "gz": ("deg/s", 0.01 * random.standard_normal(t.size))}, 1.0)
    document = diagnose(tmp_path / "log.npz")
    found = {one["cause"]: one["changes"]["gy"] for one in document["findings"]}
    assert found.keys() == ({"periodic", "step"} if line else {"step"})
    number = document["axes"]["gy"]["numbers"]["N"]
    assert number["after"]["median"] == pytest.approx(0.01, rel=0.1)
    off = number["before"] / number["after"]["median"]
    for change in found.values():
        assert off == 0.0 or "N" not in change["material"] or (change["N"] < 1.0) == (off < 1.0)
    if not line:
        assert found["step"]["N"] == pytest.approx(off, rel=1e-6)
    for number in document["axes"]["gz"]["numbers"].values():  # nothing is found there
        assert number["before"] == pytest.approx(number["after"]["median"]) or not number["after"]["identified"]


@pytest.mark.parametrize(("sd", "applied"), [(0.02, True), (0.06, False)])
def test_a_coefficient_that_is_known_is_applied(sd: float, applied: bool) -> None:
    """Half of its 90 % interval is 3.3 % of it, or 9.9 %."""
    axes = {"gx": {"estimate": {"coefficient": normal_entry(-1.0, sd, "deg/s/V")}}}
    finding = {"cause": "supply", "axes": axes, "estimate": {}, "record_next": "Change the supply."}
    assert words.action(finding).startswith("Apply it") == applied


@pytest.mark.parametrize(("hz", "shown", "lost"), [(3.29, 0.29, 0.0), (11.38, 0.38, 0.2), (0.71, 0.29, 0.01)])
def test_a_line_in_means_is_looked_up_in_the_readings(hz: float, shown: float, lost: float, tmp_path: Path) -> None:
    """Half an hour at 40 Hz, white noise of 1 and a line of 0.3, some samples lost. Means of 1 s show it at `shown`.
    Truth: what is drawn.
    A bin is 1/1800 Hz; the noise leaves 0.0053 of the amplitude, times the root of the bins about it: 5 %."""
    random = np.random.default_rng(4)
    t = np.arange(72_000) / 40.0
    values = random.standard_normal(t.size) + 0.3 * np.sin(2.0 * np.pi * hz * t)
    kept = random.random(t.size) >= lost
    np.savez(tmp_path / "log.npz", allow_pickle=False, **{"t[s]": t[kept], "gx[deg/s]": values[kept]})
    seen = alias_of(load(tmp_path / "log.npz"), "gx", shown, 5e-4, 1.0)
    assert seen is not None
    assert seen[0] == pytest.approx(hz, abs=1.0 / 1800.0) and seen[1] == pytest.approx(0.3, rel=0.1)
    assert alias_of(load(tmp_path / "log.npz"), "gx", 0.17, 5e-4, 1.0) is None


def test_what_is_recorded_already_is_not_advised(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line of means whose true frequency the readings show: the list and the axis alike say where to look for it."""
    entry = {"estimate": dict(line(0.29)), "axes": {"gx": {"estimate": {}}}, "cause": "periodic", "record_next": ""}
    monkeypatch.setattr(events, "alias_of", lambda *_: (3.29, 0.3))
    recording = SimpleNamespace(rate_hz=40.0, duration_s=1800.0, columns={"gx": SimpleNamespace(unit="deg/s")})
    found = {"gx": SimpleNamespace(record=SimpleNamespace(rate_hz=1.0))}
    assert events._add_readings(entry, cast(Any, recording), cast(Any, found))
    assert words.action(entry) == "Look for what turns or switches at 3.29 Hz."
    assert "amplitude in the readings 0.3 deg/s" in entry["words"]


TEMPERATURE = {"gx": 0.0045, "gy": -0.0038, "ax": 0.0013, "az": -0.0011}
WHITE = {"gx": 0.004, "gy": 0.004, "gz": 0.012, "ax": 0.001, "ay": 0.001, "az": 0.001}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """20 minutes at 2 Hz: a warm-up by 9 degC on four axes, and a knock on all for 2 s."""
    random = np.random.default_rng(5)
    n, rate = 2400, 2.0
    t = np.arange(n) / rate
    warm = 22.0 + 9.0 * (1.0 - np.exp(-t / 400.0)) + 0.4 * np.sin(t / 90.0)
    knock = np.where((t >= 611.0) & (t < 613.0), 1.0, 0.0)
    columns = {"t[s]": t}
    for name, N in WHITE.items():
        y = N * math.sqrt(rate) * random.standard_normal(n) + TEMPERATURE.get(name, 0.0) * warm
        unit = "deg/s" if name[0] == "g" else "m/s^2"
        columns[f"{name}[{unit}]"] = y + 400.0 * N * knock * random.standard_normal(n)
    columns["temp[degC]"] = warm
    path = tmp_path_factory.mktemp("events") / "log.csv"
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", fmt="%.8g", header=",".join(columns), comments="")
    return dict(diagnose(path))


def test_a_knock_hides_no_temperature(drawn: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """Each is one entry, material, whatever the other's evidence: K of an axis that warms up is the temperature's.
    Truth: the record is drawn without a walk."""
    found = {one["cause"]: one for one in drawn["findings"] if one["material"]}
    assert found.keys() == {"motion", "temperature"} and len(drawn["findings"]) == 2
    assert set(found["motion"]["axes"]) == set(WHITE) and set(found["temperature"]["axes"]) == set(TEMPERATURE)
    for name, change in found["temperature"]["changes"].items():
        assert {"K", "bias"} <= set(change["material"]), name
        # The fitted column is about the middle of the record: the bias moves by the temperature's way from there.
        assert math.copysign(1.0, change["bias"]) == -math.copysign(1.0, TEMPERATURE[name])
    for name, axis in drawn["axes"].items():
        N = axis["numbers"]["N"]
        # 2400 samples know N by 1.4 %; three times that.
        assert N["after"]["median"] == pytest.approx(WHITE[name], rel=0.05) and N["before"] > 1.5 * WHITE[name]
        assert axis["verdict"] == "inadequate" and axis["small_findings"] == 0
        assert {one["of"] for one in axis["findings"]} == set(axis["causes"])
    assert outcome(drawn, "material").code == 1
    show(drawn)
    said = capsys.readouterr().out
    assert "nats" not in said and "round" not in said.replace("surroundings", "")
    assert len(said.splitlines()) < 40
    show(drawn, details=True)
    assert "net of the search" in capsys.readouterr().out


def test_small_findings_leave_an_axis_adequate(tmp_path: Path) -> None:
    """One reading in 50 is missing: none of the numbers moves. Truth: the record is white noise."""
    random = np.random.default_rng(9)
    t = np.arange(1800.0)[random.random(1800) > 0.02]
    rows = np.column_stack([t, 0.05 * random.standard_normal(t.size)])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", fmt="%.9g", header="t[s],gx[deg/s]", comments="")
    document = diagnose(tmp_path / "log.csv")
    axis = document.axes["gx"]
    assert [one.cause for one in document.findings] == ["missing_samples"] and not document.findings[0].material
    assert (axis.verdict, axis.small_findings, axis.causes) == ("adequate", 1, ["missing_samples"])
    assert [outcome(document, wanted).code for wanted in ("inadequate", "material", "missing_samples")] == [0, 0, 1]
    assert words.small(document.findings).startswith("1 small finding (missing samples on gx): ")


@pytest.mark.parametrize(("loud", "size_s", "seed"), [(5.0, 1.4, 1), (14.0, 0.4, 2), (4.5, 9.0, 3)])
def test_time_that_is_left_out_has_a_row(
    loud: float, size_s: float, seed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One axis of three shaken for a while, which moves no number once it is left out: a row of `diagnose`, a line of
    `identify`, each with the interval. Truth: the test's own, to the margin of 0.5 s."""
    random = np.random.default_rng(seed)
    values = 0.2 * random.standard_normal((3, 24_000))
    values[1, 10_000 : 10_000 + round(40.0 * size_s)] *= loud
    save(tmp_path / "log.npz", {f"g{axis}": ("deg/s", row) for axis, row in zip("xyz", values, strict=True)}, 40.0)
    document = diagnose(tmp_path / "log.npz", axes=["gy"], decimate=1.0)
    show(document)
    identification.show(identify(tmp_path / "log.npz", axes=["gy"], suspicion=False))
    shown = capsys.readouterr().out
    row = re.search(r"handling +motion on gy: from ([\d.]+) s", shown)
    line = re.search(
        r"\nmotion, left out.*: gy: ([\d.]+) to ([\d.]+) s\n|: motion, left out: ([\d.]+) to ([\d.]+) s\n", shown
    )
    assert row is not None and line is not None
    times = [float(one) for one in (*row.groups(), *filter(None, line.groups()))]
    assert times == pytest.approx([249.5, 249.5, 250.5 + size_s], abs=0.6)


def axis_of(**checks: dict[str, Any]) -> dict[str, Any]:
    return {"bias_now": {"unit": "deg/s"}, "checks": {name: {"passed": False, **one} for name, one in checks.items()}}


def test_identify_tells_an_event_in_one_line() -> None:
    """A knock of three axes, a jump of two, and statistics that they move; an axis with statistics alone keeps its own
    lines."""
    knock = {"value": 0.01, "intervals": [[88.0, 90.5]]}
    twice = {"value": 0.02, "intervals": [[87.5, 90.0], [300.0, 302.0]]}
    lag = {"innovation_lag1": {"value": 0.3, "limit": 0.1}}
    axes = {
        "gx": axis_of(motion=knock, jump={"value": 47.0, "time_s": 301.0}, **lag),
        "gy": axis_of(motion=knock, jump={"value": 12.4, "time_s": 299.5}, allan_4s={"value": 0.4}),
        "gz": axis_of(motion=twice),
        "ax": axis_of(**lag, allan_8s={"value": -0.21}, allan_16s={"value": 0.07}),
    }
    assert identification._not_adequate(axes) == [
        "not adequate: gx, gy: jump: the bias jumps at 301 s, by 12 to 47 nats: K includes that",
        "not adequate: gx, gy, gz: motion, left out: 87.5 to 90.5 s",
        "not adequate: gz: motion, left out: 300 to 302 s",
        "not adequate: ax: innovation_lag1 +0.300, beyond ±0.100; allan_8s model -21 %, 16s +7 %",
        "not adequate: statistics of gx, gy (allan_4s model +40 %) as well",
    ]


def test_identify_tells_statistics_of_alike_axes_in_one_line() -> None:
    """Three axes fail two statistics and one of these one more. A channel that goes like an axis by a settling of both
    is none beside it; a channel of one axis alone is."""
    wild = {name: {"value": size, "limit": 0.6} for name, size in (("innovation_a", 7.5), ("innovation_b", -0.9))}
    louder = {**wild, "innovation_b": {"value": -2.5, "limit": 0.6}}
    settling = {"value": 30.0, "tau_s": 44.0}
    channel = {"value": 21.0, "column": "ay", "form": "static"}
    axes = {
        "gx": axis_of(**wild, allan_2s={"value": -0.31}),
        "gy": axis_of(**louder, allan_2s={"value": 0.12}),
        "gz": axis_of(**wild),
        "ax": axis_of(turn_on=settling, channel=channel),
        "ay": axis_of(turn_on=settling),
        "az": axis_of(channel=channel),
    }
    axes["az"]["checks"]["channel"] = {**axes["az"]["checks"]["channel"], "column": "ax"}
    assert identification._not_adequate(axes) == [
        "not adequate: ax, ay: turn_on: a bias that settles within 44 s or so, by 30 nats: K includes that",
        "not adequate: az: channel: ax (static) explains 21 nats of it: N, K and the bias include that",
        "not adequate: gx, gy: innovation_a +7.500, beyond ±0.600; innovation_b -2.500 to -0.900, beyond ±0.600; "
        "allan_2s model -31 %, 2s +12 %",
        "not adequate: gz: innovation_a +7.500, beyond ±0.600; innovation_b -0.900, beyond ±0.600",
    ]


@pytest.mark.parametrize(("seed", "knock_s", "bursts_s"), [(1, 301.0, (90.0, 500.0)), (2, 140.0, (333.0, 620.0))])
def test_a_knock_and_bursts_of_one_axis_are_two_rows(
    seed: int, knock_s: float, bursts_s: tuple[float, float], tmp_path: Path
) -> None:
    """A knock of three axes for 2 s, and one of them three times as loud for 15 s twice. Each row has its axes and its
    time, and `simulate` makes both. Truth: the test's own, to the margin of 0.5 s and a piece; bursts to 2 s."""
    random, t = np.random.default_rng(seed), np.arange(7200) / 10.0
    values = {name: 0.05 * random.standard_normal(t.size) for name in ("gx", "gy", "gz")}
    for name in values:
        values[name][(t >= knock_s) & (t < knock_s + 2.0)] *= 40.0
    for begin in bursts_s:
        values["gy"][(t >= begin) & (t < begin + 15.0)] *= 3.0
    save(tmp_path / "log.npz", {name: ("deg/s", y) for name, y in values.items()}, 10.0)
    document = diagnose(tmp_path / "log.npz", write_model=tmp_path / "m.yaml")
    rows = {tuple(one["axes"]): one["estimate"]["intervals"] for one in document["findings"]}
    assert rows.keys() == {("gx", "gy", "gz"), ("gy",)}
    assert np.array(rows["gx", "gy", "gz"]) == pytest.approx(np.array([[knock_s - 0.5, knock_s + 2.5]]), abs=0.4)
    assert np.array(rows["gy",]) == pytest.approx(np.array([[b - 0.5, b + 15.5] for b in bursts_s]), abs=2.0)
    effects = Model.load(tmp_path / "m.yaml").simulate["effects"]
    assert sum("motion" in effect and "gy" in effect for effect in effects) == 2
    changes = {tuple(one["axes"]): one["changes"]["gy"]["N"] for one in document["findings"]}
    loud = {begin: values["gy"][(t >= begin - 0.2) & (t < begin + 15.2)] for begin in (knock_s, *bursts_s)}
    for axes, begins, exact in ((("gx", "gy", "gz"), [knock_s], 0.1), (("gy",), bursts_s, 0.03)):
        # White noise of 0.05 and what these readings have beyond it; the other ones of a stretch are left out too.
        truth = math.sqrt(1.0 + sum(float((loud[k] ** 2 / 0.05**2 - 1.0).sum()) for k in begins) / t.size)
        assert changes[axes] == pytest.approx(truth, abs=exact)


def test_what_is_left_out_is_suspected_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motion is left out and has its line. The suspicion is what is left: a look, or a test of the other readings."""
    motion = {"value": 0.01, "passed": False}
    document = {"axes": {name: {"checks": {"motion": motion}} for name in ("gx", "gy", "gz")}}
    document["axes"]["gy"]["checks"] |= {"saturation": motion}
    look = Look("pulse", 30.0, 20.0, {}, {})
    monkeypatch.setattr("selfcal.diagnosis.suspicion.suspicions", lambda *_: {"gx": look})
    identify_verb._suspect(document, cast(Any, None), cast(Any, None), ["gx", "gy", "gz"])
    assert [axis.get("suspicion") for axis in document["axes"].values()] == ["pulse", "saturation", None]


def test_a_noisy_axis_is_told_beside_its_siblings() -> None:
    """Three times the others' noise, known to 10 %; half as noisy, or with one sibling alone, is nothing."""
    white = {name: {**normal_entry(1.0, 0.06, "deg/s/sqrt(Hz)")} for name in ("gx", "gy")}
    white |= {"gz": normal_entry(3.1, 0.2, "deg/s/sqrt(Hz)"), "ax": normal_entry(9.0, 0.1, "g/sqrt(Hz)")}
    white |= {"ay": normal_entry(1.0, 0.1, "g/sqrt(Hz)")}
    assert noisier(white) == ["gz is 3.1 times as noisy as gx and gy"]
    assert noisier(white | {"gz": normal_entry(1.9, 0.1, "deg/s/sqrt(Hz)")}) == []
    # Of two siblings whose N a line has spoilt, 1e-4 and 1e-6, none is a measure.
    spoilt = {name: normal_entry(size, 0.1 * size, "deg/s/sqrt(Hz)") for name, size in (("gx", 1e-4), ("gy", 1e-6))}
    assert noisier(white | spoilt) == []


def test_a_lag_of_several_axes_is_by_all_of_them() -> None:
    """Normal posteriors of ln: the mean of 40 and 160 s, of one sd, is 80 s, known better by the square root of 2. Of
    axes that disagree, and of what may be 0, the first one's stands."""
    one, two, far = (log_normal(math.log(value), 0.5, "s") for value in (40.0, 160.0, 4000.0))
    both = events._of_all([one, two])
    assert both["median"] == pytest.approx(80.0)
    assert both["q95"] / both["median"] == pytest.approx(math.exp(1.645 * 0.5 / math.sqrt(2.0)), rel=1e-3)
    assert events._of_all([one, far]) is one
    assert events._of_all([one, one]) is one
    assert events._of_all([normal_entry(3.0, 4.0, "s"), one])["median"] == 3.0


def test_what_has_no_name_is_suspected_last(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A look that names a cause is the suspicion, whatever has no name gains; alone it is."""
    looks = {"gx": [Look("unexplained", 900.0, 890.0, {}, {}), Look("periodic", 40.0, 31.0, {}, {})]}
    looks |= {"gy": [Look("unexplained", 50.0, 45.0, {}, {}), Look("step", 9.0, 3.0, {}, {})]}
    monkeypatch.setattr("selfcal.diagnosis.suspicion.LOOKS", [lambda state, record: looks[state.axis]])
    random = np.random.default_rng(2)
    save(tmp_path / "log.npz", {name: ("deg/s", random.standard_normal(900)) for name in looks}, 1.0)
    found = suspicions(load(tmp_path / "log.npz"), Model.load(None), list(looks))
    assert {name: look.cause for name, look in found.items()} == {"gx": "periodic", "gy": "unexplained"}


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        ([1.14, 1.26], "14 to 26 % too large"),
        ([1 / 1.3, 1 / 1.2], "17 to 23 % too small"),
        ([1 / 4.3], "4.3 times too small"),
        ([1.4, 12.0], "1.4 to 12 times too large"),
        ([0.5, 1.1], "10 % too large or 2 times too small"),
    ],
)
def test_how_far_a_number_is_off(factors: list[float], said: str) -> None:
    """Values without a cause over those with it. Truth: 1 / 1.3 is 23 % less than 1."""
    changes = {
        f"g{axis}": {"K": factor, "N": 1.0, "B": 1.0, "material": ["K"]}
        for axis, factor in zip("xy", factors, strict=False)
    }
    assert words.effects({"changes": changes, "confirmed": None}) == f"K {said}"


def test_several_forms_of_a_channel_have_one_coefficient(tmp_path: Path) -> None:
    """A temperature that acts at once by 0.03 and through a play by 0.05: a slow change moves the bias by their sum.

    Two forms of a channel are known together better than each: the sum's deviation is below that of either. Truth: the
    test's own, to 4 of its deviations."""
    random = np.random.default_rng(11)
    t = np.arange(5000.0)
    warm = 25.0 + 6.0 * np.sin(t / 260.0) + 3.0 * np.sin(t / 97.0)
    late = formed(warm - 25.0, "play", 2.5, 0.0, 1.0)
    values = 0.05 * random.standard_normal(t.size) + 0.03 * (warm - 25.0) + 0.05 * late
    save(tmp_path / "log.npz", {"gx": ("deg/h", 3600.0 * values), "temp": ("degC", warm)}, 1.0)
    record = record_from(load(tmp_path / "log.npz"), Model.load(None), 1.0)
    state, members = record.axes["gx"].refit(), []
    for number, theta in enumerate([(FORMS.index("static"), math.nan, 0.0), (FORMS.index("play"), 2.5, 0.0)], 1):
        look = side_at(state, record, "temperature", theta)
        after = state.refit(**look.changes)
        entry = {"estimate": {"coefficient": look.estimate["coefficient"]}}
        members.append(EventMember("gx", Finding(look, number, state, after), entry, 3600.0))
        state = after
    sum_of = events._on(events.Event(members), "gx")["estimate"]["coefficient"]
    assert abs(sum_of["median"] - 3600.0 * 0.08) < 4.0 * sum_of["sd"]
    assert sum_of["sd"] < 3600.0 * min(float(sd) for sd in state.best.sd[-2:])
    assert events._sum_of_forms(members[:1]) == {}
