"""Holes of `monitor`: frames that lie, modules that die, logs that are cut or of another form. Many in `make cases`."""

from __future__ import annotations

import fcntl
import io
import json
import os
import random
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import can
import pytest
from rich.console import Console

from selfcal.base.errors import UserError
from selfcal.logs.framelog import WRITTEN, FrameLog
from selfcal.verbs import monitor as verb
from selfcal.wire.frame_writer import FLUSH_S, FrameWriter
from selfcal.wire.frames import Decoder, Streams, frame_crc
from selfcal.wire.live import Contact, View

from conftest import COMMAND, case_records, shared_case
from wire_stream import lines, message, serial_line, stream

STATUS_ID = 0x200


def changed(frame: can.Message, item: int | None, value: int | None) -> can.Message:
    """The frame with another item or value, its counter and its time, and a right checksum."""
    bits = int.from_bytes(frame.data, "little")
    if value is not None:
        bits = bits >> 32 << 32 | value & 0xFFFFFFFF
    if item is not None:
        bits = bits & ~(0x3F << 32) | item << 32
    bits &= (1 << 52) - 1
    bits |= frame_crc(frame.arbitration_id, bits.to_bytes(8, "little")) << 52
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False, data=bits.to_bytes(8, "little"))


class Quiet:
    """A source with nothing to say of itself."""

    malformed, closed = 0, False


def text_of(view: View, width: int = 140) -> str:
    """All that the view shows."""
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(view.renderable(whole=True))
    return console.export_text()


# ---------------------------------------------------------------------------------------------------- items that lie


def test_one_foreign_status_item_ends_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A right checksum, another version: it is counted, and the next reports come. Five places, as it was found."""
    sent = [message(line) for line in lines(stream(11, 8))]
    versions = [k for k, frame in enumerate(sent) if frame.arbitration_id == STATUS_ID and frame.data[4] & 0x3F == 1]
    assert len(versions) >= 6
    for place in versions[1:6]:
        log = tmp_path / f"{place}.log"
        with can.Logger(str(log)) as writer:
            for k, frame in enumerate(sent):
                writer(changed(frame, None, 7) if k == place else frame)
        outcome = verb.monitor(read=log)
        assert not outcome.contact_lost
        assert (outcome.received, outcome.lost, outcome.refused, outcome.foreign) == (len(sent), 0, 0, 1)
        said = capfd.readouterr().err
        assert "0 refused, 1 foreign, 0 malformed" in said
        assert "items of the status that state another wire version are left out" in said


def test_a_module_of_another_version_is_named_after_two_whole_statuses() -> None:
    """Also one that spoke this version before; then nothing of it is shown but that."""
    sent = [message(line) for line in lines(stream(11, 4))]
    decoder = Decoder()
    wholes = 0
    for k, frame in enumerate(sent):
        item = frame.data[4] & 0x3F if frame.arbitration_id == STATUS_ID else None
        decoder.feed(changed(frame, None, 3) if item == 1 and k > 46 else frame)
        wholes += item == 45
        assert decoder.surely_foreign == (wholes >= 3), k
        assert bool(decoder.foreign) == (wholes >= 3), k
    assert decoder.status == {"wire_version": 3.0}


def test_status_items_that_lie_end_nothing() -> None:
    """One item of the status changed, its checksum right: no exception, no end, and the reports after it are whole."""
    chance = random.Random("status")
    sent = [message(line) for line in lines(stream(12, 3))]
    plain = Decoder()
    whole = sum(report.complete for frame in sent for report in plain.feed(frame))
    statuses = [k for k, frame in enumerate(sent) if frame.arbitration_id == STATUS_ID and k > 46]
    hostile = (0, 1, 2, 3, 5, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 0x7FC00000, 0x7F800000, 0xFF7FFFFF)
    for _ in range(case_records(40, 1500)):
        place = chance.choice(statuses)
        item = chance.choice((None, None, 1, chance.randrange(64)))
        streams = Streams()
        view = View(streams, Quiet(), "lies", contact=Contact(), contacts={})
        complete = 0
        for k, frame in enumerate(sent):
            lie = changed(frame, item, chance.choice(hostile)) if k == place else frame
            reports = streams.feed(lie)
            complete += sum(report.complete for report in reports)
            view.show(reports)
            assert not streams.decoders or not streams.decoders[0].foreign
            if k == place:
                text_of(view)
        assert complete >= whole - 1
        assert "Traceback" not in text_of(view)


# ---------------------------------------------------------------------------------------------------- a dead module


@pytest.mark.parametrize("interval_s", [1.0, 4.0, 25.0])
@pytest.mark.parametrize("dead", [0, 3])
def test_a_dead_module_is_not_shown_as_running(interval_s: float, dead: int) -> None:
    """Two modules on one bus, one killed: the view states it within three of its report intervals, and never of the
    other. Truth: the clock of this test."""
    clock = 100.0
    contact_of = partial(Contact, lambda: clock)
    contacts: dict[int, Contact] = {}
    whole, streams = contact_of(), Streams()
    view = View(streams, Quiet(), "bus", contact=whole, contacts=contacts)
    sent = {node: iter(stream(5 + node, 9, slow_ms=5000, node=node)) for node in (0, 3)}

    def speak(node: int) -> None:
        for line in next(sent[node]).lines:
            frame = message(line)
            contacts.setdefault(node, contact_of())
            before = streams.decoders[node].statistics.received if node in streams.decoders else 0
            view.show(streams.feed(frame))
            decoder = streams.decoders[node]
            first, last = decoder.status_ms or (0, 0)
            in_a_row = decoder.statistics.received == before + 1
            contacts[node].heard(in_a_row=in_a_row, paced=abs(last - first) > 3000)
        whole.heard(in_a_row=False, paced=True)

    for _ in range(12):
        clock += interval_s
        for node in (0, 3):
            speak(node)
    alive = 3 - dead
    for k in range(1, 5):
        clock += 0.76 * interval_s
        if k % 2 == 0:
            speak(alive)
        rows = {row.split()[1]: row for row in text_of(view).splitlines() if row.startswith("node ")}
        assert "running" in rows[str(alive)], rows
        lost = 0.76 * k * interval_s > max(3.0, 3.0 * interval_s)
        assert ("lost contact" in rows[str(dead)]) == lost, (k, rows)
    clock += 4.0
    rows = {row.split()[1]: row for row in text_of(view).splitlines() if row.startswith("node ")}
    assert "lost contact" in rows[str(dead)]


def test_monitor_notes_contact_for_the_view_that_it_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The view begins with no contact of any node and must see those that come."""
    seen: list[View] = []

    class Kept(View):
        def print_last(self) -> None:
            seen.append(self)
            super().print_last()

    monkeypatch.setattr("selfcal.wire.live.View", Kept)
    sent = lines(stream(21, 1))
    with serial_line("".join(line + "\r" for line in sent).encode()) as path:
        verb.monitor(channel=path, duration=1.5)
    (view,) = seen
    assert set(view.contacts) == {0}


# ------------------------------------------------------------------------------------------------------------ line ends


def test_line_ends_of_an_adapter(tmp_path: Path) -> None:
    """CR LF, and CR LF with empty lines: every frame is taken. The shared log, and frames of our own."""
    logs = [b"\r\n".join(line.encode() for line in lines(stream(seed, 2))) + b"\r\n" for seed in (31, 32)]
    logs += [logs[0].replace(b"\r\n", b"\r\n\r\n")]
    logs += [shared_case("M02_crlf.slcan", tmp_path).read_bytes()]
    for data in logs:
        with serial_line(data) as path:
            outcome = verb.monitor(channel=path, duration=2.0)
        frames = sum(len(line) == 21 for line in data.splitlines())  # the shared log is cut
        assert (outcome.received, outcome.lost) == (frames, 0)


def test_a_flood_of_line_feeds_does_not_hang() -> None:
    with serial_line(b"\n" * 200_000) as path:
        start = time.monotonic()
        verb.monitor(channel=path, duration=1.0)
        assert time.monotonic() - start < 20.0


# --------------------------------------------------------------------------------------------------------- other forms


def frames_of(path: Path) -> list[tuple[int, bytes, float]]:
    with FrameLog(path) as log:
        found = []
        while not log.closed:
            frame = log.recv(1.0)
            if frame is not None:
                found.append((frame.arbitration_id, bytes(frame.data), frame.timestamp))
        assert log.damage == ""
    return found


def screen(frame: can.Message, form: str) -> str:
    data = " ".join(f"{byte:02X}" for byte in frame.data)
    shown = f"{frame.arbitration_id:03X}   [{frame.dlc}]  {data}"
    return {
        "plain": f"  can0  {shown}",
        "stamps": f" ({frame.timestamp:.6f})  can0  {shown}",
        "long": f" ({frame.timestamp:.6f})  vcan1  RX - -  {shown}   '........'",
        "date": f" (2023-11-14 22:13:20.000000)  can0  {shown}",
    }[form]


@pytest.mark.parametrize("form", ["plain", "stamps", "long", "date"])
def test_candump_s_screen_form_is_read(tmp_path: Path, form: str) -> None:
    sent = [message(line) for line in lines(stream(41, 2))]
    for k, frame in enumerate(sent):
        frame.timestamp = 1.7e9 + k / 1000.0
    path = tmp_path / "view.log"
    path.write_text("".join(screen(frame, form) + "\n" for frame in sent))
    found = frames_of(path)
    assert [one[:2] for one in found] == [(frame.arbitration_id, bytes(frame.data)) for frame in sent]
    if form in ("stamps", "long"):
        assert [one[2] for one in found] == pytest.approx([frame.timestamp for frame in sent], abs=1e-6)


def test_gvret_is_read(tmp_path: Path) -> None:
    sent = [message(line) for line in lines(stream(42, 2))]
    rows = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for k, frame in enumerate(sent):
        rows.append(f"{1000 * k},{frame.arbitration_id:08X},false,Rx,0,8,{','.join(f'{b:02X}' for b in frame.data)},")
    path = tmp_path / "frames.csv"
    path.write_text("\n".join(rows) + "\n")
    found = frames_of(path)
    assert [one[:2] for one in found] == [(frame.arbitration_id, bytes(frame.data)) for frame in sent]
    assert [one[2] for one in found] == pytest.approx([k / 1000.0 for k in range(len(sent))])


@pytest.mark.parametrize("name", ["M08_candump_view.log", "M09_gvret.csv"])
def test_shared_forms_are_read(tmp_path: Path, name: str) -> None:
    path = shared_case(name, tmp_path)
    rows = [row for row in path.read_text().splitlines() if "200" in row and "Time" not in row]
    assert len(frames_of(path)) == len(rows) > 30


def test_changed_logs_of_lines_end_in_a_line(tmp_path: Path) -> None:
    """Damaged logs of every form of lines: read, ended early with a reason, or refused in one line."""
    chance = random.Random("logs")
    sent = [message(line) for line in lines(stream(43, 1))]
    sound = {"view.log": "".join(screen(frame, "stamps") + "\n" for frame in sent).encode()}
    rows = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    rows += [f"0,{frame.arbitration_id:08X},false,Rx,0,8,{','.join(f'{b:02X}' for b in frame.data)}," for frame in sent]
    sound["gvret.csv"] = ("\n".join(rows) + "\n").encode()
    for suffix in (".asc", ".log", ".csv", ".trc"):
        with can.Logger(str(tmp_path / f"frames{suffix}")) as writer:
            for frame in sent:
                writer(frame)
        sound[f"frames{suffix}"] = (tmp_path / f"frames{suffix}").read_bytes()
    for name, data in sound.items():
        path = tmp_path / f"x{name}"
        for _ in range(case_records(10, 500)):
            made = bytearray(data)
            for _ in range(chance.choice((1, 1, 3))):
                at = chance.randrange(len(made))
                made[at : at + chance.choice((0, 1, 5))] = chance.choice(
                    (b"", b"\0", b"\n", b",", b"[9]", b"\xff", b"Z")
                )
            path.write_bytes(made)
            try:
                with FrameLog(path) as log:
                    while not log.closed:
                        log.recv(1.0)
                    assert "\n" not in log.damage
            except UserError as error:
                assert str(error).startswith(str(path)) and "\n" not in str(error)


@pytest.mark.parametrize("suffix", [".asc", ".log", ".csv"])
def test_a_cut_log_of_lines_exits_alike(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Amid a line: one line names it, and the exit code is the same for each form. Whole: 0."""
    whole = tmp_path / f"whole{suffix}"
    with can.Logger(str(whole)) as writer:
        for line in lines(stream(44, 1)):
            writer(message(line))
    assert not verb.monitor(read=whole).contact_lost
    data = whole.read_bytes()
    cut = tmp_path / f"cut{suffix}"
    for left in (4, 9, 14):
        at = data.rstrip(b"\n").rfind(b"\n", 0, len(data) // 2) + left
        cut.write_bytes(data[:at])
        capfd.readouterr()
        assert verb.monitor(read=cut).contact_lost, left  # exit code 1
        assert f"{cut}: the log is damaged and ends early: " in capfd.readouterr().err.splitlines()[-1]


# ------------------------------------------------------------------------------------------------------------ kept logs


@pytest.mark.parametrize("suffix", WRITTEN)
def test_an_old_log_is_not_written_over(tmp_path: Path, suffix: str) -> None:
    """One line, exit 2, and not a byte of the log changes."""
    log = tmp_path / f"run{suffix}"
    log.write_bytes(b"an old log")
    with serial_line(b"") as path, pytest.raises(UserError) as caught:
        verb.monitor(channel=path, log=log, duration=1.0)
    assert str(caught.value) == f"{log}: this log exists, and is not written over: delete it or give another name"
    assert log.read_bytes() == b"an old log"


@pytest.mark.parametrize("suffix", WRITTEN if case_records(0, 1) else (".asc", ".blf"))
def test_a_killed_monitor_leaves_a_log_that_can_be_read(tmp_path: Path, suffix: str) -> None:
    """kill -9 amid a run: all frames but those of the last FLUSH_S, which have come before, are there."""
    sent = lines(stream(45, 1))
    log = tmp_path / f"run{suffix}"
    with serial_line("".join(line + "\r" for line in sent).encode()) as path:
        command = subprocess.Popen([*COMMAND, "monitor", "--channel", path, "--log", log], stderr=subprocess.DEVNULL)
        end = time.monotonic() + 60.0
        while not (log.exists() and log.stat().st_size) and time.monotonic() < end:
            time.sleep(0.05)
        time.sleep(3.0 * FLUSH_S + 1.0)
        command.send_signal(signal.SIGKILL)
        command.wait(30.0)
    assert [one[:2] for one in frames_of(log)] == [(int(line[1:4], 16), bytes.fromhex(line[5:])) for line in sent]


CANDUMP_L = "({}) can0 200#C02709000080B588\n"
CSV_HEAD = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"


@pytest.mark.parametrize(
    ("suffix", "head", "line", "stamp"),
    [
        (".log", "", CANDUMP_L, "nan"),
        (".log", "", CANDUMP_L, "-inf"),
        (".log", "", CANDUMP_L, "1e400"),
        (".log", "", CANDUMP_L, "noon"),
        (".log", "", " ({})  can0  200   [8]  C0 27 09 00 00 80 B5 88\n", "nan"),
        (".csv", CSV_HEAD, "{},0x200,0,0,0,8,wCcJAACAtYg=\n", "nan"),
    ],
)
def test_a_stamp_that_is_no_time_is_left_out(suffix: str, head: str, line: str, stamp: str, tmp_path: Path) -> None:
    """Its line is counted, the first one too. A clean log has none, and one of none but such is refused."""
    log = tmp_path / f"frames{suffix}"
    stamps = ["1700000000.1", "1700000000.2", "1700000000.4", "1700000000.5"]
    for place in (None, 0, 3, 4):
        made = [*stamps]
        if place is not None:
            made.insert(place, stamp)
        log.write_text(head + "".join(map(line.format, made)), encoding="ascii")
        assert len(frames_of(log)) == 4
        assert malformed(log) == (place is not None)
    log.write_text(head + 3 * line.format(stamp), encoding="ascii")
    with pytest.raises(UserError, match=r"there is no frame in its 3 lines$"):
        FrameLog(log)


# ------------------------------------------------------------------------------------------------------- damaged lines


def malformed(path: Path) -> int:
    with FrameLog(path) as log:
        while not log.closed:
            log.recv(1.0)
        return log.malformed


def rows_of(folder: Path, form: str, sent: list[can.Message]) -> tuple[list[str], list[str]]:
    """Header and frames of a log of text, a line each; the header is all before the first frame."""
    if form == "view.log":
        return [], [screen(frame, "stamps") for frame in sent]
    if form == "gvret.csv":
        data = [",".join(f"{byte:02X}" for byte in frame.data) for frame in sent]
        rows = [f"0,{frame.arbitration_id:08X},false,Rx,0,8,{data[k]}," for k, frame in enumerate(sent)]
        return ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"], rows
    log = folder / form
    with can.Logger(str(log)) as writer:
        for frame in sent:
            writer(frame)
    rows = [row for row in log.read_text().splitlines() if "TriggerBlock" not in row or row.startswith("Begin")]
    return rows[: -len(sent)], rows[-len(sent) :]


FORMS = ("frames.asc", "frames.csv", "frames.log", "frames.trc", "view.log", "gvret.csv")


@pytest.mark.parametrize("form", FORMS)
def test_damaged_lines_are_counted_and_left_out(form: str, tmp_path: Path) -> None:
    """Of every form of text: each frame whose line is whole comes, in order. Truth: the lines that the test spoils, by
    bytes that no form has, and by cuts amid the identifier; the first and the last line are among them."""
    chance = random.Random(form)
    sent = [message(line) for line in lines(stream(46, 2))]
    for k, frame in enumerate(sent):
        frame.timestamp = 100.0 + k / 50.0
    head, rows = rows_of(tmp_path, form, sent)
    assert len(rows) == len(sent)
    path = tmp_path / f"x{form}"
    for share in (0.0, 0.02, 0.4):
        for _ in range(case_records(2, 40)):
            bad = {k for k in range(len(rows)) if chance.random() < share}
            bad |= {0, len(rows) - 1} if share else set()
            spoilt = [*rows]
            for k in bad:
                spoilt[k] = chance.choice(("\0\xff\0", "\x01" * 70_000, "#" + rows[k][:9], "z" * 40, rows[k][:12]))
            path.write_text("\n".join(head + spoilt) + "\n", encoding="latin-1")
            found = frames_of(path)
            whole = [frame for k, frame in enumerate(sent) if k not in bad]
            assert [one[:2] for one in found] == [(frame.arbitration_id, bytes(frame.data)) for frame in whole]
            assert malformed(path) == sum(1 + (len(spoilt[k]) > 65_536) for k in bad)


def test_the_view_states_the_damaged_lines(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Seven of them, and the end is no failure. A log of damage alone is refused in one line."""
    sent = [message(line) for line in lines(stream(47, 2))]
    head, rows = rows_of(tmp_path, "frames.asc", sent)
    log = tmp_path / "spoilt.asc"
    log.write_text("\n".join([*head, *("z" if k % 9 == 4 and k < 60 else row for k, row in enumerate(rows))]) + "\n")
    outcome = verb.monitor(read=log)
    assert not outcome.contact_lost and outcome.received == len(sent) - 7
    assert ", 7 malformed" in capfd.readouterr().err
    log.write_text("\n".join([*head, *("z" for _ in rows)]) + "\n")
    with pytest.raises(UserError) as caught:
        verb.monitor(read=log)
    none = f"there is no frame in its {len(rows)} lines"
    assert str(caught.value) == f"{log}: no frame log as python-can writes it: {none}"


def test_sound_lines_without_a_frame_are_none(tmp_path: Path) -> None:
    """Vector's and PEAK's programs write events and comments between frames. Truth: lines of their descriptions."""
    asc = tmp_path / "events.asc"
    asc.write_text(
        "date Thu Nov 26 10:00:00.000 am 2026\nbase hex  timestamps absolute\ninternal events logged\n"
        "// version 13.0.0\nBegin Triggerblock Thu Nov 26 10:00:00.000 am 2026\n   0.000000 Start of measurement\n"
        "   0.010000 1  200             Rx   d 8 C0 27 09 00 00 80 B5 88\n"
        "   0.015000 CAN 1 Status:chip status error active\n"
        "   0.016000 1  Statistic: D 16 R 0 XD 0 XR 0 E 0 O 0 B 0.4%\n"
        "   0.017000 SV: 2 0 1 ::Sys::Value = 81\n   0.018000 log trigger event\n"
        "   0.020000 1  200             Rx   d 8 C0 27 09 00 00 80 B5 88  Length = 244015 BitCount = 126 ID = 512\n"
        "End TriggerBlock\n"
    )
    trc = tmp_path / "events.trc"
    trc.write_text(
        ";$FILEVERSION=1.1\n;$STARTTIME=45000.5\n;\n"
        "     1)        10.0  Rx         0200  8  C0 27 09 00 00 80 B5 88\n"
        "     2)        11.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY\n; a comment\n"
        "     3)        12.0  Rx         0200  8  C0 27 09 00 00 80 B5 88\n"
    )
    for path in (asc, trc):
        assert len(frames_of(path)) == 2
        assert malformed(path) == 0


def test_a_full_disk_is_one_line() -> None:
    """Truth: /dev/full takes no byte."""
    with pytest.raises(UserError, match=r"cannot be written: No space left on device") as caught:
        writer = FrameWriter.__new__(FrameWriter)
        writer.path = Path("run.log")
        writer._writer = can.CanutilsLogWriter("/dev/full")
        writer.write(message(lines(stream(45, 1))[0]))
        writer._do(writer._flush)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------ readers that stop reading


@contextmanager
def terminal() -> Iterator[tuple[int, int]]:
    """A terminal of 40 lines whose other end nobody reads: both ends."""
    ours, its = os.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    try:
        yield ours, its
    finally:
        os.close(ours)
        os.close(its)


@pytest.mark.parametrize("number", [None, signal.SIGTERM])
def test_a_terminal_that_stops_reading_holds_nothing(number: signal.Signals | None) -> None:
    """It takes 4096 bytes, some four frames of the view. The command ends when its time is up, or at a signal."""
    sent = "".join(f"{line}\r" for line in lines(stream(41, 30)) * 6).encode()
    with serial_line(sent) as path, terminal() as (ours, its):
        duration = ["--duration", "4"] if number is None else []
        command = [*COMMAND, "monitor", "--channel", path, *duration]
        program = subprocess.Popen(command, stdin=its, stdout=its, stderr=its)
        try:
            if number is not None:
                while struct.unpack("i", fcntl.ioctl(ours, termios.FIONREAD, bytes(4)))[0] < 3500:
                    assert program.poll() is None
                    time.sleep(0.1)
                time.sleep(1.0)  # more frames than it takes
                program.send_signal(number)
            assert program.wait(20.0) == 0
        finally:
            program.kill()
            program.wait()


def test_lines_go_to_stdout_beside_a_view(tmp_path: Path) -> None:
    """With stderr a terminal: each report on stdout, none in the view. A pipe that nobody reads ends by a signal."""
    sent = "".join(f"{line}\r" for line in lines(stream(42, 20)) * 3).encode()
    with serial_line(sent) as path, terminal() as (_, its):
        reader, writer = os.pipe()
        fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
        program = subprocess.Popen(
            [*COMMAND, "monitor", "--channel", path, "--stream", "jsonl"], stdin=its, stdout=writer, stderr=its
        )
        os.close(writer)
        try:
            with os.fdopen(reader, "rb") as pipe:
                told = [json.loads(pipe.readline()) for _ in range(5)]
                time.sleep(1.5)  # it is full by now
                program.send_signal(signal.SIGTERM)
                assert program.wait(20.0) == 0
        finally:
            program.kill()
            program.wait()
    assert all({"timestamp", "node0"} == set(one) for one in told)
