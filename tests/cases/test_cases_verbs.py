"""Parts of a recording, exit codes for a production line, and ways out of long work.

Truth: the rows of the files that a test writes, the library behind the gate, and the parameters of drawn records.
"""

from __future__ import annotations

import json
import math
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gated import Gated
from numpy.typing import NDArray

from selfcal.adequacy.identify import identify_axis
from selfcal.base import ending
from selfcal.base.errors import UserError
from selfcal.batch.fail_on import outcome
from selfcal.diagnosis import diagnose as diagnose_module
from selfcal.diagnosis import integrity, loop, suspicion
from selfcal.diagnosis.record import record_from
from selfcal.likelihood import fit, work
from selfcal.logs.recording import Column, Recording, load, save
from selfcal.model.file import Model
from selfcal.model.regressors import columns_of
from selfcal.readings import gate
from selfcal.readings.rest import rest_of
from selfcal.show.diagnosis_lines import show
from selfcal.verbs.compare import compare
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.replay import replay

from conftest import COMMAND, case_records, run, shared_case

UNITS = {"gx": "deg/s", "gy": "deg/s", "gz": "deg/s", "ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2"}
LEVELS = {"gx": 0.1, "gy": -0.2, "gz": 0.3, "ax": 0.1, "ay": -0.3, "az": 9.8}
#: White noise densities below N of the default model's gate.
DENSITIES = {"deg/s": 0.05, "m/s^2": 0.004}


def quiet(seed: int, rate_hz: float, duration_s: float, axes: tuple[str, ...] = tuple(UNITS)) -> dict[str, Any]:
    """White noise of six axes at rest: name -> (unit, values)."""
    random = np.random.default_rng(seed)
    n = round(rate_hz * duration_s)
    return {
        name: (UNITS[name], LEVELS[name] + DENSITIES[UNITS[name]] * np.sqrt(rate_hz) * random.standard_normal(n))
        for name in axes
    }


def shaken(columns: dict[str, Any], rate_hz: float, first_s: float, last_s: float) -> None:
    """In the hand: 40 deg/s and 2 m/s^2 of a slow swing."""
    for k, (unit, values) in enumerate(columns.values()):
        t = np.arange(values.size) / rate_hz
        moved = (t >= first_s) & (t < last_s)
        size = 40.0 if unit == "deg/s" else 2.0
        values[moved] += size * np.sin(2.0 * np.pi * 0.83 * t[moved] + k)


def with_gaps(seed: int) -> Recording:
    """1000 rows at 10 Hz, 30 samples missing in three gaps."""
    random = np.random.default_rng(seed)
    t = np.arange(1030) / 10.0
    kept = np.ones(1030, bool)
    for at in random.choice(np.arange(50, 950, 50), 3, replace=False):
        kept[at : at + 10] = False
    return _recording({"gx": ("deg/s", random.standard_normal(1030)[kept])}, t[kept])


def _recording(columns: Mapping[str, tuple[str, NDArray[np.float64]]], t: NDArray[np.float64]) -> Recording:
    missing = np.rint(np.diff(t, prepend=t[0] - 0.1) * 10.0).astype(np.int64) - 1
    return Recording(
        Path("log.npz"),
        10.0,
        {name: Column(name, unit, values) for name, (unit, values) in columns.items()},
        missing,
        {},
        np.zeros(t.size),
    )


# ------------------------------------------------------------------------------------------------------------- parts


@pytest.mark.parametrize(("start_s", "end_s"), [(None, 30.0), (20.05, None), (7.7, 88.8), (0.0, 1e9)])
def test_a_stretch_is_the_rows_between_its_times(start_s: float | None, end_s: float | None) -> None:
    """Against the times themselves: every row of the stretch is a row of the recording at the same time, and no row
    with such a time is left out."""
    whole = with_gaps(4)
    part = whole.between(start_s, end_s)
    kept = (whole.time_s >= (start_s or 0.0)) & (whole.time_s < (end_s or 1e9))
    np.testing.assert_array_equal(part.columns["gx"].values, whole.columns["gx"].values[kept])
    np.testing.assert_allclose(part.start_s + part.time_s, whole.time_s[kept], atol=1e-9)
    assert part.missing_before[0] == 0 and part.moving == 0
    assert part.lost == part.missing_before.sum()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"start_s": 9.0, "end_s": 4.0}, "--start 9 --end 4: the start must lie before the end"),
        ({"start_s": -1.0}, "--start -1: takes seconds from the beginning of the recording, 0 or more"),
        ({"start_s": 3.0, "end_s": -7.5}, "--end -7.5: takes seconds from the beginning"),
        ({"end_s": math.nan}, "lasts 40 s"),
        ({"start_s": 5000.0}, "fewer than two samples there; the recording lasts 40 s"),
    ],
)
@pytest.mark.parametrize("verb", [identify, diagnose, replay])
def test_a_stretch_that_is_none_is_one_line(
    verb: Callable[..., object], options: dict[str, float], said: str, tmp_path: Path
) -> None:
    save(tmp_path / "log.npz", quiet(1, 10.0, 40.0, ("gx",)), 10.0)
    with pytest.raises(UserError) as caught:
        verb(tmp_path / "log.npz", **options)
    assert said in str(caught.value)


def test_a_stretch_has_the_answer_of_a_file_of_its_own(tmp_path: Path) -> None:
    """The rows of 100 to 700 s alone in a file: the same numbers, to the last digit. A jump has its time in the
    recording."""
    columns = quiet(2, 10.0, 900.0)
    shaken(columns, 10.0, 0.0, 90.0)
    save(tmp_path / "whole.npz", columns, 10.0)
    save(tmp_path / "part.npz", {name: (unit, y[1000:7000]) for name, (unit, y) in columns.items()}, 10.0)
    part = identify(tmp_path / "part.npz")
    found = identify(tmp_path / "whole.npz", start_s=100.0, end_s=700.0)
    for whole, alone in zip(found["axes"].values(), part["axes"].values(), strict=True):
        assert whole["checks"]["jump"].pop("time_s") == pytest.approx(100.0 + alone["checks"]["jump"].pop("time_s"))
    assert found["axes"] == part["axes"]
    assert found["recording"]["start_s"] == 100.0 and found["recording"]["duration_s"] == 600.0


def test_times_found_are_those_of_the_recording(tmp_path: Path) -> None:
    """A step at 620 s, looked at from 200 s on. The model file's step is at its place in the whole recording too."""
    columns = quiet(3, 1.0, 1500.0, ("gx",))
    columns["gx"][1][620:] += 1.0
    save(tmp_path / "log.npz", columns, 1.0)
    axis = diagnose(tmp_path / "log.npz", start_s=200.0, write_model=tmp_path / "extended.yaml")["axes"]["gx"]
    (finding,) = axis["findings"]
    assert finding["cause"] == "step"
    assert finding["when"] == [620.0, 620.0]
    time_s = finding["estimate"]["time_s"]
    assert time_s["q05"] <= 619.5 <= time_s["q95"] and time_s["sd"] < 1.0
    model = Model.load(tmp_path / "extended.yaml")
    assert model.regressors[0].time_s == pytest.approx(time_s["median"], abs=0.5)  # the file has its name's digits
    whole = load(tmp_path / "log.npz")
    for recording in (whole, whole.between(200.0, None), whole.between(450.0, 900.0)):
        step = columns_of(model.regressors, recording)[:, 0]
        np.testing.assert_array_equal(step, recording.start_s + recording.time_s >= 620.0)


@pytest.mark.parametrize("seed", range(2))
def test_the_gate_takes_the_samples_that_the_firmware_takes(seed: int) -> None:
    """Shaking at a random time, and a gap: sample by sample against the library behind the gate
    (tests/common/gated.py), whose bank then has the same sums."""
    random = np.random.default_rng(seed)
    rate_hz, model = 20.0, Model.load()
    columns = quiet(10 + seed, rate_hz, 200.0)
    first_s = float(random.uniform(60.0, 120.0))
    shaken(columns, rate_hz, first_s, first_s + 7.0)
    t = np.arange(4000) / rate_hz
    kept = (t < 160.0) | (t >= 163.0)
    recording = Recording(
        Path("log.npz"),
        rate_hz,
        {name: _column(name, unit, values[kept]) for name, (unit, values) in columns.items()},
        np.rint(np.diff(t[kept], prepend=-1.0 / rate_hz) * rate_hz).astype(np.int64) - 1,
        {},
    )
    firmware = Gated(model, rate_hz, tuple(UNITS))
    samples = np.column_stack([one.values for one in recording.columns.values()]).astype(np.float32)
    for missing, sample in zip(recording.missing_before, samples, strict=True):
        firmware.feed(int(missing), sample)
    part = gate.gated(recording, model)
    assert part.moving > 7.0 * rate_hz
    assert part.lost == 60
    found = identify_recording(part, model)
    want = firmware.bank.report(0)
    assert found.n == want.n
    assert found.log_evidence == pytest.approx(want.log_evidence, abs=1e-3)


def _column(name: str, unit: str, values: NDArray[np.float64]) -> Any:
    return Column(name, unit, values)


def identify_recording(recording: Recording, model: Model) -> Any:
    """gx by the library, in the model's unit."""
    return identify_axis(recording, "gx", model, "library", None).result


def test_the_gate_leaves_the_noise_of_rest(tmp_path: Path) -> None:
    """N with --gate is that of the clean record, within 4 of its own sd; without it the axis is not adequate."""
    columns = quiet(20, 50.0, 600.0)
    clean = {name: (unit, y.copy()) for name, (unit, y) in columns.items()}
    shaken(columns, 50.0, 250.0, 265.0)
    save(tmp_path / "moved.npz", columns, 50.0)
    save(tmp_path / "clean.npz", clean, 50.0)
    found = identify(tmp_path / "moved.npz", gate=True)["axes"]
    want = identify(tmp_path / "clean.npz")["axes"]
    for name, axis in found.items():
        N, true = (one["parameters"]["constant"]["N"] for one in (axis, want[name]))
        assert abs(N["median"] - true["median"]) < 4.0 * true["sd"], name
        assert axis["adequate"] and axis["samples_kept_out"]["moving"] > 15 * 50
        assert axis["samples_kept_out"]["missing"] == 0
    axes = diagnose(tmp_path / "moved.npz", gate=True, decimate=1.0, axes=["gx", "ax"])["axes"]
    assert [axis["verdict"] for axis in axes.values()] == ["adequate", "adequate"]


@pytest.mark.parametrize(
    ("seed", "rate_hz", "slow"), [(2, 24.0, 2), (1, 30.0, 3), (3, 50.0, 5), (4, 80.0, 8)][: case_records(1, 4)]
)
def test_what_is_missing_and_what_the_gate_left_out(seed: int, rate_hz: float, slow: int, tmp_path: Path) -> None:
    """Gyros at `rate_hz`, accelerometers every `slow` rows; gaps of 1.2 s; both ends and the middle in the hand. Truth:
    the rows of the file. Every cell of an axis is used or counted as motion, and every instant without a row is
    missing on the clock of the axis. To `diagnose` motion that the gate left out is no missing sample."""
    columns = quiet(40 + seed, rate_hz, 400.0)
    shaken(columns, rate_hz, 0.0, 12.0)
    shaken(columns, rate_hz, 201.0 + seed, 206.0 + seed)
    shaken(columns, rate_hz, 388.0, 400.0)
    t = np.arange(columns["gx"][1].size) / rate_hz
    for holes in ((50.0, 90.0 + seed, 300.0), ()):
        kept = np.ones(t.size, bool)
        for at in holes:
            kept &= (t < at) | (t >= at + 1.2)
        for name in ("ax", "ay", "az"):
            columns[name][1][np.arange(t.size) % slow != 0] = np.nan
        log = tmp_path / "log.csv"
        save(log, {name: (unit, y[kept]) for name, (unit, y) in columns.items()}, rate_hz, t=t[kept])
        whole = load(log)
        part = gate.gated(whole, Model.load())
        for name, every in (("gx", 1), ("ax", slow)):
            own = part.along(name)
            assert own.samples + own.moving == np.isfinite(columns[name][1][kept]).sum(), name
            assert own.moving > 29.0 * rate_hz / every
            for one in (own, whole.along(name)):
                assert one.lost == (~kept)[::every].sum(), name
            assert identify(log, axes=[name], gate=True, suspicion=False)["axes"][name]["samples_kept_out"] == {
                "missing": own.lost, "moving": own.moving, "not_finite": 0, "saturated": 0, "stuck": 0,
            }  # fmt: skip
        for decimate, axes in ((1.0, ["gx", "ax"]), (None, ["ax"])):
            record = record_from(part, Model.load(), decimate, axes)
            looks, _ = integrity.missing(record)
            if not holes:
                assert not looks and record.present.mean() > 0.99
                continue
            for name in axes:
                assert looks[name].estimate["missing"]["median"] == (~kept)[:: 1 if name == "gx" else slow].sum()
                first, last = (time + record.start_s for time in looks[name].when)
                assert abs(first - 50.0) < 9.0 and abs(last - 301.2) < 9.0  # a gap ends the gate's rest


def test_a_model_without_a_gate_is_one_line(tmp_path: Path) -> None:
    save(tmp_path / "log.npz", quiet(1, 1.0, 300.0, ("gx",)), 1.0)
    for verb in (identify, diagnose):
        with pytest.raises(UserError, match="no gate for samples at 1 Hz"):
            verb(tmp_path / "log.npz", gate=True)


# ------------------------------------------------------------------------------------------------- outside the priors


@pytest.mark.parametrize(("rate_hz", "first", "last"), [(10.0, 0.0, 31.0), (25.0, 40.0, 0.0), (100.0, 12.0, 9.0)])
def test_a_record_held_at_its_ends_has_an_answer_and_names_them(
    rate_hz: float, first: float, last: float, tmp_path: Path
) -> None:
    """The stretches are left out and named to 1 s; N holds the truth within 4 of its sd."""
    columns = quiet(round(rate_hz), rate_hz, 600.0)
    shaken(columns, rate_hz, 0.0, first)
    shaken(columns, rate_hz, 600.0 - last, 600.0)
    save(tmp_path / "log.npz", columns, rate_hz)
    ends = [end for end in ([0.0, first], [600.0 - last, 600.0]) if end[1] > end[0]]
    for name, axis in identify(tmp_path / "log.npz", axes=["gx", "gy", "gz"])["axes"].items():
        assert not axis["adequate"]
        assert np.abs(np.array(axis["checks"]["motion"]["intervals"]) - ends).max() < 1.0
        N = axis["parameters"]["constant"]["N"]
        assert abs(N["mean"] - DENSITIES[UNITS[name]]) < 4.0 * N["sd"], name


@pytest.mark.parametrize(("rate_hz", "first", "last"), [(10.0, 0.0, 231.0), (25.0, 240.0, 0.0), (50.0, 117.0, 120.0)])
def test_a_record_in_the_hand_for_long_has_an_answer(rate_hz: float, first: float, last: float, tmp_path: Path) -> None:
    """Held in the hand for two fifths of it. The stretches are left out and named to 1 s; N holds the truth within 4 of
    its sd. The longest rest to type is the true one, to a piece of 1 s."""
    columns = quiet(round(rate_hz), rate_hz, 600.0)
    shaken(columns, rate_hz, 0.0, first)
    shaken(columns, rate_hz, 600.0 - last, 600.0)
    save(tmp_path / "log.npz", columns, rate_hz)
    ends = [end for end in ([0.0, first], [600.0 - last, 600.0]) if end[1] > end[0]]
    for name, axis in identify(tmp_path / "log.npz", suspicion=False)["axes"].items():
        assert np.abs(np.array(axis["checks"]["motion"]["intervals"]) - ends).max() < 1.0
        N = axis["parameters"]["constant"]["N"]
        assert abs(N["mean"] - DENSITIES[UNITS[name]]) < 4.0 * N["sd"], name
    recording = load(tmp_path / "log.npz")
    longest = rest_of(recording, list(recording.columns)).longest
    assert longest is not None
    assert np.abs(np.subtract(longest, (first, 600.0 - last))).max() <= 2.0


@pytest.mark.parametrize("size", [1e-4, 30.0])
def test_a_record_at_rest_is_identified_outside_the_priors(size: float, tmp_path: Path) -> None:
    """As many times the noise of a record inside them: N within 4 of its sd (test_cases_priors.py has the parts)."""
    columns = {name: (unit, size * (y - y.mean())) for name, (unit, y) in quiet(7, 10.0, 300.0, ("gx", "gy")).items()}
    save(tmp_path / "log.npz", columns, 10.0)
    for name, axis in identify(tmp_path / "log.npz", suspicion=False)["axes"].items():
        N = axis["parameters"]["constant"]["N"]
        assert axis["priors"] == "from this record"
        assert abs(N["mean"] - size * DENSITIES[UNITS[name]]) < 4.0 * N["sd"], name


def test_rest_is_not_called_motion() -> None:
    """Clean twin: in at most 1 of 200 records, at four rates, is a piece called motion."""
    count = case_records(20, 200)
    fired = 0
    for seed in range(count):
        rate_hz = (1.0, 5.0, 20.0, 100.0)[seed % 4]
        columns = quiet(1000 + seed, rate_hz, 400.0 if rate_hz > 1.0 else 2000.0)
        n = columns["gx"][1].size
        recording = Recording(
            Path("log.npz"),
            rate_hz,
            {name: _column(name, unit, values) for name, (unit, values) in columns.items()},
            np.zeros(n, np.int64),
            {},
        )
        fired += bool(rest_of(recording, tuple(UNITS)).moved)
    assert fired <= max(1, count // 200)


# ---------------------------------------------------------------------------------------------------------- exit codes


def test_fail_on_names_what_could_not_be_judged(tmp_path: Path) -> None:
    """Truth: gx has a step, gy nothing, gz never moves off one value. There is no temperature, and a supply that is
    always the same."""
    columns = quiet(5, 1.0, 600.0, ("gx", "gy", "gz"))
    columns["gx"][1][250:] += 1.0
    columns["gz"][1][:] = 0.25
    columns["supply"] = ("V", np.full(600, 5.0))
    save(tmp_path / "log.npz", columns, 1.0)
    document = diagnose(tmp_path / "log.npz")
    for wanted, code, lines in (
        ("step", 1, ["gz: step cannot be judged: every reading is the same"]),
        ("inadequate", 1, ["gz: inadequate cannot be judged: every reading is the same"]),
        ("periodic", 2, ["gz: periodic cannot be judged: every reading is the same"]),
    ):
        assert (outcome(document, wanted).code, outcome(document, wanted).lines) == (code, lines)
    files = ["--json", "found.json", "--report", "page.html"]
    gy = {**document, "axes": {"gy": document["axes"]["gy"]}}
    assert (outcome(gy, "inadequate").code, outcome(gy, "step").code, outcome(gy, "supply").code) == (0, 0, 2)
    for wanted in ("temperature", "supply"):
        done = run("diagnose", "log.npz", "--axis", "gy", "--fail-on", wanted, *files, cwd=tmp_path)
        assert done.returncode == 2
        assert f"gy: {wanted} cannot be judged: the recording has no {wanted} that changes" in done.stderr
        axis = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]["gy"]
        assert axis["verdict"] == "adequate"
        (tmp_path / "found.json").unlink()
        files = files[:2]
    assert (tmp_path / "page.html").exists()
    (tmp_path / "page.html").unlink()
    with pytest.raises(UserError, match="no axis can be judged"):
        both = {"json": tmp_path / "found.json", "report": tmp_path / "page.html"}
        diagnose(tmp_path / "log.npz", axes=["gz"], fail_on="step", **both)
    assert "Not diagnosed: gz" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]["gz"]["error"]


def test_identify_and_compare_take_fail_on(tmp_path: Path) -> None:
    clean, stepped = quiet(6, 1.0, 600.0, ("gx", "gy")), quiet(8, 1.0, 600.0, ("gx", "gy"))
    stepped["gx"][1][300:] += 1.0
    save(tmp_path / "a.npz", clean, 1.0)
    save(tmp_path / "b.npz", stepped, 1.0)
    for log, wanted, code in (
        ("a.npz", "inadequate", 0),
        ("b.npz", "step", 1),
        ("a.npz", "step", 2),
    ):
        done = run("identify", log, "--fail-on", wanted, "--json", "found.json", cwd=tmp_path)
        assert done.returncode == code, (log, wanted, done.stderr)
        assert json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["schema"] == "selfcal.identify/1"
    document = compare([tmp_path / "a.npz", tmp_path / "b.npz"])
    codes = {wanted: outcome(document, wanted).code for wanted in ("changed", "inadequate", "step", "ramp", "supply")}
    assert codes == {"changed": 1, "inadequate": 1, "step": 1, "ramp": 0, "supply": 2}
    assert outcome(document, "supply").lines[0].startswith(f"{tmp_path / 'a.npz'}: gx: supply cannot be judged")
    same = {**document, "axes": {name: [] for name in document["axes"]}}
    assert outcome(same, "changed").code == 0


def test_compare_names_the_axes_without_a_partner(tmp_path: Path) -> None:
    """Truth: a has gx, gy and an ax that never moves; b has gy, gz, ax; c has gz in rad/s. gy is the same in a and b:
    its only change by chance has a probability below 1 in 100."""
    a, b = quiet(21, 2.0, 400.0, ("gx", "gy", "ax")), quiet(22, 2.0, 400.0, ("gy", "gz", "ax"))
    a["ax"][1][:] = 1.5
    save(tmp_path / "a.npz", a, 2.0)
    save(tmp_path / "b.npz", b, 2.0)
    save(tmp_path / "c.npz", {"gz": ("rad/s", np.radians(quiet(23, 2.0, 400.0, ("gz",))["gz"][1]))}, 2.0)
    reasons = {
        "ax": "a.npz: every reading is the same",
        "gx": "b.npz does not have it",
        "gz": "a.npz does not have it",
    }
    for wanted, code in ((None, 0), ("changed", 2)):
        options = [] if wanted is None else ["--fail-on", wanted]
        done = run("compare", "a.npz", "b.npz", "--json", "found.json", *options, cwd=tmp_path)
        assert done.returncode == code, (wanted, done.stderr)
        axes = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]
        assert axes == {"gy": [], **{name: {"error": why, "changes": []} for name, why in reasons.items()}}
        assert "gy: nothing changed" in done.stdout
        for name, why in reasons.items():
            assert f"{name}: not compared: {why}" in done.stdout
            assert wanted is None or f"{name}: {wanted} cannot be judged: {why}" in done.stderr
    (tmp_path / "found.json").unlink()
    done = run("compare", "--json", "found.json", "b.npz", "c.npz", cwd=tmp_path)
    assert done.returncode == 2 and not (tmp_path / "found.json").exists()
    assert "no axis can be compared (" in done.stderr
    assert "gy: c.npz does not have it" in done.stderr
    assert "gz: the recordings have it in deg/s and rad/s" in done.stderr
    with pytest.raises(UserError, match=r"gz: \S*a.npz does not have it"):
        logs = [tmp_path / "a.npz", tmp_path / "c.npz"]
        compare(logs, axes=[], json=tmp_path / "found.json", fail_on="changed")
    assert json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]["gz"]["changes"] == []


def test_a_change_counts_beside_an_axis_without_a_partner(tmp_path: Path) -> None:
    """Truth: the bias of gx moves by 2 deg/s from a to b; c has gy alone. Exit code 1 for the change, 2 for others."""
    for name, seed in (("a", 31), ("b", 32), ("c", 33)):
        columns = quiet(seed, 1.0, 500.0, ("gx", "gy") if name != "c" else ("gy",))
        if name == "b":
            columns["gx"][1][:] += 2.0
        save(tmp_path / f"{name}.npz", columns, 1.0)
    document = compare([tmp_path / f"{name}.npz" for name in "abc"])
    gx = document["axes"]["gx"]
    assert gx["error"] == f"{tmp_path / 'c.npz'} does not have it"
    (row,) = gx["changes"]
    assert row["quantity"] == "bias" and row["after"] - row["before"] == pytest.approx(2.0, abs=0.05)
    assert document["axes"]["gy"] == []
    assert [outcome(document, wanted).code for wanted in ("changed", "inadequate")] == [1, 2]


# -------------------------------------------------------------------------------------------------- stages, work, ends


def test_means_come_first_and_every_sample_is_final(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Truth: a step, which means show and every sample keeps; and a line at 3.1 Hz, whose alias at 0.1 Hz has 3 % of
    its size in means of 1 s. A recording of so few samples has two looks here only."""
    monkeypatch.setattr(diagnose_module, "FIRST_FROM", 3000)
    columns = quiet(9, 10.0, 300.0, ("gx",))
    t = np.arange(columns["gx"][1].size) / 10.0
    columns["gx"][1][1400:] += 0.4
    columns["gx"][1][:] += 0.08 * np.sin(2.0 * np.pi * 3.1 * t)
    save(tmp_path / "log.npz", columns, 10.0)
    axis = diagnose(tmp_path / "log.npz")["axes"]["gx"]
    first = capsys.readouterr().err.splitlines()
    assert first[0].startswith("selfcal: means of 1 s, before every sample is looked at")
    assert [line.partition(": The")[0] for line in first[1:]] == ["selfcal: gx: step"]
    assert axis["judged_at_hz"] == 10.0 and axis["only_in_means"] == [] and "unfinished" not in axis
    rates = {finding["cause"]: finding["judged_at_hz"] for finding in axis["findings"]}
    assert rates == {"step": 1.0, "periodic": 10.0}
    for options, rate_hz in ({"decimate": 1.0}, 1.0), ({"full_rate": True}, 10.0):
        one = diagnose(tmp_path / "log.npz", **options)["axes"]["gx"]
        assert one["judged_at_hz"] == rate_hz and "only_in_means" not in one
    assert capsys.readouterr().err == ""
    with pytest.raises(UserError, match="take one of them"):
        diagnose(tmp_path / "log.npz", decimate=1.0, full_rate=True)


def test_a_fast_log_too_short_for_means_is_looked_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """90 s have 90 means of 1 s, and a look takes 200. Truth: a line of 2.7 Hz. A recording of so few samples would
    have two looks here only."""
    monkeypatch.setattr(diagnose_module, "FIRST_FROM", 1000)
    columns = quiet(10, 25.0, 90.0, ("gx",))
    columns["gx"][1][:] += 0.09 * np.sin(2.0 * np.pi * 2.7 * np.arange(columns["gx"][1].size) / 25.0)
    save(tmp_path / "log.npz", columns, 25.0)
    axis = diagnose(tmp_path / "log.npz")["axes"]["gx"]
    assert axis["judged_at_hz"] == 25.0 and "only_in_means" not in axis
    assert [one["cause"] for one in axis["findings"]] == ["periodic"]
    assert capsys.readouterr().err == ""


def test_work_is_bounded_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A bound that two jumps do not fit into: the axis ends with what it has, and that is told. The passes that are
    counted are within the bound, but for the ensemble and the gains that come after the rounds."""
    columns = quiet(12, 1.0, 2000.0, ("gx",))
    columns["gx"][1][600:] += 1.0
    columns["gx"][1][1300:] += 2.0
    save(tmp_path / "log.npz", columns, 1.0)
    whole = diagnose(tmp_path / "log.npz")["axes"]["gx"]
    assert len(whole["findings"]) == 2 and "unfinished" not in whole
    spent: list[float] = []

    class Counted(work.Work):
        def count(self, samples: int, columns: int) -> None:
            super().count(samples, columns)
            spent.append(samples * (1.0 + columns))

    bound = 450 * 2.0 * 2000
    monkeypatch.setattr(work, "of_axis", lambda samples: Counted(lambda: False, bound))
    document = diagnose(tmp_path / "log.npz")
    axis = document["axes"]["gx"]
    assert axis["unfinished"] == loop.SPENT
    capsys.readouterr()
    show(document, details=True)
    so_far = "inadequate" if axis["findings"] else "nothing found so far"
    assert f"gx [deg/s]: {so_far}, not finished: {loop.SPENT}" in capsys.readouterr().out
    assert len(axis["findings"]) < 2 or axis["findings"] != whole["findings"]
    assert sum(spent) <= bound
    assert outcome({"axes": {"gx": axis}}, "ramp").code == 2


def test_axes_that_stop_raise_in_the_next_pass() -> None:
    """The loop of a record whose work is stopped from the start does not run one round."""
    record = record_from(with_gaps(5), Model.load())
    began = time.monotonic()
    found: dict[str, loop.Diagnosed] = {}
    with work.within(work.Work(lambda: True)), pytest.raises(loop.Stopped):
        loop.diagnose_record(record, ["gx"], found=found)
    assert not found and time.monotonic() - began < 1.0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_it_with_the_first_look(number: int, code: int, tmp_path: Path) -> None:
    """In the second look, which takes minutes at this length: JSON and page have the findings of the first.

    Within 2 s of a processor of its own; a machine that is shared gives as many times as long as it has runners."""
    columns = quiet(14, 100.0, 1500.0, ("gx", "gy"))
    columns["gx"][1][70_000:] += 0.5
    save(tmp_path / "log.npz", columns, 100.0)
    command = [*COMMAND, "diagnose", "log.npz", "--json", "found.json", "--report", "page.html"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "gx: step" in line:
                break
        time.sleep(1.0)
        before, began = _cpu_s(process.pid), time.monotonic()
        process.send_signal(number)
        while process.poll() is None and time.monotonic() - began < 60.0:
            after = _cpu_s(process.pid) or before
            time.sleep(0.02)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert after - before < 2.0 or time.monotonic() - began < 2.0
    assert "gx, °/s   inadequate, not finished: every sample:" in output
    assert "gy, °/s   nothing found so far, not finished: every sample:" in output
    axes = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]
    assert [finding["cause"] for finding in axes["gx"]["findings"]] == ["step"]
    assert axes["gx"]["judged_at_hz"] == 1.0 and "interrupted" in axes["gx"]["unfinished"]
    assert axes["gy"]["verdict"] == "adequate"
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Not finished: gy." in page and "✓" not in page


def test_a_first_look_that_is_broken_off_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stopped before its fit or at an axis' first round, each without a finding: no axis is called clean."""
    save(tmp_path / "log.npz", quiet(16, 10.0, 2100.0, ("gx", "gy")), 10.0)

    def stopped_in_the_fit(*_: Any, **__: Any) -> None:
        ending.HeldSignals.came, ending.HeldSignals.came_at = signal.SIGINT, time.monotonic()
        raise ending.Stopped

    for module, name in ((loop.work, "each"), (loop, "_rounds")):
        with monkeypatch.context() as patched:
            patched.setattr(module, name, stopped_in_the_fit)
            with pytest.raises(ending.Ended):
                diagnose(tmp_path / "log.npz")
        first = capsys.readouterr().err.splitlines()
        assert first[0].endswith("before every sample is looked at: ")
        assert first[1:] == [f"selfcal: {axis}: not finished: {loop.INTERRUPTED}" for axis in ("gx", "gy")]


def _cpu_s(pid: int) -> float:
    """Processor time of a process so far, s; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return (int(fields[11]) + int(fields[12])) / 100.0


# ---------------------------------------------------------------------------------------------------------- suspicion


def test_the_suspicion_is_bounded_and_can_be_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 20 Hz the second look is at as many means as at 1 Hz, and asks for no bank at the rate of --decimate."""
    columns = quiet(15, 20.0, 600.0, ("gx",))
    t = np.arange(columns["gx"][1].size) / 20.0
    columns["gx"][1][:] += 0.1 * np.sin(2.0 * np.pi * 0.07 * t)
    save(tmp_path / "log.npz", columns, 20.0)
    longest: list[int] = []
    run_filter = fit.run
    monkeypatch.setattr(
        fit, "run", lambda series, *more, **kw: (longest.append(series.y.size), run_filter(series, *more, **kw))[1]
    )
    second_look = suspicion.suspicions
    monkeypatch.setattr(suspicion, "suspicions", lambda *of: (longest.clear(), second_look(*of))[1])
    for decimate in (None, 5.0):
        axis = identify(tmp_path / "log.npz", decimate=decimate)["axes"]["gx"]
        assert axis["suspicion"] == "periodic" and not axis["adequate"]
        assert max(longest) <= 600
    assert "suspicion" not in identify(tmp_path / "log.npz", suspicion=False)["axes"]["gx"]


# -------------------------------------------------------------------------------------------------------------- cases


def test_hands_at_the_ends_of_a_log(tmp_path: Path) -> None:
    """P37: the first 15 s and the last 10 s in the hand. Either way out has N 0.04 within 4 sd."""
    log = shared_case("P37_hands.py", tmp_path)
    axes = identify(log, start_s=16.0, end_s=3588.0, suspicion=False)["axes"]
    for name in (name for name in axes if name[0] == "g"):
        N = axes[name]["parameters"]["constant"]["N"]
        assert abs(N["mean"] - 0.04) < 4.0 * N["sd"]
