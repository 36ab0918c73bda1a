"""`selfcal replay --transport can`, `selfcal demo`, and what a signal leaves of either.

Truth: `replay` over SLCAN, which loses nothing (tests/port/test_replay.py), of the same recording.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from test_replay import SHIPPED, part_of_shipped

from selfcal.base.errors import UserError
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.show.identification import show
from selfcal.verbs.demo import demo
from selfcal.verbs.monitor import monitor
from selfcal.verbs.replay import replay
from selfcal.wire.replay import build, can_bus, write_rows

from conftest import needs_multicast

ROOT = Path(__file__).resolve().parents[2]
COMMAND = (sys.executable, "-m", "selfcal.cli")


@needs_multicast
def test_replay_over_can_is_replay_over_slcan(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Frames as python-can's udp_multicast takes them, none lost at the pace of the bus."""
    log = part_of_shipped(tmp_path / "part.npz", 330.0)
    over_slcan = replay(log, axes=("gx", "az"), report_every=60.0, transport="slcan")
    capfd.readouterr()
    assert replay(log, axes=("gx", "az"), report_every=60.0, transport="can") == over_slcan
    assert f"frames: {6 * (46 + 2 * 52) + 46} received, 0 lost" in capfd.readouterr().err


@needs_multicast
def test_frames_take_the_time_that_a_bus_takes(tmp_path: Path) -> None:
    """270 us each: 135 bits at 500 kbit/s. The firmware itself takes milliseconds over this recording's reports."""
    firmware = build_for(tmp_path)
    bus, link = can_bus("")
    with link:
        begun = time.monotonic()
        subprocess.run(
            [firmware, tmp_path / "rows.bin", "--report-every", "10", "--can", bus], check=True, capture_output=True
        )
        frames = 0
        while link.recv(0.5) is not None:
            frames += 1
    assert frames > 1000
    assert time.monotonic() - begun > 0.9 * frames * 270e-6


def build_for(folder: Path) -> Path:
    model, recording = Model.load(), load(part_of_shipped(folder / "part.npz", 330.0))
    write_rows(recording, model, ("gx", "az"), folder / "rows.bin")
    return build(model, recording.rate_hz, ("gx", "az"))


@pytest.mark.parametrize(
    ("bus", "complaint"),
    [
        ("no-such-can", "selfcal-posix: no-such-can: "),
        ("1.2.3.4:5", "wants a multicast group and a port"),
        ("239.74.163.2:0", "wants a multicast group and a port"),
        ("239.74.163.2:70000", "wants a multicast group and a port"),
        ("239.74.163.2:4x", "wants a multicast group and a port"),
        ("a-name-that-is-much-too-long-for-a-group:43113", "no such group"),
        ("a-name-that-is-much-too-long-for-a-device", "no such CAN device"),
    ],
)
def test_a_bus_that_is_none(tmp_path: Path, bus: str, complaint: str) -> None:
    firmware = build_for(tmp_path)
    done = subprocess.run(
        [firmware, tmp_path / "rows.bin", "--can", bus], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == 1
    assert complaint in done.stderr


@contextmanager
def demonstration(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A running `selfcal demo`, and how it says to watch it."""
    command = [*COMMAND, "demo", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            said = [process.stdout.readline() for _ in range(3)]
            yield process, said[1].partition(f"{shlex.join(COMMAND)} monitor ")[2].strip()
        finally:
            process.kill()


def children(process: subprocess.Popen[str]) -> list[int]:
    listed = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
    return [int(child) for child in listed.split()]


def gone(pid: int) -> bool:
    """Whether a process has ended; a zombie has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].startswith("Z")
    except OSError:
        return True


def test_demo_is_watched_as_it_says_again_and_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its module outlives the hosts that watch it, one that is killed too; a signal ends both."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with demonstration("--speed", "100") as (demo, watch):
        for duration in ("60", "2"):
            begun = time.monotonic()
            command = [*COMMAND, "monitor", *watch.split(), "--duration", duration]
            with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as watching:
                if duration == "60":
                    time.sleep(5.0)
                    watching.kill()
                said = watching.communicate(timeout=60)[1]
            if duration != "60":
                assert watching.returncode == 0, said
                assert re.search(r"frames: [1-9]\d+ received, \d+ lost; 0 bad", said), said
                assert time.monotonic() - begun < 30.0
        (firmware,) = children(demo)
        assert any(tmp_path.glob("selfcal-*"))
        demo.send_signal(signal.SIGTERM)
        assert demo.wait(timeout=10) == 0
        time.sleep(0.2)
        assert gone(firmware)
        assert not any(tmp_path.glob("selfcal-*"))


@needs_multicast
def test_demo_over_can_is_watched_by_python_cans_own_interface() -> None:
    """Two at once, as on a bus."""
    with demonstration("--speed", "100", "--transport", "can") as (_, watch):
        assert watch == "--interface udp_multicast --channel 239.74.163.2"
        outcome = monitor(interface="udp_multicast", channel="239.74.163.2", duration=4.0)
    assert outcome.received > 100
    assert not outcome.contact_lost


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"speed": 0.0}, "--speed must be above 0"),
        ({"speed": 1e9}, "--speed must be above 0 and at most 1000"),
        ({"channel": "vcan0"}, "goes with --transport can"),
        ({"log": "no-such.csv"}, "no-such.csv"),
    ],
)
def test_demo_says_what_is_wrong(options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        demo(**options)


@pytest.mark.parametrize("transport", ["slcan", pytest.param("can", marks=needs_multicast)])
def test_a_killed_demo_leaves_no_module_behind(transport: str) -> None:
    """SIGKILL cannot be caught: the firmware sees the end of its input, while it waits for a host or plays at its own
    pace. It is there before, and gone within 5 s."""
    command = [*COMMAND, "demo", "--transport", transport, "--speed", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("watch it by"):
                break
        (module,) = children(process)
        time.sleep(0.5)
        assert not gone(module)
        process.kill()
        process.wait(timeout=30)
        end = time.monotonic() + 5.0
        while not gone(module) and time.monotonic() < end:
            time.sleep(0.05)
        assert gone(module)


def test_a_signal_takes_the_emulator_and_the_folders_along(tmp_path: Path) -> None:
    command = [*COMMAND, "replay", str(SHIPPED), "--target", "cortex-m4f"]  # all axes: some seconds of emulation
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 120.0
        emulators: list[int] = []
        while not emulators and time.monotonic() < end:
            time.sleep(0.05)
            emulators = [
                child
                for child in children(process)
                if Path(f"/proc/{child}/comm").read_text().startswith("qemu-system-arm")
            ]
        assert emulators
        time.sleep(0.3)
        process.send_signal(signal.SIGTERM)
        said = process.communicate(timeout=30)[1]
    assert process.returncode == 128 + signal.SIGTERM
    assert "Traceback" not in said
    time.sleep(0.2)
    assert all(gone(emulator) for emulator in emulators)
    assert not any(tmp_path.glob("selfcal-*"))


@pytest.mark.parametrize("width", [80, 100, 120, 200])
def test_the_final_table_fits_the_terminal(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing wrapped, nothing cut: a narrow one shows medians where there is no room for their intervals."""
    document = _document()
    show(document, console=Console(width=width, force_terminal=True))
    plain = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    rows = plain.splitlines()
    assert all(len(row.rstrip()) <= width and "…" not in row for row in rows)
    laws = [row for row in rows if re.match(r" *(constant|random_walk|gauss_markov) ", row)]
    assert len(laws) == 18
    assert all("[" in row for row in laws) is (width >= 100)
    assert ("a wider window shows all intervals" in " ".join(plain.split())) is (width < 120)


def _document() -> dict[str, object]:
    """The widest numbers of the real recordings' table (README.md)."""

    def estimate(median: float, low: float, high: float) -> dict[str, object]:
        return {"median": median, "q05": low, "q95": high, "identified": True, "off_grid": False}

    n, k = estimate(0.000649, 0.000641, 0.000658), estimate(0.000106, 9.96e-05, 0.000113)
    axis = {
        "hypotheses": {"constant": 0.0, "random_walk": 0.0467, "gauss_markov": 0.9533},
        "parameters": {
            "constant": {"N": n},
            "random_walk": {"N": n, "K": k},
            "gauss_markov": {"N": n, "sigma_m": k, "alpha": estimate(1 / 443, 1 / 1190, 1 / 277)},
        },
        "bias_now": {"mean": -0.0041218, "sd": 0.00025, "unit": "g"},
        "adequate": True,
        "checks": {},
    }
    recording = {"path": "../shared/data/log.npz", "samples": 1000000, "rate_hz": 100.0, "duration_s": 10000.0}
    return {"recording": recording, "axes": dict.fromkeys(("gx", "gy", "gz", "ax", "ay", "az"), axis)}
