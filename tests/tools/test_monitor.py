"""`selfcal monitor`: what it counts, logs and shows. Truth: the frames that tests/lib/telemetry_stream.c made."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import threading
import time
import tty
from pathlib import Path

import can
import pytest
from rich.console import Console
from test_wire import spoil

from selfcal import cli
from selfcal.base.errors import UserError
from selfcal.model.file import Model
from selfcal.verbs.identify import identify
from selfcal.verbs.monitor import monitor
from selfcal.wire.dbc_file import PLACE_NAMES
from selfcal.wire.frames import REASONS, AxisReport, Decoder, Link, open_bus, wire_names
from selfcal.wire.live import View

from conftest import run
from wire_stream import lines, message, serial_line, stream

#: What an axis's report has no number for where the record lies outside the priors.
NO_NUMBER = ("bias_mean", "bias_sd", "h0_probability", "h1_probability", "h2_probability")
#: The names of the default model.
NAMES = wire_names(Model.load())


def text_of(sent_lines: list[str]) -> bytes:
    return "".join(line + "\r" for line in sent_lines).encode()


def test_counts_and_log_over_a_serial_line(tmp_path: Path) -> None:
    sent = lines(stream(21, 3))
    log = tmp_path / "frames.blf"
    with serial_line(text_of(sent)) as path:
        statistics = monitor(channel=path, log=log, duration=3.0)
    assert (statistics.received, statistics.lost, statistics.damaged, statistics.refused) == (len(sent), 0, 0, 0)
    with can.LogReader(str(log)) as reader:
        logged = [(frame.arbitration_id, bytes(frame.data)) for frame in reader]
    assert logged == [(int(line[1:4], 16), bytes.fromhex(line[5:])) for line in sent]


def test_its_document_has_all_keys_of_a_recording_s(tmp_path: Path) -> None:
    """Live and of a log alike: what reads the JSON of `identify` reads this. Truth: the document of a recording."""
    rows = "".join(f"{k / 10.0},{k % 7}.5\n" for k in range(900))
    (tmp_path / "log.csv").write_text(f"t[s],gx[deg/s]\n{rows}")
    of_samples = identify(tmp_path / "log.csv", suspicion=False)
    sent = lines(stream(24, 3))
    with serial_line(text_of(sent)) as path:
        monitor(channel=path, log=tmp_path / "frames.log", duration=3.0, json=tmp_path / "live.json")
    monitor(read=tmp_path / "frames.log", json=tmp_path / "read.json")
    for name in ("live.json", "read.json"):
        document = json.loads((tmp_path / name).read_text())
        assert set(document) - {"node"} == set(of_samples)
        assert set(document["recording"]) == set(of_samples["recording"])
        host = {"halved_after_s"}  # worked out by the host from its own tables
        assert set(document["axes"]["gx"]) >= set(of_samples["axes"]["gx"]) - host
        assert document["recording"]["since_power_on_s"] is None  # no message of a module has it
    assert document["recording"]["path"] == str(tmp_path / "frames.log")


def test_its_document_has_the_judgement_and_the_age_of_each_axis(tmp_path: Path) -> None:
    """Of the last report of each axis, where that of one is lost. Truth: what the C code sent."""
    sent = stream(26, 4)
    lost = [one for one in sent if one.message != "STATUS"][-1]
    cut = [one for one in sent if one is not lost]
    write_log(tmp_path / "frames.log", [line for one in cut for line in one.lines])
    monitor(read=tmp_path / "frames.log", json=tmp_path / "told.json")
    axes = json.loads((tmp_path / "told.json").read_text())["axes"]
    words = {0: "not_judged", 1: "adequate", 2: "inadequate"}
    for name, entry in axes.items():
        reports = [one.truth for one in cut if one.message == name.upper()]
        truth = reports[-1]
        assert entry["time_s"] == truth["time_ms"] / 1000.0
        assert entry["averages"] == truth["count"]
        if "adequacy" in truth:
            assert entry["adequacy"]["state"] == words[int(truth["adequacy"])]
            assert entry["adequacy"]["score"] == pytest.approx(truth["suspicion_score"], rel=1e-6)
        else:
            assert entry["adequacy"] is None
    old = axes.pop(lost.message.lower())
    assert len(axes) == 5 and old["time_s"] < min(entry["time_s"] for entry in axes.values())


def write_log(path: Path, rows: list[str]) -> None:
    with can.CanutilsLogWriter(path) as writer:
        for k, line in enumerate(rows):
            frame = message(line)
            frame.timestamp = 0.01 * k
            writer.on_message_received(frame)


def by_turns(one: list[str], other: list[str]) -> list[str]:
    return [line for pair in zip(one, other, strict=False) for line in pair]


@pytest.mark.parametrize("ahead", [0, 7, 900])
def test_two_modules_on_one_node_are_named(ahead: int, tmp_path: Path) -> None:
    """Of one age, or one so many frames older."""
    write_log(tmp_path / "two.log", by_turns(lines(stream(31, 12))[ahead:], lines(stream(32, 12))))
    done = run("monitor", "--read", tmp_path / "two.log")
    assert done.returncode == 1
    assert "two modules send as node 0: build one with another NODE" in done.stderr


def test_one_module_is_not_taken_for_two() -> None:
    """It restarts three times, loses three frames in ten, or sends as another node."""
    sent = lines(stream(33, 8))
    lossy = [line for k, line in enumerate(sent) if (7 * k) % 10 > 2]
    other = by_turns(sent, lines(stream(34, 8, node=1)))
    for rows in (sent[:700] + sent[:300] + sent[:900] + sent, lossy, [line for line in other if line in set(sent)]):
        decoder = Decoder()
        for line in rows:
            decoder.feed(message(line))
        assert decoder.statistics.received > len(rows) // 2
        assert not decoder.twins


def test_a_channel_that_falls_silent_is_opened_again() -> None:
    """A module that saves its state while the host opens: only the second opening reaches it. Then it restarts, and its
    channel is closed."""
    sent = lines(stream(21, 3))
    master, slave = os.openpty()
    tty.setraw(slave)

    def module() -> None:
        heard = b""
        for openings in (2, 3):
            while heard.count(b"O\r") < openings:
                heard += os.read(master, 64)
            os.write(master, text_of(sent))

    thread = threading.Thread(target=module, daemon=True)
    thread.start()
    statistics = monitor(channel=os.ttyname(slave), duration=10.0)
    os.close(master)
    os.close(slave)
    # the restart's counter is ahead of the last one or not: up to two frames go until it is found again
    assert 2 * len(sent) - 2 <= statistics.received == 2 * len(sent) - statistics.refused


def test_any_python_can_interface() -> None:
    """python-can's virtual bus stands for a CAN adapter."""
    sent = lines(stream(21, 3))
    with can.Bus(interface="virtual", channel="selfcal-test") as module:

        def play() -> None:
            time.sleep(0.5)
            for line in sent:
                module.send(message(line))

        thread = threading.Thread(target=play)
        thread.start()
        statistics = monitor(interface="virtual", channel="selfcal-test", duration=2.0)
        thread.join()
    assert (statistics.received, statistics.lost) == (len(sent), 0)


def test_noise_does_not_end_it() -> None:
    """A third of the bytes spoilt: hardly a frame is left, and it goes on to the end of its time."""
    begun = time.monotonic()
    with serial_line(spoil(text_of(lines(stream(22, 6))), seed=3, share=0.33)) as path:
        statistics = monitor(channel=path, duration=4.0)
    assert time.monotonic() - begun >= 4.0
    assert statistics.received < 100
    assert statistics.damaged + statistics.refused > 0


def test_once_ends_when_the_other_side_goes(capfd: pytest.CaptureFixture[str]) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    threading.Timer(3.0, os.close, [master]).start()
    begun = time.monotonic()
    outcome = monitor(channel=path, duration=60.0, once=True)
    os.close(slave)
    assert time.monotonic() - begun < 30.0
    assert outcome.contact_lost
    assert "the other side has gone" in capfd.readouterr().err


def test_a_serial_line_has_one_reader() -> None:
    """Of two each would lose what the other takes."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    with open_bus("slcan", path), pytest.raises(UserError, match="another program has it open"):
        open_bus("slcan", path)
    with open_bus("slcan", path):  # the first has closed it
        pass
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--channel", "/dev/no-such-device"], "there is no such port (th"),
        (["--channel", "/dev/no-such-device@fast"], "/dev/no-such-device@115200"),
        (["--channel", "/tmp"], "a folder, no serial port (th"),
        (["--channel", __file__], "selfcal monitor --read"),
        (["--channel", "/dev/null"], "no serial port (th"),
        (["--interface", "foo", "--channel", "x"], "no such interface (there are canalystii, "),
        (["--interface", "udp_multicast", "--channel", "1.2.3.4"], "no multicast group"),
        (["--interface", "kvaser", "--channel", "0"], "its driver is not installed"),
        (["--interface", "vector", "--channel", "0"], "0: its driver is not installed on this machine, or is none for"),
        (["--interface", "gs_usb", "--channel", "0"], "0: its driver is not installed on this machine, or is none for"),
        (["--interface", "pcan", "--channel", "X"], "X: its driver is not installed on this machine, or is none for"),
        (["--interface", "socketcand", "--channel", "x"], "x: this interface wants more than a channel"),
        (["--interface", "robotell", "--channel", "no"], "no: cannot open: No such file or directory\n"),
        (["--channel", "socket://127.0.0.1:1"], "127.0.0.1:1: cannot open: Connection refused\n"),
        (["--channel", "foo://x"], "foo://x: pyserial opens no such address: socket://HOST:PORT"),
        ([], "--channel names its port (th"),
        (["--channel", "x", "--read", "y.asc"], "one of the two"),
        (["--channel", "x", "--speed", "2"], "--speed"),
        (["--read", "y.asc", "--speed", "nan"], "--speed"),
        (["--read", "no-such.asc"], "there is no such file"),
        (["--read", "/tmp"], ".asc, .blf, .csv, .log, .mcap, .trc"),
        (["--channel", "x", "--axis", "temp"], "axis 'temp'"),
        (["--channel", "x", "--json", "/no-such-folder/x.json"], "there is no folder"),
        (["--channel", "x", "--plot", "x.gif"], "a plot is one of"),
        (["--channel", "x", "--log", "frames.db"], ".asc, .blf, .csv, .log, .mcap, .trc"),
        (["--channel", "x", "--duration", "0"], "--duration"),
        (["--interface", "virtual", "--channel", "x", "--log", "/no-such-folder/frames.asc"], "cannot be written"),
    ],
)
def test_user_errors_are_one_line(
    options: list[str], complaint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["selfcal", "monitor", *options])
    monkeypatch.setattr(cli, "install_signals", lambda: None)  # pytest keeps its signals
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = capsys.readouterr().err
    assert end.value.code == 2
    assert complaint in said
    assert said.startswith("selfcal: error: ")
    assert said.count("\n") == 1


def shown(view: View) -> str:
    console = Console(width=220, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    console.print(view.renderable())
    return console.export_text()


def test_view_shows_what_did_not_arrive_as_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never the value of the report before."""
    monkeypatch.setenv("COLUMNS", "200")
    sent = stream(23, 2)
    first, second = (one for one in sent if one.message == "GX")
    dropped = [second.lines[1], *second.lines[3:6]]  # count, evidence, bias
    at = sent.index(first) + 1
    decoder = Decoder()
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "test", total_s=100.0)
        for line in lines(sent[:at]):
            view.show(decoder.feed(message(line)))
        assert f"{first.truth['count']:.0f}" in shown(view)
        assert "?" not in shown(view)
        for line in lines(sent[at:]):
            if line not in dropped:
                view.show(decoder.feed(message(line)))
        picture = shown(view)
    assert f"{first.truth['count']:.0f}" not in picture
    assert f"{first.truth['bias_mean']:.5g}" not in picture
    assert "? ± ? °/s" in picture
    k = max(range(3), key=lambda k: second.truth[f"h{k}_probability"])
    assert f"h{k}: N {second.truth[f'h{k}_N_median']:.3g} [" in picture


def test_view_of_a_record_outside_the_priors(monkeypatch: pytest.MonkeyPatch) -> None:
    """The module has no number for what it was to find: neither missing nor some law's."""
    monkeypatch.setenv("COLUMNS", "200")
    report = AxisReport("gx", 1.0, True, {"count": 600.0, "hypotheses": 3.0} | dict.fromkeys(NO_NUMBER, math.nan))
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(Decoder(), Link(bus), "test")
        view.show([report])
        picture = shown(view)
    assert "- ± - °/s" in picture
    assert "outside the priors" in picture
    assert "600" in picture
    assert "?" not in picture
    assert "nan" not in picture


def test_view_of_what_the_grid_does_not_bear(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        for flags, said in ((1.0, False), (9.0, True)):
            values = {"h0_probability": 1.0, "h1_probability": 0.0, "h2_probability": 0.0, "hypotheses": 3.0}
            view = View(Decoder(), Link(bus), "test")
            view.show([AxisReport("gx", 1.0, True, values | {"h0_N_flags": flags, "h1_N_flags": 8.0})])
            assert ("grid of nodes too coarse" in shown(view)) == said


def test_view_tells_the_status_by_its_names() -> None:
    """What is not 0 of it, choices by the DBC's names, axes by theirs."""
    decoder = Decoder()
    decoder.status.update(sensor_state=3.0, sensor_fault=1.0, sensor_fault_count=3.0, bus_off_count=0.0)
    decoder.status.update(state=1.0, axes_retired=0b100010, offset_gx=0.25)
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        picture = shown(View(decoder, Link(bus), "test"))
    assert "running" in picture
    for said in ("state failed", "fault absent", "fault_count 3", "axes_retired gy,az", "offset_gx 0.25 deg/s"):
        assert said in picture
    assert "bus_off_count" not in picture


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"phase": 1.0, "rests": 5.0, "wanted": 12.0, "next": 3.0}, "5 of 12: now -z up"),
        ({"phase": 3.0, "rests": 7.0, "wanted": 12.0, "next": 9.0}, "7 of 12: now -x +z up"),
        ({"phase": 2.0, "rests": 7.0, "wanted": 12.0, "next": 9.0}, "7 of 12: hold still"),
        ({"phase": 3.0, "rests": 13.0, "wanted": 13.0, "next": 12.0}, "13 of 13: send tumble stop"),
        ({"phase": 0.0, "result": 5.0, "next": 12.0}, "no calibration, not identified: send tumble start"),
        ({"phase": 0.0, "applied": 1.0, "scale_y": -0.0031, "scale_y_sd": 2e-5}, "scale y -3100 ± 20 ppm"),
        ({"phase": 0.0, "applied": 1.0, "bias_x": 0.0980665, "bias_x_sd": 0.00980665}, "bias x 10000 ± 1e+03 ug"),
        ({"phase": 0.0, "applied": 1.0, "g_zx": -0.0123}, "G zx -0.0123 deg/s/g"),
    ],
)
def test_view_of_a_calibration(monkeypatch: pytest.MonkeyPatch, values: dict[str, float], said: str) -> None:
    """What to do next, and the result in data sheet units: 1 mg is 0.00980665 m/s^2."""
    monkeypatch.setenv("COLUMNS", "200")
    decoder = Decoder()
    decoder.status.update(state=1.0)
    decoder.tumble.update(values)
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        assert said in shown(View(decoder, Link(bus), "test"))


def test_view_tells_why_an_axis_has_no_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the next step: of axes without a report in one line, of one with a report beside it. Of a reason that is
    none nothing is said."""
    monkeypatch.setenv("COLUMNS", "200")
    decoder = Decoder()
    decoder.status.update(state=1.0, reason_gx=8.0, reason_gy=6.0, reason_gz=6.0, reason_ax=0.0)
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "test")
        view.show([AxisReport("gx", 1.0, True, {"count": 5.0, "bias_mean": 0.25})])
        picture = shown(view)
    assert f"gy, gz: {REASONS['moving']}" in picture
    assert REASONS["not_identified"] in picture
    assert "reason_" not in picture
    assert not re.search(r"\bax\b", picture)


def test_view_of_a_module_that_starts_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports are told with their age; those of before a restart are shown no more."""
    monkeypatch.setenv("COLUMNS", "200")
    decoder = Decoder()
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "test")
        decoder.time_ms = 700_000
        view.show([AxisReport("gx", 600.0, True, {"count": 601.0, "bias_mean": 0.25})])
        assert "0.25 ±" in shown(view)
        assert re.search(r"^gx .* 100 s *$", shown(view), re.MULTILINE)
        decoder.time_ms = 10_000
        assert "0.25 ±" not in shown(view)
        decoder.time_ms = 20_000
        view.show([AxisReport("gx", 20.0, True, {"count": 19.0, "bias_mean": 0.5})])
        assert "0.5 ±" in shown(view)


def test_view_keeps_all_axes_of_a_slow_module(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports that are begun one after the other, with the status between."""
    monkeypatch.setenv("COLUMNS", "200")
    decoder = Decoder()
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "test")
        for line in lines(stream(21, 2, slow_ms=12_000)):
            view.show(decoder.feed(message(line)))
        picture = shown(view)
    assert re.findall(r"^([ag][xyz]) ", picture, re.MULTILINE) == ["az", "gx", "ay", "gz", "ax", "gy"]
    assert re.findall(r"^[ag][xyz] .* (\d+) s *$", picture, re.MULTILINE) == ["70", "58", "46", "34", "22", "10"]


def test_monitor_function_raises_user_errors() -> None:
    with pytest.raises(UserError, match="there is no such port"):
        monitor(channel="/dev/no-such-device")


# ------------------------------------------------------------------------------------------------- fitted to the window

#: As the shipped recording's reports are: median, 5 % and 95 % of each parameter.
GYRO = {"N": (0.0423, 0.0414, 0.0431), "sigma_m": (0.0169, 0.0146, 0.0201), "alpha": (0.0237, 0.0142, 0.0364)}
ACCEL = {"N": (0.00676, 0.00643, 0.00711), "sigma_m": (0.00859, 0.00517, 0.0403), "alpha": (0.0084, 3.5e-4, 0.0278)}


def six_axes(monkeypatch: pytest.MonkeyPatch, width: int, height: int) -> list[str]:
    """The lines of a view of six Gauss-Markov axes, the widest kind, with health and status to tell."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("LINES", str(height))
    decoder = Decoder()
    decoder.status.update(state=1.0, samples=36000.0, missing=70.0, gap_count=1.0, sensor_fault=1.0, motion=1.0)
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "slcan /dev/ttyACM0", total_s=3600.0, names=lambda status: NAMES)
        for k in range(40):
            for axis in ("gx", "gy", "gz", "ax", "ay", "az"):
                values = {"count": 36000.0, "bias_mean": -0.040421 + 1e-4 * k, "bias_sd": 0.0025}
                values |= {"h0_probability": 0.0, "h1_probability": 0.063, "h2_probability": 0.937, "hypotheses": 3.0}
                for place, numbers in zip(PLACE_NAMES, (GYRO if axis[0] == "g" else ACCEL).values(), strict=True):
                    for key, number in zip(("median", "q05", "q95"), numbers, strict=True):
                        values[f"h2_{place}_{key}"] = number
                view.show([AxisReport(axis, 10.0 * k, True, values)])
        decoder.time_ms = 402_000
        console = Console(width=width, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
        console.print(view.renderable())
    return console.export_text().splitlines()


@pytest.mark.parametrize(("width", "height"), [(80, 24), (140, 40)])
def test_view_of_six_axes_fits(monkeypatch: pytest.MonkeyPatch, width: int, height: int) -> None:
    """All axes whole: nothing wrapped or cut, the counters there, bars of 12 cells or more, the bias's course."""
    rows = six_axes(monkeypatch, width, height)
    assert len(rows) <= height
    assert all(len(row) <= width and "…" not in row for row in rows)
    text = "\n".join(rows)
    assert "frames: 0 received, 0 lost" in text
    assert re.search(r"^axis averages  P constant", text, re.MULTILINE)
    for axis in ("gx", "gy", "gz", "ax", "ay", "az"):
        assert re.search(rf"^{axis} +36000  0\.000 ·{{12,}}  0\.063 █+·+  0\.937 █{{11,}}·+ +12 s$", text, re.MULTILINE)
    assert len(re.findall(r"bias -0\.036521 ± 0\.0025 (?:°/s|m/s²) +[▁▂▃▄▅▆▇█]{8,}", text)) == 6
    assert text.count("N 0.0423 [0.0414, 0.0431] °/s/√Hz") == 3
    assert text.count("sigma_m 0.00859 [0.00517, 0.0403] m/s²") == 3
    assert text.count("1/alpha 119 [36, 2.86e+03] s") == 3


@pytest.mark.parametrize("height", [10, 14, 20])
def test_view_in_a_low_window_keeps_one_axis_and_the_counters(monkeypatch: pytest.MonkeyPatch, height: int) -> None:
    rows = six_axes(monkeypatch, 80, height)
    text = "\n".join(rows)
    assert len(rows) <= height
    assert "frames: 0 received, 0 lost" in text
    assert "1/alpha 42.2 [27.5, 70.4] s" in text
    shown_axes = len(re.findall(r"^[ag][xyz] ", text, re.MULTILINE))
    assert shown_axes == 6 or f"{6 - shown_axes} axes more" in text


def test_axes_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = lines(stream(21, 1))
    decoder = Decoder()
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "test", axes=("gy", "az"))
        for line in sent:
            view.show(decoder.feed(message(line)))
        assert sorted(re.findall(r"^([ag][xyz]) ", shown(view), re.MULTILINE)) == ["az", "gy"]
