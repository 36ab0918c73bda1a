"""The firmware on emulated cores: `selfcal replay --target cortex-m4f|cortex-m0`, by QEMU's UART and semihosting.

Three truths. The host firmware over the same samples and nodes: the C code is the same and rounds alike, so telemetry
must be the same to the last bit once both link the same <math.h> (tests/port/same_math.c); with newlib's it may differ
by what newlib's exp, log and their kin differ from the host's. The textbook bank in double over the continuous prior,
which shares no code. And the wire's own arithmetic: that every frame arrives, and the same ones in every run.

`SELFCAL_EMULATE=1` (make emulate) adds 20 minutes of six axes.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from selfcal.adequacy.identify import identify_axis
from selfcal.base.errors import UserError
from selfcal.logs import recording as recording_module
from selfcal.logs.recording import Recording, load
from selfcal.model.file import Model
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate
from selfcal.wire.frames import ROOT, AxisReport, axis_unit, load_dbc, wire_names
from selfcal.wire.replay import TARGETS, build, emulator, run_firmware, write_rows

from conftest import shared_recording

SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"
#: Frames of a status: the items that the DBC has.
STATUS = len({s.multiplexer_ids[0] for s in load_dbc().get_message_by_name("STATUS").signals if s.multiplexer_ids})
#: Frames of a report of the default model; the Cortex-M0 does not judge it.
REPORT = {"cortex-m4f": 52, "cortex-m0": 46}
EMULATED = ("cortex-m4f", "cortex-m0")
SIX = ("gx", "gy", "gz", "ax", "ay", "az")
#: Of statistics over the posterior sd, and of probabilities: newlib's expf and logf are off by up to 1 ulp (6e-8) where
#: the host's are off by half of one; sums over some 10^4 cells of them keep it below 2e-4 of an sd (seen: 5e-5), a
#: probability below 1e-4, a difference of evidences to one step of the wire, 0.001 nat, and what rounds to it.
LIBM_SD, LIBM_P, LIBM_NAT = 2e-4, 1e-4, 2e-3

#: The goal for each core, its node counts included.
REFERENCE_P = {"cortex-m4f": 2e-3, "cortex-m0": 1e-2}
#: ... of parameters' means in posterior sd and of the sd itself, under laws of this probability or more: those of a
#: report on the default grid, of fixed point the means alone (14 x 7 nodes add some per cent to an sd).
REFERENCE_MEAN = {"cortex-m4f": 0.05, "cortex-m0": 0.05}
REFERENCE_SD = {"cortex-m4f": 0.03, "cortex-m0": math.inf}
LEAST_P = 1e-3


def part(folder: Path, seconds: float, axes: Sequence[str] = SIX, hole: slice | None = None) -> Recording:
    """The shipped recording's first seconds, `hole` (samples) left out."""
    whole = load(SHIPPED)
    keep = np.arange(int(seconds * whole.rate_hz))
    if hole is not None:
        keep = np.delete(keep, hole)
    columns = {name: (whole.columns[name].unit, whole.in_unit(name, whole.columns[name].unit)[keep]) for name in axes}
    path = folder / "part.npz"
    recording_module.save(path, columns, whole.rate_hz, {}, t=keep / whole.rate_hz)
    return load(path)


def program(
    model: Model, rate_hz: float, axes: Sequence[str], target: str, core: str, folder: Path, flags: str = ""
) -> Path:
    """The firmware of `target` with the nodes and the configuration of `core`, made with further compiler flags."""
    made = build(model, rate_hz, axes, target, nodes=core)
    make = TARGETS[target].make
    settings = [
        f"MODEL_DIR={made.parent}",
        f"OUT={folder / target}",
        f"CORE={target}",
        f"{make.upper()}_CFLAGS={flags}",
    ]
    subprocess.run(["make", "-s", "-f", f"port/{make}/{make}.mk", make, *settings], cwd=ROOT, check=True)
    return folder / target / TARGETS[target].image


def values(history: Mapping[str, Sequence[AxisReport]]) -> list[tuple[str, float, dict[str, str]]]:
    """All that came, with floats as text: NaN equals NaN, and -0 does not equal 0."""
    return [
        (axis, report.time_s, {name: repr(value) for name, value in report.values.items()})
        for axis, reports in history.items()
        for report in reports
    ]


@pytest.mark.parametrize("core", EMULATED)
def test_the_core_computes_what_the_host_computes(core: str, tmp_path: Path) -> None:
    """Bit for bit, with a gap, behind the gate on one of them, given the same nodes and the same <math.h>."""
    model, axes = Model.load(), ("gx", "gy", "ax") if core == "cortex-m4f" else ("gy", "ax")
    every = 200.0 if core == "cortex-m4f" else 600.0
    recording = part(tmp_path, 600.0, axes, slice(3000, 3070))
    small = " -DSAME_FMAF -DSELFCAL_MODEL_JUDGED=0"  # as its core has it
    flags = f"{ROOT}/tests/port/same_math.c -Wno-double-promotion" + (small if core == "cortex-m0" else "")
    history = {}
    for target in ("host", core):
        firmware = program(model, recording.rate_hz, axes, target, core, tmp_path, flags)
        history[target], _ = run_firmware(firmware, recording, model, axes, every, target, gate=core == "cortex-m4f")
    assert [len(history[core][axis]) for axis in axes] == [600.0 / every] * len(axes)
    assert values(history[core]) == values(history["host"])


def assert_close(history: Mapping[str, Sequence[AxisReport]], truth: Mapping[str, Sequence[AxisReport]]) -> None:
    """Reports equal but for what the C libraries round; prints the worst."""
    worst = dict.fromkeys(("sd", "probability", "nat"), 0.0)
    for axis, reports in truth.items():
        for got, want in zip(history[axis], reports, strict=True):
            assert got.time_s == want.time_s
            for name, value in want.values.items():
                other, (stem, _, last) = got.values[name], name.rpartition("_")
                if math.isnan(value) or last in ("flags", "items", "ms") or name in ("count", "not_finite", "gaps"):
                    assert repr(other) == repr(value), name
                elif last == "probability":
                    worst["probability"] = max(worst["probability"], abs(other - value))
                elif name.endswith("ln_evidence_diff"):
                    worst["nat"] = max(worst["nat"], abs(other - value))
                elif last in ("mean", "median", "sd", "q05", "q95"):
                    worst["sd"] = max(worst["sd"], abs(other - value) / want.values[f"{stem}_sd"])
    print(", ".join(f"{name} {value:.1e}" for name, value in worst.items()))
    assert worst["sd"] <= LIBM_SD
    assert worst["probability"] <= LIBM_P
    assert worst["nat"] <= LIBM_NAT


@pytest.mark.parametrize("core", EMULATED)
def test_the_c_library_changes_nothing_that_matters(core: str, tmp_path: Path) -> None:
    model, axes = Model.load(), ("gy", "ax") if core == "cortex-m4f" else ("az",)
    recording = part(tmp_path, 600.0, axes)
    flags = "-DSELFCAL_MODEL_JUDGED=0" if core == "cortex-m0" else ""
    made = {target: program(model, recording.rate_hz, axes, target, core, tmp_path, flags) for target in ("host", core)}
    history = {target: run_firmware(one, recording, model, axes, 600.0, target)[0] for target, one in made.items()}
    assert_close(history[core], history["host"])


def test_every_run_sends_the_same_bytes(tmp_path: Path) -> None:
    """As a serial capture: the emulator's UART on its standard input and output."""
    model, axes = Model.load(), ("gz",)
    recording = part(tmp_path, 60.0, axes)
    firmware = build(model, recording.rate_hz, axes, "cortex-m4f")
    write_rows(recording, model, axes, tmp_path / "rows.bin")
    sent = []
    for name in ("first", "second"):
        module = subprocess.Popen(
            emulator(firmware, "rows.bin", 20.0, "cortex-m4f", "stdio,id=uart,signal=off"),
            cwd=tmp_path,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert module.stdin is not None and module.stdout is not None and module.stderr is not None
        assert module.stderr.readline() == b"SELFCAL_UART\n"
        module.stdin.write(b"C\rS6\r\rO\rO\r")
        module.stdin.flush()
        # an answer to each command, three reports with their status, the last status
        frames = module.stdout.read(5 + 22 * (3 * (STATUS + REPORT["cortex-m4f"]) + STATUS))
        output, errors = module.communicate(b"C\r", timeout=30)
        assert (module.returncode, output, errors) == (0, b"\r", b""), name
        sent.append(frames)
    assert sent[0] == sent[1]
    assert sent[0].startswith(b"\r\r\r\r\rt2008")
    assert all(len(line) == 21 for line in sent[0][5:-1].split(b"\r"))


@pytest.mark.parametrize("core", EMULATED)
def test_the_json_is_that_of_the_host(core: str, tmp_path: Path) -> None:
    """By the command line, report for report as the contract has it."""
    recording = part(tmp_path, 300.0, ("gz",))
    line = [sys.executable, "-m", "selfcal.cli", "replay", str(recording.path), "--target", core]
    done = subprocess.run([*line, "--json", str(tmp_path / "a.json")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    reports = TARGETS[core].reports
    assert f"frames: {reports * (STATUS + REPORT[core]) + STATUS} received, 0 lost" in done.stderr
    document = replay(recording.path, target=core, report_every=300.0)
    host = replay(recording.path, report_every=300.0)

    def shape(tree: object) -> object:
        return {name: shape(branch) for name, branch in tree.items()} if isinstance(tree, dict) else type(tree)

    for axis in (*document["axes"].values(), *host["axes"].values()):
        assert (axis.pop("module_says") is None) == (axis in document["axes"].values() and core == "cortex-m0")
    assert shape(document) == shape(host)
    for axis, found in document["axes"].items():
        for law, probability in found["hypotheses"].items():
            # of the node counts; so few bank samples want few nodes
            assert abs(probability - host["axes"][axis]["hypotheses"][law]) <= (2e-3 if core == "cortex-m4f" else 1e-2)


@pytest.mark.parametrize("core", EMULATED)
def test_six_axes_at_the_full_rate_fit(core: str) -> None:
    """The default model as `make firmware` has it."""
    assert build(Model.load(), 819.2, SIX, core).exists()


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda data: b"", "not a recording for this program"),
        (lambda data: data[:8] + b"\x02" + data[9:], "axes are not those of the model"),
        (lambda data: data[:16] + np.float64(11.0).tobytes() + data[24:], "rate is not that of the model"),
        (lambda data: data[:-1], "the recording is shorter than it says"),
    ],
)
def test_the_firmware_says_what_is_wrong_with_its_rows(  # type: ignore[no-untyped-def]
    damage, complaint, tmp_path, monkeypatch
) -> None:
    model, axes = Model.load(), ("gz",)
    recording = part(tmp_path, 10.0, axes)
    written = write_rows

    def damaged(recording: Recording, model: Model, axes: Sequence[str], path: Path) -> None:
        written(recording, model, axes, path)
        path.write_bytes(damage(path.read_bytes()))

    monkeypatch.setattr("selfcal.wire.replay.write_rows", damaged)
    with pytest.raises(UserError, match=complaint):
        run_firmware(build(model, recording.rate_hz, axes, "cortex-m4f"), recording, model, axes, 10.0, "cortex-m4f")


def test_an_emulator_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, recording = Model.load(), part(tmp_path, 10.0, ("gz",))
    firmware = build(model, recording.rate_hz, ("gz",), "cortex-m4f")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"cannot run the firmware: qemu-system-arm: No such file"):
        run_firmware(firmware, recording, model, ("gz",), None, "cortex-m4f")


@pytest.mark.skipif("SELFCAL_EMULATE" not in os.environ, reason="minutes: make emulate")
@pytest.mark.parametrize("core", EMULATED)
@pytest.mark.parametrize("name", ["simulated", "adis16405_run1.npz"])
def test_twenty_minutes_of_six_axes(core: str, name: str, tmp_path: Path) -> None:
    """Against the textbook bank over the continuous prior; and the host firmware, whose C library alone may differ."""
    if name == "simulated":
        text = SHIPPED.with_suffix(".yaml").read_text(encoding="utf-8")
        assert "  rate_hz: 10.0\n  duration_s: 3600.0\n" in text
        text = text.replace("  rate_hz: 10.0\n  duration_s: 3600.0\n", "  rate_hz: 819.2\n  duration_s: 1200.0\n")
        (tmp_path / "model.yaml").write_text(text, encoding="utf-8")
        simulate(tmp_path / "model.yaml", tmp_path / "whole.npz", seed=4)
        recording = load(tmp_path / "whole.npz")
    else:
        whole = shared_recording(name)
        count = int(1200.0 * whole.rate_hz)
        units = {axis: axis_unit(axis) for axis in SIX}  # what telemetry has, and so the comparison
        columns = {axis: (unit, whole.in_unit(axis, unit)[:count]) for axis, unit in units.items()}
        recording_module.save(tmp_path / "part.npz", columns, whole.rate_hz, {})
        recording = load(tmp_path / "part.npz")
    model = Model.load()
    history = {
        target: run_firmware(
            program(model, recording.rate_hz, SIX, target, core, tmp_path), recording, model, SIX, 1200.0, target
        )[0]
        for target in ("host", core)
    }
    assert_close(history[core], history["host"])
    worst_p = worst_mean = worst_sd = 0.0
    for axis in SIX:
        truth = identify_axis(recording, axis, model, "reference", None).result
        found = history[core][axis][-1].result(wire_names(model))
        worst_p = max(worst_p, *(abs(found.probability[law] - p) for law, p in truth.probability.items()))
        print(axis, " ".join(f"{law} {found.probability[law]:.4f} ({p:.4f})" for law, p in truth.probability.items()))
        for law, parameters in truth.parameters.items():
            for parameter, want in parameters.items():
                got = found.parameters[law][parameter]
                if truth.probability[law] >= LEAST_P:
                    worst_mean = max(worst_mean, abs(got.mean - want.mean) / want.sd)
                    worst_sd = max(worst_sd, abs(got.sd / want.sd - 1.0))
    print(f"{core}, {name}: |dP(h)| <= {worst_p:.4f}, means within {worst_mean:.3f} sd, sd within {worst_sd:.1%}")
    assert worst_p <= REFERENCE_P[core]
    assert worst_mean <= REFERENCE_MEAN[core]
    assert worst_sd <= REFERENCE_SD[core]
