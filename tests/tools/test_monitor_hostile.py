"""`selfcal monitor` where module, line, log or user end badly: hostile frames, silence, ports that go, signals.

Truth: the frames that tests/lib/telemetry_stream.c made, and what was then done to them.
"""

from __future__ import annotations

import json
import math
import os
import pty
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
import zlib
from pathlib import Path

import can
import numpy as np
import pytest
from rich.console import Console
from test_wire import with_bits

from selfcal.base.errors import UserError
from selfcal.logs.framelog import LONGEST_LINE
from selfcal.verbs.monitor import monitor
from selfcal.wire.frames import AxisReport, Decoder, Link, load_dbc, open_bus
from selfcal.wire.live import Contact, View, most_probable

from conftest import needs_multicast
from wire_stream import lines, message, serial_line, stream

COMMAND = (sys.executable, "-m", "selfcal.cli", "monitor")
SHOW_CURSOR, HIDE_CURSOR = b"\x1b[?25h", b"\x1b[?25l"


def text_of(sent_lines: list[str]) -> bytes:
    return "".join(line + "\r" for line in sent_lines).encode()


def shown(view: View, width: int = 220) -> str:
    console = Console(width=width, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    console.print(view.renderable())
    return console.export_text()


def pattern(value: float) -> int:
    """The bits of a float32."""
    return int(struct.unpack("<I", struct.pack("<f", value))[0])


# -------------------------------------------------------------------------------------------------------------- frames


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 2e8, 3.4e38, -1.0], ids=str)
def test_hostile_values_with_a_right_checksum_do_not_end_the_view(value: float) -> None:
    """Every float of every message, one after the other: refused, or shown; never an error, never a bar out of bounds.

    NaN is what a module sends where the priors leave nothing; it has no infinity but for an evidence, and no
    probability beyond 0 to 1.
    """
    sent = lines(stream(31, 1))
    base = {int(line[1:4], 16): line for line in sent}
    refused = 0
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        for definition in load_dbc().messages:
            for entry in definition.signals:
                if not entry.is_float or definition.frame_id not in base or not entry.multiplexer_ids:
                    continue
                decoder = Decoder()
                view = View(decoder, Link(bus), "test", contact=Contact())
                hostile = with_bits(
                    base[definition.frame_id],
                    value=(0, 32, pattern(value)),
                    item=(32, 6, entry.multiplexer_ids[0]),
                    counter=(38, 6, 5),
                )
                for frame in (hostile, *map(message, sent)):
                    view.show(decoder.feed(frame))
                    if frame is hostile:
                        assert len(shown(view)) < 20_000
                assert len(shown(view)) < 20_000
                axis = definition.name != "STATUS"
                probability = entry.name.endswith("probability")
                possible = (
                    (math.isnan(value) and axis)
                    or (math.isfinite(value) and not (probability and not 0.0 <= value <= 1.0))
                    or (value == -math.inf and entry.name == "ln_evidence")
                )
                refused += not possible
                alone = Decoder()
                alone.feed(hostile)
                assert (alone.statistics.received, alone.statistics.refused) == (int(possible), int(not possible))
    assert refused > 0


@needs_multicast
def test_junk_on_a_udp_bus_does_not_end_it() -> None:
    """Datagrams that are no frames, between frames: counted, and the frames still come."""
    sent = lines(stream(21, 2))
    group, port = "239.74.163.2", 43987
    generator = np.random.default_rng(1)

    def play() -> None:
        time.sleep(1.0)
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as junk,
            can.Bus(interface="udp_multicast", channel=group, port=port, hop_limit=0) as bus,
        ):
            junk.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for line in sent:
                junk.sendto(generator.bytes(30), (group, port))
                bus.send(message(line))
                time.sleep(0.001)

    thread = threading.Thread(target=play)
    thread.start()
    decoder = Decoder()
    with open_bus("udp_multicast", group, port=port) as link:
        end = time.monotonic() + 5.0
        while time.monotonic() < end and decoder.statistics.received < len(sent):
            frame = link.recv(0.2)
            if frame is not None:
                decoder.feed(frame)
        thread.join()
        assert not link.closed
        assert link.malformed > 0.9 * len(sent)  # a few of 30 random bytes are a msgpack number and the like
    assert decoder.statistics.received == len(sent)


def test_a_line_without_an_end_takes_no_memory() -> None:
    """200 000 bytes without a carriage return: dropped in pieces, and the frames behind it come."""
    sent = lines(stream(21, 2))
    with (
        serial_line(b"t" * 200_000 + b"\r" + text_of(sent)) as path,
        open_bus("slcan", path, sleep_after_open=0.0) as link,
    ):
        decoder = Decoder()
        longest = 0
        end = time.monotonic() + 60.0
        while time.monotonic() < end and decoder.statistics.received < len(sent):
            frame = link.recv(0.2)
            longest = max(longest, len(link.bus._buffer))  # type: ignore[attr-defined]
            if frame is not None:
                decoder.feed(frame)
        assert longest <= LONGEST_LINE
        assert link.malformed > 0
    assert decoder.statistics.received == len(sent)


# ------------------------------------------------------------------------------------------------- most probable law


def test_no_law_is_most_probable_until_all_probabilities_came() -> None:
    """Random walk lost, 0.437 and 0 there: it may have had 0.563."""
    values = {"hypotheses": 3.0, "h0_probability": 0.0, "h2_probability": 0.437}
    report = AxisReport("gx", 1.0, False, values)
    assert most_probable(report) is None
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(Decoder(), Link(bus), "test")
        view.show([report])
        assert "not all probabilities came" in shown(view)
        assert "N ? [" not in shown(view)
    whole = AxisReport("gx", 1.0, False, values | {"h1_probability": 0.563})
    assert most_probable(whole) == 1
    # one of them is no number
    assert most_probable(AxisReport("gx", 1.0, True, values | {"h1_probability": math.nan})) is None
    # how many there are did not arrive either
    del values["hypotheses"]
    assert most_probable(AxisReport("gx", 1.0, False, values | {"h1_probability": 0.563})) is None


def test_a_lost_probability_frame_in_the_stream() -> None:
    """Of each hypothesis in turn, through the decoder."""
    sent = stream(23, 1)
    (gx,) = (one for one in sent if one.message == "GX")
    for k in range(3):
        decoder = Decoder()
        lost = [line for line in gx.lines if int(line[1:4], 16) == 0x220 + k and _item(line) == 0]
        assert len(lost) == 1
        kept = [line for line in lines(sent) if line not in lost]
        reports = [report for line in kept for report in decoder.feed(message(line))]
        (report,) = (one for one in reports if one.axis == "gx")
        assert most_probable(report) is None


def _item(line: str) -> int:
    return int.from_bytes(bytes.fromhex(line[5:]), "little") >> 32 & 0x3F


# ------------------------------------------------------------------------------------------------------------- silence


def test_contact_is_lost_after_3_s_or_three_times_the_longest_interval() -> None:
    now = [0.0]
    contact = Contact(lambda: now[0])
    assert not contact.lost
    for at in (1.0, 1.1, 1.2):
        now[0] = at
        contact.heard(in_a_row=True, paced=True)
    now[0] = 4.1
    assert not contact.lost
    now[0] = 4.3
    assert contact.lost
    now[0] = 11.2  # the module speaks every 10 s: from here on 30 s
    contact.heard(in_a_row=True, paced=True)
    assert not contact.lost
    now[0] = 41.1
    assert not contact.lost
    now[0] = 41.3
    assert contact.lost
    now[0] = 1000.0  # frames were lost in this silence: it says nothing of how often the module speaks
    contact.heard(in_a_row=False, paced=True)
    now[0] = 1031.0
    assert contact.lost


def test_a_dead_module_is_not_shown_as_running() -> None:
    """Age goes on by the host's clock."""
    now = [100.0]
    decoder = Decoder()
    decoder.status["state"] = 1.0
    decoder.time_ms = 60_000
    contact = Contact(lambda: now[0])
    with can.Bus(interface="virtual", channel="selfcal-view") as bus:
        view = View(decoder, Link(bus), "test", contact=contact)
        contact.heard(in_a_row=True, paced=True)
        view.show([AxisReport("gx", 60.0, True, {"count": 60.0})])
        assert "running" in shown(view)
        assert " 0 s" in shown(view)
        now[0] = 107.0
        assert "running" not in shown(view)
        assert "lost contact: no word for 7 s" in shown(view)
        assert " 7 s" in shown(view).splitlines()[-2]
        contact.heard(in_a_row=False, paced=True)
        assert "running" in shown(view)


def test_a_module_is_waited_for_until_its_second_status() -> None:
    """One that reports every 10 s is silent between its first report and the second, and healthy."""
    now = [0.0]
    decoder = Decoder()
    decoder.status["state"] = 1.0
    contact = Contact(lambda: now[0])
    with can.Bus(interface="virtual", channel="selfcal-waiting") as bus:
        view = View(decoder, Link(bus), "test", contact=contact)
        for at in (0.5, 0.6):
            now[0] = at
            contact.heard(in_a_row=True, paced=False)
        now[0] = 7.6
        assert not contact.lost
        assert "waiting: no word for 7 s" in shown(view)
        now[0] = 12.7  # no module is silent for so long
        assert "lost contact: no word for 12 s" in shown(view)
        now[0] = 10.6
        contact.heard(in_a_row=True, paced=True)
        now[0] = 40.5  # the interval of 10 s is known
        assert "running" in shown(view)
        now[0] = 40.7
        assert contact.lost


def test_a_module_between_its_first_two_reports_is_no_loss() -> None:
    """The exit code says the same as the view: one report, 6 s of silence."""
    with serial_line(text_of(lines(stream(21, 3))[:300])) as path:
        done = subprocess.run(
            [*COMMAND, "--channel", path, "--duration", "6"], capture_output=True, text=True, timeout=60, check=False
        )
    assert done.returncode == 0, done.stderr
    assert "contact lost" not in done.stderr


def test_a_module_that_falls_silent_is_told_by_the_exit_code() -> None:
    """The pseudo-terminal stays; nobody writes to it any more."""
    with serial_line(text_of(lines(stream(21, 3))[:300])) as path:  # the last status would say that it has finished
        done = subprocess.run(
            [*COMMAND, "--channel", path, "--duration", "14"], capture_output=True, text=True, timeout=60, check=False
        )
    assert done.returncode == 1
    assert "contact lost, no word for" in done.stderr


def test_a_port_that_vanishes_is_taken_up_again(tmp_path: Path) -> None:
    """As an adapter that is pulled and plugged: the same name, another pseudo-terminal behind it."""
    sent = lines(stream(21, 3))
    port = tmp_path / "ttyACM0"
    outcome = []

    def watch() -> None:
        outcome.append(monitor(channel=str(port), duration=9.0))

    master, slave = os.openpty()
    tty.setraw(slave)
    port.symlink_to(os.ttyname(slave))
    watcher = threading.Thread(target=watch)
    watcher.start()
    _await(master, b"O\r")
    os.write(master, text_of(sent))
    time.sleep(1.0)
    os.close(slave)
    os.close(master)
    port.unlink()
    time.sleep(1.5)
    master, slave = os.openpty()
    tty.setraw(slave)
    port.symlink_to(os.ttyname(slave))
    _await(master, b"O\r")
    os.write(master, text_of(sent))
    watcher.join()
    os.close(slave)
    os.close(master)
    # up to two frames go until the counter is found again
    assert 2 * len(sent) - 2 <= outcome[0].received == 2 * len(sent) - outcome[0].refused


def _await(master: int, wanted: bytes) -> None:
    heard = b""
    while wanted not in heard:
        heard += os.read(master, 64)


# ---------------------------------------------------------------------------------------------------------------- logs


def test_a_log_is_read_back_as_it_came(tmp_path: Path) -> None:
    """What --log keeps, in each of its formats, gives the same counts, the same document and a picture."""
    sent = lines(stream(21, 3))
    with serial_line(text_of(sent)) as path:
        live = monitor(channel=path, log=tmp_path / "frames.asc", duration=3.0, json=tmp_path / "live.json")
    assert live.received == len(sent)
    truth = {one.message.lower(): one.truth for one in stream(21, 3) if one.message != "STATUS"}
    for suffix in (".asc", ".blf", ".csv", ".log", ".trc"):
        log = tmp_path / f"frames{suffix}"
        if suffix != ".asc":
            with can.LogReader(str(tmp_path / "frames.asc")) as reader, can.Logger(str(log)) as logger:
                for frame in reader:
                    logger(frame)
        again = monitor(read=log, json=tmp_path / "read.json")
        assert (again.received, again.lost, again.refused) == (len(sent), 0, 0)
        assert not again.contact_lost
        documents = [json.loads((tmp_path / name).read_text()) for name in ("live.json", "read.json")]
        assert documents[0]["axes"] == documents[1]["axes"]
        assert documents[1]["schema"] == "selfcal.identify/1"
        assert documents[1]["recording"]["path"] == str(log)
    assert list(documents[1]["axes"]) == ["gx", "gy", "gz", "ax", "ay", "az"]
    for axis, found in documents[1]["axes"].items():
        assert found["hypotheses"]["h0"] == pytest.approx(truth[axis]["h0_probability"], abs=1e-7)
        assert found["parameters"]["h1"]["p2"]["median"] == truth[axis]["h1_p2_median"]
        assert found["adequate"] is None
    monitor(read=log, plot=tmp_path / "read.png")
    assert (tmp_path / "read.png").read_bytes().startswith(b"\x89PNG")


def test_a_log_is_played_at_the_speed_asked_for(tmp_path: Path) -> None:
    """Frames 10 ms apart, at five times the speed."""
    sent = lines(stream(21, 2))
    with can.Logger(str(tmp_path / "frames.log")) as logger:
        for place, line in enumerate(sent):
            frame = message(line)
            frame.timestamp = 1000.0 + 0.01 * place
            logger(frame)
    begun = time.monotonic()
    monitor(read=tmp_path / "frames.log", speed=5.0)
    assert 0.01 * len(sent) / 5.0 <= time.monotonic() - begun < 0.01 * len(sent) / 5.0 + 2.0
    begun = time.monotonic()
    monitor(read=tmp_path / "frames.log")
    assert time.monotonic() - begun < 1.0


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".log", ".trc"])
def test_damaged_logs_end_in_one_line(tmp_path: Path, suffix: str) -> None:
    """100 mutations each: bytes changed, cut off, doubled. What is left is shown, or one line says why not."""
    whole = tmp_path / f"whole{suffix}"
    with can.Logger(str(whole)) as logger:
        for place, line in enumerate(lines(stream(21, 1))):
            frame = message(line)
            frame.timestamp = 1000.0 + 0.01 * place
            logger(frame)
    text = whole.read_bytes()
    generator = np.random.default_rng(7)
    shorter = 0
    for _ in range(100):
        damaged = bytearray(text)
        for at in generator.integers(0, len(text), generator.integers(1, 6)):
            damaged[at] = generator.integers(0, 256)
        if generator.random() < 0.3:
            del damaged[generator.integers(0, len(damaged)) :]
        (tmp_path / f"damaged{suffix}").write_bytes(damaged)
        try:
            outcome = monitor(read=tmp_path / f"damaged{suffix}", duration=20.0)
        except UserError as error:
            assert "\n" not in str(error)
            shorter += 1
        else:
            shorter += outcome.received < len(lines(stream(21, 1)))
    assert shorter > 10


def blf(*objects: tuple[int, int, bytes], packed: bytes | None = None) -> bytes:
    """A BLF file of objects (size told, kind, body), or of one container of `packed` bytes."""
    head = struct.pack("<4sL", b"LOGG", 144).ljust(144, b"\0")
    if packed is not None:
        objects = ((0, 10, struct.pack("<H14x", 2) + packed),)
    parts = [
        struct.pack("<4sHHLL", b"LOBJ", 16, 1, size or 16 + len(body), kind) + body for size, kind, body in objects
    ]
    return head + b"".join(parts)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (blf(packed=zlib.compress(bytes(1 << 30), 9)), "unpacks to more than 4 MB"),
        (
            blf(packed=zlib.compress(struct.pack("<4sHHLL", b"LOBJ", 32, 1, 0, 99).ljust(64, b"\0"))),
            "an object of 0 bytes",
        ),
        (blf(packed=zlib.compress(struct.pack("<4sHHLL", b"LOBJ", 32, 1, 2**32 - 1, 1).ljust(64))), "4294967295 bytes"),
        (blf((2**32 - 1, 10, b"")), "no frame"),
        (blf()[:20], "no frame log"),
        (struct.pack("<4sL", b"LOGG", 2**32 - 1), "no frame log"),
        (b"", "no frame log"),
    ],
    ids=["bomb", "no size", "huge inner size", "huge size", "cut header", "huge header", "empty"],
)
def test_a_hostile_log_takes_no_memory_and_no_time(tmp_path: Path, content: bytes, complaint: str) -> None:
    """In a process that may have 1 GB: one line, exit code 2."""
    (tmp_path / "hostile.blf").write_bytes(content)
    limit = ["prlimit", f"--as={1 << 30}", *COMMAND, "--read", str(tmp_path / "hostile.blf")]
    done = subprocess.run(limit, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2, done.stderr
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


# ------------------------------------------------------------------------------------------------------------- signals


@pytest.mark.parametrize(
    ("number", "delay"),
    [(signal.SIGINT, 0.3), (signal.SIGTERM, 0.7), (signal.SIGHUP, 0.0)],
)
def test_signals_end_it_with_the_cursor_back_and_a_log_that_can_be_read(
    tmp_path: Path, number: int, delay: float
) -> None:
    """Amid the frames, on a terminal of its own."""
    sent = lines(stream(21, 40))
    log = tmp_path / "frames.blf"
    with serial_line(text_of(sent)) as path:
        pid, terminal = pty.fork()
        if pid == 0:
            os.execv(COMMAND[0], [*COMMAND, "--channel", path, "--log", str(log)])
        drawn = b""
        signalled = None
        end = time.monotonic() + 60.0
        while time.monotonic() < end:
            if select.select([terminal], [], [], 0.05)[0]:
                try:
                    drawn += os.read(terminal, 65536)
                except OSError:  # the terminal's other end is closed
                    break
            if signalled is None and b"module time" in drawn:
                signalled = time.monotonic() + delay
            if signalled is not None and time.monotonic() >= signalled:
                os.kill(pid, number)
                signalled = math.inf
        os.close(terminal)
        if signalled != math.inf or time.monotonic() >= end:
            os.kill(pid, signal.SIGKILL)  # it did not end: the status says so
        status = os.waitpid(pid, 0)[1]
    assert os.WIFEXITED(status), status
    assert os.WEXITSTATUS(status) == 0
    assert drawn.rfind(SHOW_CURSOR) > drawn.rfind(HIDE_CURSOR) >= 0
    assert b"Traceback" not in drawn
    assert b"frames: " in drawn
    with can.LogReader(str(log)) as reader:
        frames = [(frame.arbitration_id, bytes(frame.data)) for frame in reader]
    assert frames == [(int(line[1:4], 16), bytes.fromhex(line[5:])) for line in sent[: len(frames)]]


def test_a_broken_pipe_ends_quietly(tmp_path: Path) -> None:
    """The reader of stderr has gone: no traceback on the way out, which stdout would show."""
    with serial_line(text_of(lines(stream(21, 3)))) as path:
        reading, writing = os.pipe()
        command = [*COMMAND, "--channel", path, "--duration", "3"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=writing, text=True)
        os.close(writing)
        os.close(reading)
        said, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert said == ""
