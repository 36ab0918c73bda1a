"""`selfcal replay`: recording, firmware, wire and decoder together, and the host firmware's own manners.

Truth: the same C library over the same float32 samples in one six-axis bank, called directly through the binding. What
may differ is what the wire rounds: the contract allows 1e-4 in a probability and 0.01 nat in an evidence difference;
the other numbers travel as float32 and the same code made them, so 1e-3 posterior sd is wide.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gated import Gated, learning_gate

from selfcal.bank.library import Bank
from selfcal.base.units import factor
from selfcal.logs import recording as recording_module
from selfcal.logs.recording import Recording, load
from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.show import run_plot as plot_module
from selfcal.verbs.identify import identify
from selfcal.verbs.replay import replay
from selfcal.wire.replay import build, run_firmware, write_rows

from conftest import run as started
from conftest import shared_recording

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"
P_TOLERANCE = 1e-4
NAT_TOLERANCE = 0.01
SD_TOLERANCE = 1e-3


def part_of_shipped(path: Path, seconds: float = 600.0, unit: str = "deg/s") -> Path:
    """The shipped recording's first minutes, with 7 s of it missing."""
    whole = load(SHIPPED)
    keep = np.arange(int(seconds * whole.rate_hz))
    keep = keep[(keep < 3000) | (keep >= 3070)]
    columns = {
        name: (
            unit if name[0] == "g" else column.unit,
            whole.in_unit(name, unit if name[0] == "g" else column.unit)[keep],
        )
        for name, column in whole.columns.items()
        if name[0] in "ga"
    }
    recording_module.save(path, columns, whole.rate_hz, {"simulated": True}, t=keep / whole.rate_hz)
    return path


def direct(recording: Recording, axes: tuple[str, ...]) -> dict[str, Any]:
    """The library without firmware and wire."""
    model = Model.load()
    bank = Bank(make_tables(model, recording.rate_hz, axes))
    samples = [recording.in_unit(name, model.group_of(name).unit) for name in axes]
    bank.push(np.column_stack(samples).astype(np.float32), recording.missing_before)
    return {name: bank.report(index) for index, name in enumerate(axes)}


def assert_same(
    document: dict[str, Any], truth: dict[str, Any], factor: Callable[[str], float] = lambda name: 1.0
) -> None:
    assert list(document["axes"]) == list(truth)
    for name, want in truth.items():
        axis = document["axes"][name]
        best = max(axis["log_evidence"].values()), max(want.log_evidence.values())
        for law, probability in want.probability.items():
            assert abs(axis["hypotheses"][law] - probability) <= P_TOLERANCE
            assert abs(axis["log_evidence"][law] - best[0] - (want.log_evidence[law] - best[1])) <= NAT_TOLERANCE
            for parameter, estimate in want.parameters[law].items():
                got = axis["parameters"][law][parameter]
                scale = 1.0 if parameter == "alpha" else factor(name)
                for statistic in ("mean", "median", "sd", "q05", "q95"):
                    difference = got[statistic] / scale - getattr(estimate, statistic)
                    assert abs(difference) <= SD_TOLERANCE * estimate.sd, (name, law, parameter, statistic)
                assert got["identified"] == estimate.identified
        assert abs(axis["bias_now"]["mean"] / factor(name) - want.bias_mean) <= SD_TOLERANCE * want.bias_sd
        assert abs(axis["bias_now"]["sd"] / factor(name) / want.bias_sd - 1.0) <= SD_TOLERANCE


def test_replay_with_the_gate_keeps_motion_out(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """10 s of shaking and 7 s missing: the firmware's result is that of gate and bank by the rule at
    selfcal_push_moving()."""
    part_of_shipped(tmp_path / "part.npz")
    part = load(tmp_path / "part.npz")
    axes = Model.load().axes
    columns = {name: (part.columns[name].unit, part.in_unit(name, part.columns[name].unit).copy()) for name in axes}
    columns["gx"][1][1500:1600] += 20.0 * np.sin(np.arange(100.0))
    t = (np.arange(part.samples) + np.cumsum(part.missing_before)) / part.rate_hz
    recording_module.save(tmp_path / "moved.npz", columns, part.rate_hz, {}, t=t)
    moved = load(tmp_path / "moved.npz")
    document = replay(tmp_path / "moved.npz", report_every=600.0, gate=True)
    assert "gate: rest ended 1 times" in capfd.readouterr().err
    host = Gated(Model.load(), moved.rate_hz, axes)
    samples = np.column_stack([moved.in_unit(name, Model.load().group_of(name).unit) for name in axes])
    for missing, sample in zip(moved.missing_before, samples.astype(np.float32), strict=True):
        host.feed(int(missing), sample)
    assert not any(host.used[1505:1600])
    assert sum(host.used) > 5930 - 100 - 190  # the shaking, 38 windows of 5: 17 at start and after it, 3 at the gap
    assert_same(document, {name: host.bank.report(index) for index, name in enumerate(axes)})
    assert document["axes"]["gx"]["adequate"] is None
    sigma = document["axes"]["gx"]["parameters"]["constant"]["N"]["mean"]
    with_motion = replay(tmp_path / "moved.npz", report_every=600.0, axes=("gx",))
    assert sigma < 0.5 * with_motion["axes"]["gx"]["parameters"]["constant"]["N"]["mean"]


def test_the_shocks_of_run_4_do_not_reach_the_bank() -> None:
    """The real recording with two shocks: what the firmware finds behind the gate is what the library finds in the
    whole intervals of rest; both shocks are outside of those, next to all the rest within; and the white noise is that
    of the same sensor's other two runs, which lie within 8 % of each other."""
    recording = shared_recording("adis16405_run4.npz")
    model, axes = Model.load(), Model.load().axes
    tables = make_tables(model, recording.rate_hz, axes)
    samples = np.column_stack([recording.in_unit(name, model.group_of(name).unit) for name in axes]).astype(np.float32)
    gate = learning_gate(model, tables)
    rest = np.concatenate([gate.push(samples[at : at + gate.window]) for at in range(0, len(samples), gate.window)])
    used = rest & np.concatenate([[False], rest[:-1]])
    start = int(np.argmax(used))
    blocks = (len(used) - start) // tables.block
    whole = used[start : start + blocks * tables.block].reshape(blocks, tables.block).all(axis=1)
    bank = Bank(tables)
    for index, good in enumerate(whole):
        at = start + index * tables.block
        if good:
            bank.push(samples[at : at + tables.block])
        else:
            bank.raw.skip(tables.block)
    for first, last in ((404_537, 404_621), (514_615, 514_660)):
        assert not whole[(first - start) // tables.block : (last - start) // tables.block + 1].any()
    assert whole.mean() > 0.96  # accelerometers feel the building some 40 times (test_gate.py), 9 s each
    found = replay(recording.path, report_every=20_000.0, gate=True)
    truth = {name: bank.report(index) for index, name in enumerate(axes)}
    assert_same(found, truth, lambda name: factor(model.group_of(name).unit, recording.columns[name].unit))
    gyros = ("gx", "gy", "gz")
    for run_number in (1, 2):
        path = shared_recording(f"adis16405_run{run_number}.npz").path
        other = replay(path, report_every=20_000.0, gate=True, axes=gyros)
        for name in gyros:
            noise = [one["axes"][name]["parameters"]["random_walk"]["N"]["mean"] for one in (found, other)]
            assert noise[0] == pytest.approx(noise[1], rel=0.08), name


REGRESSORS = """
regressors:
  - {name: warm, kind: column, column: temp, unit: degC, reference: 25, window_s: 10, sd: {gyro: 0.02, accel: 0.05}}
  - {name: follows, kind: column, column: ay, unit: m/s^2, reference: 0, sd: {gyro: 0.02}, probability: 0.3}
  - {name: ramp, kind: time, sd: {gyro: 1e-5}}
  - {name: settling, kind: turn_on, tau_s: 250, sd: {gyro: 1}}
"""
HANDLE = "handle: {outlier_sd: 6, steps: true, variance_changes: true}\nhalf_life_s: 4000\n"


@pytest.mark.parametrize(("more", "gate", "axes"), [(REGRESSORS, False, ("gz", "ax")), (HANDLE, True, ("gx",))])
def test_the_application_in_this_process_is_the_program(
    more: str, gate: bool, axes: tuple[str, ...], tmp_path: Path
) -> None:
    """The program that is compiled for a model and speaks SLCAN: the same document to the last digit. The record has a
    gap, a step, outliers and shaking; its times count from power-on."""
    (tmp_path / "model.yaml").write_text(Model.load().path.read_text() + more)
    shipped = load(SHIPPED)
    columns = {name: (one.unit, one.values[:9000].copy()) for name, one in shipped.columns.items() if name != "t"}
    columns["gx"][1][5000:] += 0.4
    columns["gx"][1][::900] += 5.0
    columns["gx"][1][2000:2100] += 20.0 * np.sin(np.arange(100.0))
    at = np.arange(9000) + 70 * (np.arange(9000) >= 3000)
    recording_module.save(tmp_path / "log.npz", columns, shipped.rate_hz, {}, t=at / shipped.rate_hz)
    here, program = (
        replay(
            tmp_path / "log.npz", axes=axes, model=tmp_path / "model.yaml", gate=gate, report_every=100.0,
            since_power_on_s=30.0, transport=transport,
        )
        for transport in (None, "slcan")
    )  # fmt: skip
    assert here == program
    assert all("error" not in here["axes"][name] for name in axes)


def test_replay_is_the_library_over_the_wire(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = part_of_shipped(tmp_path / "part.csv.gz")
    titles: list[str] = []
    drawn = plot_module.plot_run

    def watched(history: Any, path: Any, title: str, *more: Any, **named: Any) -> None:
        titles.append(title)
        drawn(history, path, title, *more, **named)

    monkeypatch.setattr(plot_module, "plot_run", watched)
    document = replay(log, report_every=100.0, json=tmp_path / "report.json", plot=tmp_path / "report.png")
    assert json.loads((tmp_path / "report.json").read_text()) == document
    assert document["schema"] == "selfcal.identify/1"
    recording = load(log)
    assert int(recording.missing_before.sum()) == 70
    assert_same(document, direct(recording, Model.load().axes))
    # identify runs a bank an axis; from its estimates to these the checks move by far less than their limits of 0.16
    alone = identify(log)
    for name, axis in document["axes"].items():
        assert axis["samples_kept_out"] == alone["axes"][name]["samples_kept_out"]
        assert axis["samples_kept_out"]["missing"] == 70
        assert axis["adequate"] is alone["axes"][name]["adequate"]
        checks = {check: outcome["value"] for check, outcome in alone["axes"][name]["checks"].items()}
        # the drift in an average, four of the innovations, averaging times from 2 to 64 s, three of the drift; the
        # lattice if there is one
        assert len(checks) - ("lattice" in checks) == 1 + 4 + 6 + 3
        assert {check: outcome["value"] for check, outcome in axis["checks"].items()} == pytest.approx(checks, abs=0.02)
    said = capfd.readouterr().err
    # 600 s, a report each 100 s, the last at the end of the recording: 6 of 46 + 6 x 52 frames, and the last status
    assert f"frames: {6 * (46 + 6 * 52) + 46} received, 0 lost" in said
    image = (tmp_path / "report.png").read_bytes()
    assert image.startswith(b"\x89PNG")
    assert struct.unpack(">II", image[16:24]) >= (1000, 500)
    assert titles
    assert "(SIMULATED)" in titles[0]


def test_reports_come_when_asked_for(tmp_path: Path) -> None:
    recording = load(part_of_shipped(tmp_path / "part.csv.gz", 330.0))
    model = Model.load()
    axes = ("gx", "az")
    history, _ = run_firmware(build(model, recording.rate_hz, axes), recording, model, axes, 60.0)
    for name in axes:
        # the sample before the gap of 7 s that begins at 300 s comes at 300.0 s on the clock; the end is at 330 s
        assert [report.time_s for report in history[name]] == [60.0, 120.0, 180.0, 240.0, 300.0, 330.0]
        counts = [report.value("count") for report in history[name]]
        assert counts == sorted(counts)
        assert history[name][-1].values["gaps"] == 1
        assert history[name][0].values["gaps"] == 0


def test_units_of_the_recording_come_back(tmp_path: Path) -> None:
    log = part_of_shipped(tmp_path / "radians.npz", unit="rad/s")
    document = replay(log, axes=["gz"], report_every=600.0)
    assert document["axes"]["gz"]["bias_now"]["unit"] == "rad/s"
    assert document["axes"]["gz"]["parameters"]["constant"]["N"]["unit"] == "rad/s/sqrt(Hz)"
    assert_same(document, direct(load(log), ("gz",)), lambda name: np.pi / 180.0)


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return started("replay", *arguments)


def assert_one_line(done: subprocess.CompletedProcess[str], complaint: str) -> None:
    assert done.returncode == 2, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("selfcal: error: ")]
    assert len(errors) == 1
    assert complaint in errors[0]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--transport", "can", "--target", "cortex-m0"], "--transport can: an emulated board has a serial line alone"),
        (["--channel", "vcan0"], "--channel vcan0: goes with --transport can"),
        (["--transport", "can", "--channel", "no-such-can"], "socketcan no-such-can: th"),
        (["--report-every", "0"], "--report-every must be above 0 s, 4e+06 s at most, not 0"),
        (["--report-every", "1e9"], "--report-every must be above 0 s, 4e+06 s at most, not 1e+09"),
        (["--report-every", "nan"], "--report-every must be above 0 s, 4e+06 s at most, not nan"),
        (["--axis", "temp"], "no axis 'temp'"),
        (["--model", "no-such-model.yaml"], "cannot read the model file"),
    ],
)
def test_bad_options(options: list[str], complaint: str) -> None:
    assert_one_line(command(SHIPPED, *options), complaint)


def test_recording_too_short_for_a_report(tmp_path: Path) -> None:
    (tmp_path / "short.csv").write_text("t[s],gx[deg/s]\n0,1.0\n1,1.1\n")
    assert_one_line(command(tmp_path / "short.csv"), "too short")


def test_recording_without_a_report_says_why(tmp_path: Path) -> None:
    """As `identify` does: saturated, without any scatter."""
    for gx, complaint in (
        (np.full(600, 400.0), "column gx: no usable sample: all are saturated (range 300 deg/s) or stuck"),
        (np.full(600, 1.0), "column gx: all 60 averages are equal (1 deg/s): a stuck or too coarse reading"),
    ):
        rows = "".join(f"{k / 10:.1f},{value:.6f}\n" for k, value in enumerate(gx))
        (tmp_path / "log.csv").write_text("t[s],gx[deg/s]\n" + rows)
        assert_one_line(command(tmp_path / "log.csv"), complaint)


def test_a_retired_axis_is_named(tmp_path: Path) -> None:
    """gx saturates for good after 300 of 600 s: its numbers are from before, and the terminal and the JSON say so."""
    gx, gy = 0.1 * np.random.default_rng(2).normal(size=(2, 6000))
    gx[3000:] = 400.0
    rows = "".join(f"{k / 10:.1f},{x:.6f},{y:.6f}\n" for k, (x, y) in enumerate(zip(gx, gy, strict=True)))
    (tmp_path / "log.csv").write_text("t[s],gx[deg/s],gy[deg/s]\n" + rows)
    done = command(tmp_path / "log.csv", "--json", tmp_path / "report.json")
    assert done.returncode == 0
    assert "gx: retired as dead on the way" in done.stderr
    assert "gy: retired" not in done.stderr
    axes = json.loads((tmp_path / "report.json").read_text())["axes"]
    assert axes["gx"]["samples_kept_out"]["saturated"] == 3000
    # with a report at the end alone there is none from before
    done = command(tmp_path / "log.csv", "--report-every", "600", "--json", tmp_path / "report.json")
    assert done.returncode == 0
    assert "gx: retired as dead on the way; left out: it has no report from before" in done.stderr
    assert list(json.loads((tmp_path / "report.json").read_text())["axes"]) == ["gy"]
    assert axes["gy"]["samples_kept_out"]["saturated"] == 0


def test_model_in_other_units_than_the_wire(tmp_path: Path) -> None:
    text = Model.load().path.read_text()
    assert text.count("unit: deg/s") == 1
    (tmp_path / "model.yaml").write_text(text.replace("unit: deg/s", "unit: rad/s"))
    assert_one_line(command(SHIPPED, "--model", tmp_path / "model.yaml"), "telemetry carries it in deg/s")


def test_a_model_of_more_nodes_than_the_default_one(tmp_path: Path) -> None:
    """The firmware's sizes follow from it."""
    text = Model.load().path.read_text()
    old = "cortex-m4f: {random_walk: 16,"
    assert text.count(old) == 1
    (tmp_path / "model.yaml").write_text(text.replace(old, "cortex-m4f: {random_walk: 24,"))
    done = command(SHIPPED, "--target", "cortex-m4f", "--model", tmp_path / "model.yaml")
    assert done.returncode == 0, done.stderr


def test_a_rate_that_no_board_has(tmp_path: Path) -> None:
    """Faster than the board's sensor can be read: a recording has no sensor."""
    gx = 0.1 * np.random.default_rng(3).normal(size=20_000)
    recording_module.save(tmp_path / "fast.npz", {"gx": ("deg/s", gx)}, 2000.0, {})
    document = replay(tmp_path / "fast.npz", report_every=10.0)
    assert document["axes"]["gx"]["bias_now"]["mean"] == pytest.approx(gx.mean(), abs=0.01)


def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    log = part_of_shipped(tmp_path / "part.npz", 60.0)
    for option in ("--plot", "--json"):
        assert_one_line(command(log, option, tmp_path / "no-such-folder" / "file.png"), "there is no folder")
    short = (log, "--axis", "gx", "--report-every", "30")
    assert_one_line(command(*short, "--plot", tmp_path / "plot.xyz"), "a plot is one of .png")


# ------------------------------------------------------------------------------------------------- the host firmware


class Module:
    """The host firmware of one axis at 10 Hz over `rows` bytes."""

    def __init__(self, folder: Path, rows: bytes, *options: str) -> None:
        file = folder / "rows.bin"
        file.write_bytes(rows)
        program = build(Model.load(), 10.0, ("gx",))
        self.process = subprocess.Popen(
            [str(program), str(file), *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def open(self) -> int:
        assert self.process.stdout is not None
        word, path = self.process.stdout.readline().split()
        assert word == "SELFCAL_PTY"
        return os.open(path, os.O_RDWR | os.O_NOCTTY)

    def end(self) -> tuple[int, str]:
        said = self.process.communicate(timeout=30)[1]
        return self.process.returncode, said


def rows(count: int = 600, axes: int = 1, rate_hz: float = 10.0, magic: bytes = b"SELFCAL2") -> bytes:
    noise = np.random.default_rng(1).normal(0.0, 0.1, count).astype("<f4")
    body = np.zeros(count, dtype=[("missing", "<u4"), ("reading", "<f4"), ("side", "<f4", (2,))])
    body["reading"], body["side"] = noise, np.nan
    return magic + struct.pack("<IIdQQ", axes, 2, rate_hz, count, 0) + body.tobytes()


def read_until(line: int, end: bytes, seconds: float = 20.0) -> bytes:
    data = b""
    stop = time.monotonic() + seconds
    while end not in data and time.monotonic() < stop:
        data += os.read(line, 4096)
    assert end in data
    return data


def test_rows_written_are_rows_expected(tmp_path: Path) -> None:
    """The layout in the comment of port/replay/replay.h, packed here by struct."""
    path = tmp_path / "two.csv"
    path.write_text("t[s],gx[rad/s]\n0,1.0\n0.1,2.0\n0.2,2.0\n0.5,3.0\n")
    recording = load(path, rate=10.0).later(12.3)
    write_rows(recording, Model.load(), ("gx",), tmp_path / "rows.bin")
    degrees = 180.0 / np.pi
    want = b"SELFCAL2" + struct.pack("<IIdQQ", 1, 2, 10.0, 4, 123)
    unknown = b"\0\0\xc0\x7f"  # not a number: this recording has no temperature and no supply
    rows = ((0, 1), (0, 2), (0, 2), (2, 3))
    want += b"".join(struct.pack("<If4s4s", gap, x * degrees, unknown, unknown) for gap, x in rows)
    assert (tmp_path / "rows.bin").read_bytes() == want


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "not a recording"),
        (rows(magic=b"SOMETHIN"), "not a recording"),
        (rows(axes=6), "axes are not those"),
        (rows(rate_hz=100.0), "rate is not that"),
        (rows(rate_hz=float("nan")), "rate is not that"),
    ],
)
def test_firmware_refuses_a_recording(data: bytes, complaint: str, tmp_path: Path) -> None:
    code, said = Module(tmp_path, data).end()
    assert code == 2
    assert complaint in said


def test_firmware_says_when_the_recording_breaks_off(tmp_path: Path) -> None:
    module = Module(tmp_path, rows()[:-3])
    line = module.open()
    os.write(line, b"O\r")
    code, said = module.end()
    os.close(line)
    assert code == 2
    assert "shorter than it says" in said


def test_firmware_waits_for_open_and_for_close(tmp_path: Path) -> None:
    module = Module(tmp_path, rows(), "--report-every", "1000")
    line = module.open()
    os.write(line, b"V\r")
    assert read_until(line, b"\r") == b"V0101\r"  # answered, and not a frame before the channel is open
    time.sleep(0.3)
    os.write(line, b"N\r")
    assert read_until(line, b"\r") == b"NSCAL\r"
    os.write(line, b"O\r")
    # the last frame is the number of frames sent: one report of status and axis, and the last status, less itself
    frames = read_until(line, b"t2008" + struct.pack("<I", 46 + 52 + 45).hex().upper().encode())
    assert frames.startswith(b"\rt200860EA0000")  # its time: 60 000 ms
    time.sleep(0.3)
    assert module.process.poll() is None  # what it sent could still be unread
    os.write(line, b"C\r")
    assert module.end() == (0, "")
    os.close(line)


def test_firmware_gives_up_without_a_host(tmp_path: Path) -> None:
    code, said = Module(tmp_path, rows(), "--timeout", "0.3").end()
    assert code == 1
    assert "did not open" in said


def test_firmware_gives_up_on_a_host_that_stops_reading(tmp_path: Path) -> None:
    module = Module(tmp_path, rows(6000), "--timeout", "0.5", "--report-every", "1")
    line = module.open()
    os.write(line, b"O\r")
    code, said = module.end()
    os.close(line)
    assert code == 1
    assert "stopped reading" in said


def test_firmware_ends_when_the_host_hangs_up(tmp_path: Path) -> None:
    module = Module(tmp_path, rows(60000), "--report-every", "1")
    line = module.open()
    os.write(line, b"O\r")
    read_until(line, b"t201")
    os.close(line)
    code, said = module.end()
    assert code == 1
    assert "hung up" in said


def test_firmware_keeps_to_the_wall_clock(tmp_path: Path) -> None:
    """60 s of recording at 40 times real time: 1.5 s."""
    module = Module(tmp_path, rows(600), "--realtime", "40", "--report-every", "10")
    line = module.open()
    begun = time.monotonic()
    os.write(line, b"O\r")
    read_until(line, b"t2008" + struct.pack("<I", 6 * (46 + 52) + 45).hex().upper().encode())
    took = time.monotonic() - begun
    os.write(line, b"C\r")
    assert module.end()[0] == 0
    os.close(line)
    assert 1.45 <= took < 6.0  # never early; late only by what a busy machine adds
