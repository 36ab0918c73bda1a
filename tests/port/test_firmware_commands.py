"""The STM32F405 image with the gate, the corrected output and commands, on the board of behavioural models.

Truths: the library on the host over the samples that the sensor made; the sensor's registers; what SipHash's authors
publish; and for whatever is not a command that nothing happens.
"""

from __future__ import annotations

import math
import random
import struct
import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from firmware import AXES, MANY, QUIET_BANK_HZ, SLOW_RATE_HZ, Board, Tap, image, messages, parts, reports, status, tell
from gated import Gated
from typer.testing import CliRunner

from selfcal.base.errors import UserError
from selfcal.cli import app
from selfcal.model.file import Model
from selfcal.verbs.command import command
from selfcal.wire import command as verb
from selfcal.wire.frames import Decoder, frame_crc, load_dbc, reasons

KEY = bytes(range(16))
RATE_HZ, BANK_HZ = SLOW_RATE_HZ, 5.12
#: A report each 3 s, a corrected sample each 0.2 s.
FLAGS = f"-DBOARD_REPORT_MS=3000 -DAPP_CORRECTED_MS=200 {verb.build_flag(KEY)}"
ORDERS: dict[str, Any] = {
    "name": "orders",
    "flags": FLAGS,
    "quiet": True,
    "bank_hz": BANK_HZ,
    "rate_hz": RATE_HZ,
    "laws": ("constant", "random_walk"),
}
#: No bank sample within a test, so that time goes by fast.
IDLE: dict[str, Any] = {"name": "idle", "flags": f"-DBOARD_REPORT_MS=500 {verb.build_flag(KEY)}", "quiet": True}
SERIAL: dict[str, Any] = IDLE | {
    "name": "idle-serial",
    "flags": f"{IDLE['flags']} -DBOARD_CAN_KBITPS=0 -DBOARD_USART_BAUD=1000000",
}
RESTING, MOVING = 2, 1
RESULT, COMMAND = verb.codes("result"), verb.codes("command")
COMMAND_ID = 0x208


def new_answers(board: parts.Board, since: int) -> list[dict[str, float]]:
    """Answers among the frames heard from the `since`-th on."""
    found = []
    for message in messages(board, since):
        if message.arbitration_id == 0x209:
            decoder = Decoder()
            decoder.feed(message)
            found.append(decoder.answer)
    return found


def challenge(board: parts.Board) -> int:
    """The one that is open, or a new one: not within a second of another."""
    if board.value("app.command.paused"):
        board.run(1.0)
    since = len(board.frames)
    board.can.say(COMMAND_ID, verb.payload("challenge"))
    board.run(0.05)
    (answer,) = new_answers(board, since)
    return int(answer["challenge"])


def order(board: parts.Board, data: bytes, seconds: float = 0.05) -> list[int]:
    """Results that a command frame draws."""
    since = len(board.frames)
    board.can.say(COMMAND_ID, data)
    board.run(seconds)
    return [int(answer["result"]) for answer in new_answers(board, since) if "result" in answer]


def obey(board: parts.Board, name: str, argument: int = 0, seconds: float = 0.05) -> list[int]:
    return order(board, verb.payload(name, argument, key=KEY, challenge=challenge(board)), seconds)


# ------------------------------------------------------------------------------------------------------------ the key


def test_siphash_is_that_of_its_authors() -> None:
    """The 8-byte entry of the reference implementation's table."""
    assert verb.siphash(KEY, int.from_bytes(range(8), "little")) == 0x93F5F5799A932462


def test_key_files(tmp_path: Path) -> None:
    runner, key = CliRunner(), tmp_path / "k"
    assert runner.invoke(app, ["command", "new-key", "--key", str(key)]).exit_code == 0
    assert len(verb.read_key(key)) == 16
    assert key.stat().st_mode & 0o77 == 0
    said = runner.invoke(app, ["command", "build-flag", "--key", str(key)]).output.strip()
    low, high = (int(word.removesuffix("ULL"), 16) for word in said.removeprefix("-DAPP_COMMAND_KEY=").split(","))
    assert struct.pack("<2Q", low, high) == verb.read_key(key)
    with pytest.raises(UserError, match="cannot write the key"):
        verb.new_key(key)
    key.write_text("00")
    with pytest.raises(UserError, match="32 hexadecimal digits"):
        verb.read_key(key)


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("telemetry_period", None, "a number of ms"),
        ("telemetry_period", "99", "a number of ms"),
        ("write_offsets", None, "wants axes"),
        ("write_offsets", "gx,mx", "wants axes"),
        ("save", "now", "takes nothing"),
        ("reset", "all", "no word but forget"),
        ("tumble", None, "wants start or stop"),
        ("tumble", "again", "wants start or stop, not 'again'"),
    ],
)
def test_arguments_that_are_refused(name: str, value: str | None, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        verb.argument_of(name, value)


def test_what_the_command_line_says(tmp_path: Path) -> None:
    """One line that says what to do: no channel, no key file, no such order; --help names every order."""
    verb.new_key(tmp_path / "k")
    there = {"key_file": tmp_path / "k", "interface": "slcan"}
    with pytest.raises(UserError, match=r"to which module\? --channel names its serial port"):
        command("save", None, channel="", **there)
    with pytest.raises(UserError, match=r"no such key; --key names .*`.*selfcal command new-key --key .*none` makes"):
        command("save", None, key_file=tmp_path / "none", interface="slcan", channel="/dev/null")
    with pytest.raises(UserError, match=r"no such command: sing \(there are .*save.*new-key, build-flag\)"):
        command("sing", None, channel="/dev/null", **there)
    words = " ".join(CliRunner().invoke(app, ["command", "--help"]).output.split())
    orders = [name for name in COMMAND if name != "challenge"]
    assert all(name in words for name in (*orders, *verb.OWN_ORDERS))


def fake_frame(counter: int, item: int, value: int) -> can.Message:
    """An answer that anybody can make: its checksum needs no key."""
    identifier = load_dbc().get_message_by_name("ANSWER").frame_id
    word = value | item << 32 | counter << 38
    word |= frame_crc(identifier, word.to_bytes(8, "little")) << 52
    return can.Message(arbitration_id=identifier, data=word.to_bytes(8, "little"), is_extended_id=False)


def test_an_answer_is_called_unverified(tmp_path: Path) -> None:
    """A fake module that has no key says "done" like a real one, so the tool does not vouch for it."""
    verb.new_key(tmp_path / "k")
    with can.Bus(interface="virtual", channel="fake") as bus:

        def module() -> None:
            for counter, item, value in ((1, 0, 77), (2, 1, COMMAND["reset"] | RESULT["done"] << 8)):
                assert bus.recv(20.0) is not None
                bus.send(fake_frame(counter, item, value))

        thread = threading.Thread(target=module)
        thread.start()
        asked = ["command", "reset", "forget", "--key", str(tmp_path / "k"), "--interface", "virtual"]
        done = CliRunner().invoke(app, [*asked, "--channel", "fake"])
        thread.join()
    assert done.exit_code == 0, done.output
    assert done.output == f"reset: done ({verb.UNVERIFIED})\n"


# ----------------------------------------------------------------------------------------------------------- commands


def test_commands_are_obeyed_once() -> None:
    """Each does what it says, is answered and counted; the same frame again, and one with a bit changed, does
    nothing."""
    board = Board(image(**IDLE), seed=31)
    board.run(0.9)
    period = verb.payload("telemetry_period", 250, key=KEY, challenge=challenge(board))
    assert order(board, period) == [RESULT["done"]]
    assert board.value("app.period_ms") == 250
    assert order(board, period) == [RESULT["no_challenge"]]
    spoilt = bytearray(verb.payload("telemetry_period", 300, key=KEY, challenge=challenge(board)))
    spoilt[1] ^= 1
    assert order(board, bytes(spoilt)) == [RESULT["wrong_tag"]]
    # no challenge for a second after a wrong tag
    assert order(board, verb.payload("challenge")) == [RESULT["not_now"]]
    board.run(1.0)
    assert order(board, verb.payload("telemetry_period", 300, key=bytes(16), challenge=challenge(board))) == [
        RESULT["wrong_tag"]
    ]
    board.run(1.0)
    assert obey(board, "telemetry_period", 99) == [RESULT["out_of_range"]]
    assert obey(board, "save", 1) == [RESULT["out_of_range"]]
    assert obey(board, "reset", 2) == [RESULT["out_of_range"]]
    assert obey(board, "write_offsets", 64) == [RESULT["out_of_range"]]
    assert obey(board, "write_offsets", 1) == [RESULT["not_now"]]  # there is no report yet
    assert board.value("app.period_ms") == 250
    assert obey(board, "save", seconds=1.3) == [RESULT["done"]]
    assert board.value("app.told.state_saves") == 1
    stale = verb.payload("save", key=KEY, challenge=challenge(board))
    board.run(10.1)
    assert order(board, stale) == [RESULT["no_challenge"]]
    board.rng.stuck = True  # a random number generator that fails
    assert order(board, verb.payload("challenge")) == [RESULT["not_now"]]
    board.rng.stuck = False
    board.run(0.6)
    told = status(board)
    assert (told["command_count"], told["command_refused_count"]) == (2.0, 11.0)
    assert obey(board, "reset", seconds=0.5) == [RESULT["done"]]
    assert [cause for _, cause in board.machine.resets] == ["software"]
    board.run(1.0)
    assert status(board)["reset_cause"] == 3
    assert status(board)["state_found"] == 1
    assert board.machine.violations == board.machine.faults == []


def test_challenges_come_one_a_second() -> None:
    """Until it is used a challenge is the same one, and then there is none for what is left of the second: that one
    comes again, as a recorded command needs, takes 2^32 s."""
    board = Board(image(**IDLE), seed=39)
    board.run(0.9)
    number = challenge(board)
    for _ in range(20):
        since = len(board.frames)
        board.can.say(COMMAND_ID, verb.payload("challenge"))
        board.run(0.02)
        (answer,) = new_answers(board, since)
        assert int(answer["challenge"]) == number
    assert order(board, verb.payload("telemetry_period", 250, key=KEY, challenge=number)) == [RESULT["done"]]
    assert order(board, verb.payload("challenge")) == [RESULT["not_now"]]
    board.run(1.0)
    assert challenge(board) != number


def test_a_node_of_a_bus_has_identifiers_of_its_own() -> None:
    """Node 3, 3 * 128 above node 0: it sends nothing else, and a command to node 0 is none to it."""
    board = Board(image(**IDLE | {"name": "idle-node", "node": 3}), seed=31)
    board.run(0.9)
    for identifier, answers in ((COMMAND_ID, 0), (COMMAND_ID + 3 * 128, 1)):
        since = len(board.frames)
        board.can.say(identifier, verb.payload("challenge"))
        board.run(0.1)
        heard = [message for message in messages(board, since) if message.arbitration_id == 0x209 + 3 * 128]
        assert len(heard) == answers
    frames = messages(board)
    assert {message.arbitration_id - 3 * 128 for message in frames} == {0x200, 0x209}
    decoder = Decoder(node=3, from_start=True)
    for message in frames:
        decoder.feed(message)
    assert (decoder.statistics.received, decoder.statistics.lost) == (len(frames), 0)
    assert decoder.status["wire_version"] == 4


def test_an_answer_outlives_the_next_question() -> None:
    """A challenge that is asked for while a save is under way: both are answered."""
    board = Board(image(**IDLE), seed=31)
    board.run(0.9)
    number, since = challenge(board), len(board.frames)
    board.can.say(COMMAND_ID, verb.payload("save", key=KEY, challenge=number))
    board.machine.at(3e5, lambda: board.can.say(COMMAND_ID, verb.payload("challenge")))
    board.run(3.0)
    answers = new_answers(board, since)
    assert [answer["result"] for answer in answers if answer.get("command") == COMMAND["save"]] == [RESULT["done"]]
    assert len(answers) == 2
    assert board.value("app.told.state_saves") == 1


def test_commands_over_the_serial_line() -> None:
    """The same as SLCAN text; only whole lines of the right identifier, length and digits on an open channel."""
    board = Board(image(**SERIAL), seed=32)
    board.usart.host_baud = 1e6
    board.sensor.plug(False)  # setting it up at this rate keeps an answer waiting for 20 ms
    board.run(0.2)

    def say(line: str, seconds: float = 0.02) -> bytes:
        board.text.clear()
        board.usart.say(line.encode() + b"\r")
        board.run(seconds)
        return bytes(board.text)

    def line(data: bytes) -> str:
        return f"t2088{data.hex().upper()}"

    assert say(line(verb.payload("challenge"))) == b"\a"  # the channel is closed
    assert say("O").startswith(b"\r")
    for bad in (
        line(verb.payload("challenge"))[:-1],
        line(verb.payload("challenge")) + "0",
        "t2078" + "01" + "0" * 14,
        "t2087" + "01" + "0" * 12,
        "T00000208801" + "0" * 14,
        "t2088" + "0G" + "0" * 14,
        "r2088",
    ):
        assert say(bad).startswith(b"\a"), bad
    assert board.value("app.told.command_refused_count") == 0
    answer = say(line(verb.payload("challenge")))
    assert answer.startswith(b"z\r")
    (reply,) = [text for text in answer.split(b"\r") if text.startswith(b"t209")]
    number = struct.unpack("<I", bytes.fromhex(reply[5:13].decode()))[0]
    answer = say(line(verb.payload("telemetry_period", 200, key=KEY, challenge=number)))
    assert b"t2098" in answer
    assert board.value("app.period_ms") == 200
    assert say("L").startswith(b"\r")  # listening only
    assert say(line(verb.payload("challenge"))).startswith(b"\a")
    assert say("C") == b"\r"
    assert say("\nV\r\n\r\nO\r\n").startswith(b"V0101\r\r\r")  # of a host that ends a line with both
    assert board.machine.violations == []


@pytest.mark.parametrize(("baud", "rate_hz"), [(115_200, SLOW_RATE_HZ), (2_000_000, 163.84), (2_000_000, 819.2)])
def test_the_serial_line_loses_nothing_beside_the_sensor(baud: int, rate_hz: float) -> None:
    """Lines without a pause while the sensor's frames are exchanged, which takes 180 us of handlers in slow mode: two
    bytes at 115200 baud, and 30 us else: six at 2 Mbaud."""
    flags = f"-DBOARD_REPORT_MS=3000000 -DBOARD_GATE=0 -DBOARD_CAN_KBITPS=0 {verb.build_flag(KEY)}"
    name = f"line-{baud}-{rate_hz:g}"
    board = Board(image(name, f"{flags} -DBOARD_USART_BAUD={baud}", quiet=True, rate_hz=rate_hz), seed=5)
    board.usart.host_baud = float(baud)
    tap = Tap(board)
    board.run(1.5)
    board.usart.say(b"O\r")
    board.run(0.01)
    board.text.clear()
    trials = 40
    for _ in range(trials):
        board.usart.say(b"t2088" + b"FF" * 8 + b"\r")
        board.run(25.0 * 10.0 / baud + 1.7e-3)
    board.run(0.02)
    assert bytes(board.text).count(b"z\r") == trials
    assert board.value("line.lost") == board.usart.overruns == 0
    board.usart.host_baud = 0.8 * baud  # a host at a wrong rate
    board.usart.say(b"O\r" * 50)
    board.run(100.0 * 10.0 / baud + 0.01)
    assert board.value("line.lost") > 10  # half of them end without a stop bit
    assert board.machine.violations == []
    assert tap.wrong() == tap.misplaced(0) == 0


@pytest.mark.parametrize(
    ("baud", "corrected_ms", "bank_hz", "begun"), [(9600, 0, QUIET_BANK_HZ, 2.0), (115_200, 20, BANK_HZ, 4.0)]
)
def test_the_answer_to_a_reset_leaves_before_it(baud: int, corrected_ms: int, bank_hz: float, begun: float) -> None:
    """Behind a second of telemetry at 9600 baud, and on a line that corrected samples fill."""
    flags = f"-DBOARD_REPORT_MS=2000 -DAPP_CORRECTED_MS={corrected_ms} {verb.build_flag(KEY)}"
    flags += f" -DBOARD_CAN_KBITPS=0 -DBOARD_USART_BAUD={baud}"
    board = Board(image(f"last-word-{baud}", flags, quiet=True, bank_hz=bank_hz, laws=("constant",)), seed=35)
    board.usart.host_baud = float(baud)

    def told(what: bytes, seconds: float) -> bytes:
        board.text.clear()
        board.usart.say(f"t2088{what.hex().upper()}\r".encode())
        board.run(seconds)
        frames = [text[text.index(b"t2098") :] for text in bytes(board.text).split(b"\r") if b"t2098" in text]
        assert len(frames) == 1
        assert len(frames[0]) == 21
        return bytes.fromhex(frames[0][5:].decode())

    board.run(0.5)
    board.usart.say(b"O\r")
    board.run(begun - 0.5 + 0.05)  # a status has just begun
    number = struct.unpack("<I", told(verb.payload("challenge"), 1.3)[:4])[0]
    board.run(0.7)  # and the next one
    assert board.machine.resets == []
    answer = told(verb.payload("reset", key=KEY, challenge=number), 1.5)
    assert (answer[0], answer[1]) == (COMMAND["reset"], RESULT["done"])
    assert [cause for _, cause in board.machine.resets] == ["software"]
    assert board.machine.violations == []


def test_random_command_frames_do_nothing() -> None:
    """Random bytes, right codes with random tags, wrong lengths, remote and extended
    frames, recorded commands; a challenge is kept open as far as the module gives one."""
    trials = 100_000 if MANY > 1 else 1000
    rng = random.Random(33)
    board = Board(image(**IDLE), seed=33)
    tap = Tap(board)
    board.run(9.5)  # the gate sees rest after 17 windows
    recorded = []
    for _ in range(3):
        number = challenge(board)
        recorded.append(verb.payload("reset", key=KEY, challenge=number))
        used_up = verb.payload("telemetry_period", 1, key=KEY, challenge=number)
        assert order(board, used_up) == [RESULT["out_of_range"]]
    before = {name: board.value(name) for name in ("app.period_ms", "app.told.state_saves", "app.told.command_count")}
    passed = 0
    for trial in range(trials):
        kind = rng.randrange(6)
        code = bytes((rng.randrange(1, 6),))
        data = rng.randbytes(8) if kind == 0 else code + rng.randbytes(7) if kind < 3 else rng.choice(recorded)
        if rng.random() < 0.05:
            board.can.say(COMMAND_ID, verb.payload("challenge"))
        if kind == 4:
            board.can.say(COMMAND_ID, data[: rng.randrange(8)], length=rng.choice((-1, 8 + rng.randrange(8))))
        elif kind == 5:
            identifier = rng.choice((COMMAND_ID, rng.randrange(2**11), rng.randrange(2**29)))
            board.can.say(
                identifier, data, extended=identifier >= 2**11 or rng.random() < 0.5, remote=rng.random() < 0.5
            )
        else:
            board.can.say(COMMAND_ID, data)
        passed += 1
        if trial % 3 == 2:
            board.run(0.003)
    board.run(1.5)
    assert {name: board.value(name) for name in before} == before
    told = status(board)
    sound = not (board.machine.violations or board.machine.faults or board.machine.resets)
    looked_at = told["command_refused_count"]
    tell("random command frames", passed, passed if sound else 0, f"{looked_at:.0f} looked at, none obeyed")
    assert told["command_refused_count"] > trials / 10
    assert told["sensor_state"] == 2
    assert sound
    assert tap.wrong() == tap.misplaced(0) == 0
    board.run(1.0)
    assert obey(board, "telemetry_period", 400) == [RESULT["done"]]


def test_an_image_without_commands_hears_nothing() -> None:
    board = Board(image("quiet", "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0", quiet=True), seed=34)
    board.run(0.9)
    board.can.say(COMMAND_ID, verb.payload("challenge"))
    board.run(0.2)
    assert board.can.heard == 0
    assert board.can.fifo == []
    assert new_answers(board, 0) == []


# --------------------------------------------------------------------------------------- corrected output and offsets


def host_of(path: Path) -> Gated:
    return Gated(Model.load(path.parent / "model.yaml"), RATE_HZ, AXES, "cortex-m4f")


def test_corrected_samples_equal_the_host_s() -> None:
    """Reading less selfcal_predict() of the host over the same samples, by the test's own count of the time since the
    report's last bank interval; sd grows over 3 s without samples. The libms differ by 2e-4 sd (test_firmware_qemu.py),
    a float32 reading is rounded by 1e-5 sd: 1e-3 is left for both."""
    path = image(**ORDERS)
    board = Board(path, seed=35)
    tap = Tap(board)
    decoder = Decoder(from_start=True)
    count: dict[str, int] = {}  # bank samples that each axis's last report rests on
    heard: list[tuple[dict[str, float], int, dict[str, int]]] = []  # corrected, samples seen by then, `count` then
    done = 0
    while board.machine.now_us < 16.0e6:
        board.sensor.silent = 11.6e6 < board.machine.now_us < 14.6e6
        board.run(0.002)
        for message in messages(board, done):
            for report in decoder.feed(message):
                if report.complete:
                    count[report.axis] = int(report.value("count"))
            if "motion" in decoder.corrected:
                heard.append((decoder.corrected, len(tap.seen), dict(count)))
                decoder.corrected = {}
        done = len(board.frames)
    assert board.machine.violations == []
    assert not [at for at, _, _ in heard if 11.7e3 < at["time_ms"] < 14.5e3], "of samples that were not measured"
    host, passed = host_of(path), np.cumsum([missing + 1 for missing, _ in tap.seen])
    compared: dict[str, list[tuple[int, float, float]]] = {axis: [] for axis in AXES}  # n, time in s, sd
    worst, before = 0.0, 0
    for at, (missing, sample) in enumerate(tap.seen):
        host.feed(missing, np.array(sample, dtype=np.float32))
        n, before = host.bank.raw.count, host.bank.raw.count if host.bank.raw.count != before else -1
        if before < 0:  # no interval has ended
            before = n
            continue
        for corrected, seen, on in heard:
            for axis in (name for name in AXES if on.get(name) == n):
                # which sample was the newest is known to one: its frames took some ms
                newest = (seen - 2, seen - 1)
                elapsed = [float(passed[k] - passed[at]) / RATE_HZ for k in newest]
                errors = []
                for k, (bias, sd) in zip(newest, host.bank.raw.predict(AXES.index(axis), elapsed), strict=True):
                    value = tap.seen[k][1][AXES.index(axis)] - bias
                    errors.append(
                        max(abs(corrected[f"corrected_{axis}"] - value), abs(corrected[f"sd_{axis}"] - sd)) / sd
                    )
                worst = max(worst, min(errors))
                compared[axis].append((n, corrected["time_ms"] / 1000.0, corrected[f"sd_{axis}"]))
    print(f"\n{sum(map(len, compared.values()))} corrected readings, within {worst:.1e} sd")
    assert worst < 1e-3
    for axis, rows in compared.items():
        assert len(rows) > 20
        # those of the report before the gap: it lasts, and sd grows with time
        n = next(n for n, time_s, _ in reversed(rows) if time_s < 11.6)
        over_gap = [(time_s, sd) for m, time_s, sd in rows if m == n]
        assert over_gap[-1][0] - over_gap[0][0] > 2.0, axis
        assert all(sd <= later for (_, sd), (_, later) in pairwise(over_gap)), axis
        assert over_gap[0][1] < over_gap[-1][1], axis


def corrected(board: parts.Board, since: int) -> list[dict[str, float]]:
    """Sets of corrected samples among the frames heard from the `since`-th on."""
    decoder, found = Decoder(), []
    for message in messages(board, since):
        decoder.feed(message)
        if "motion" in decoder.corrected:
            found.append(decoder.corrected)
            decoder.corrected = {}
    return found


def test_corrected_samples_are_of_sound_samples() -> None:
    """None of a saturated reading, which is the reason. None of a reading from before the offsets were written with the
    bias of after: az by all of gravity, of which 0.6 m/s^2 is 6 sd of the noise."""
    board = Board(image(**ORDERS), seed=36)
    board.run(7.0)
    since = len(board.frames)
    for axes in (32, 0, 32, 0, 32):
        assert obey(board, "write_offsets", axes, seconds=0.5) == [RESULT["done"]]
    found = corrected(board, since)
    assert len(found) > 20
    assert max(abs(one["corrected_az"]) for one in found) < 0.6
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0], 6400.0, *rest(k)[2:])
    board.run(0.1)
    since = len(board.frames)
    board.run(1.0)
    found = corrected(board, since)[1:]  # the first may have begun before
    assert len(found) > 2
    for one in found:
        assert reasons(one) == dict.fromkeys(AXES, "bad_sample")
        assert not [name for name in one if name.startswith(("corrected", "sd"))]
    board.sensor.source = rest
    board.run(0.5)
    assert "corrected_gx" in corrected(board, since)[-1]


def test_a_retired_axis_shuts_no_gate_after_a_restart() -> None:
    """gy is thrown from rail to rail for ever and is retired, at rest and in the saved state: the gate, which comes
    before the state that is found, does not take it for motion for ever."""
    board = Board(image(**ORDERS), seed=36)
    board.run(3.0)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0], 7000.0 * math.copysign(1.0, math.sin(k * k)), *rest(k)[2:])
    board.run(16.0)
    assert status(board)["axes_retired"] == 0b10
    assert obey(board, "save", seconds=3.5) == [RESULT["done"]]
    board.power_cycle()
    board.run(9.0)
    told = status(board)
    assert (told["state_found"], told["axes_retired"], told["motion"]) == (1, 0b10, RESTING)


@pytest.mark.parametrize("moving", [False, True])
def test_a_channel_that_stands_still_has_no_corrected_samples(moving: bool) -> None:
    """gx gives one reading for ever, `stuck_limit` is 1000: after 9.8 s none of it, at rest and while the module moves;
    the others go on, and so does gx once it lives again."""
    board = Board(image(**ORDERS), seed=36)
    board.run(7.0)
    rest, shake = board.sensor.source, 400.0 if moving else 0.0
    board.sensor.source = lambda k: (-9.0, rest(k)[1] + shake * math.sin(k / 8), *rest(k)[2:])
    since = len(board.frames)
    board.run(9.4)
    before = corrected(board, since)[1:]  # the first may have begun before
    since = len(board.frames)
    board.run(1.6)
    after = [one for one in corrected(board, since)[1:] if one["time_ms"] > 7000 + 9800 + 100]
    assert status(board)["motion"] == (MOVING if moving else RESTING)
    assert status(board)["axes_retired"] == 0
    board.sensor.source = rest
    since = len(board.frames)
    board.run(1.0)
    again = corrected(board, since)[1:]
    assert min(map(len, (before, after, again))) > 2
    for one in (*before, *again):
        assert all(math.isfinite(one[f"corrected_{axis}"]) for axis in AXES)
        assert "stuck" not in reasons(one).values()
    for one in after:
        assert [axis for axis, why in reasons(one).items() if why == "stuck"] == ["gx"]
        assert [axis for axis in AXES if f"corrected_{axis}" in one and f"sd_{axis}" in one] == [*AXES[1:]]


def test_an_axis_outside_the_priors_has_no_bias() -> None:
    """ax shakes with 65 m/s^2, 130 times the largest N, and without the gate: its report has no number, so there is no
    corrected sample of it and nothing to write to the sensor; the other axes go on."""
    board = Board(image(**ORDERS | {"name": "loud", "flags": f"{FLAGS} -DBOARD_GATE=0"}), seed=36)
    rest, noise = board.sensor.source, random.Random(37)
    board.sensor.source = lambda k: (*rest(k)[:3], noise.gauss(0.0, 2000.0), *rest(k)[4:])
    board.run(7.0)
    found = {report.axis: report for report in reports(messages(board))[1] if report.complete}
    assert sorted(found) == sorted(AXES)
    numbers = ("bias_mean", "bias_sd", "h0_probability", "h1_probability")
    assert all(math.isnan(found["ax"].value(name)) for name in numbers)
    since = len(board.frames)
    assert obey(board, "write_offsets", 1 << AXES.index("ax"), seconds=1.0) == [RESULT["not_now"]]
    assert obey(board, "write_offsets", 1 << AXES.index("gx"), seconds=1.0) == [RESULT["done"]]
    samples = corrected(board, since)
    assert len(samples) > 5
    assert [axis for axis, why in reasons(status(board)).items() if why == "outside_priors"] == ["ax"]
    for sample in samples:
        assert reasons(sample)["ax"] == "outside_priors"
        assert "corrected_ax" not in sample
        assert "sd_ax" not in sample
        assert all(math.isfinite(sample[f"corrected_{axis}"]) for axis in AXES if axis != "ax")


def test_offsets_are_written_and_taken_out_of_the_estimate() -> None:
    """The bias goes to the sensor's registers, nearest step: its readings go down by that, the next report's bias too,
    with all that was learnt; the corrected output goes on, and the gate sees no motion. Kept through a restart of the
    sensor and of the module. Taken back, all is as before."""
    board = Board(image(**ORDERS), seed=36)
    tap = Tap(board)
    board.run(7.0)
    before = {report.axis: report for report in reports(messages(board))[1] if report.complete}
    assert sorted(before) == sorted(AXES)
    axes = {"gx": -9 * 0.05, "gy": 4 * 0.05, "gz": 13 * 0.05, "ax": 3 * 0.032656145}  # truths of the source
    mask = sum(1 << AXES.index(axis) for axis in axes)
    assert obey(board, "write_offsets", mask, seconds=1.6) == [RESULT["done"]]
    step = {axis: 0.0125 if axis[0] == "g" else 0.032656145 for axis in AXES}
    register = {}
    for axis in AXES:
        word = board.sensor.registers[0x1A + 2 * AXES.index(axis)]
        register[axis] = (word & 0x1FFF ^ 0x1000) - 0x1000 if axis[0] == "g" else (word & 0xFFF ^ 0x800) - 0x800
        truth = -axes.get(axis, 0.0) / step[axis]
        # the last report's bias is within 4 of its sd of the truth, and rounded to a step
        off = 0.5 + 4.0 * before[axis].value("bias_sd") / step[axis] if axis in axes else 0.0
        assert abs(register[axis] - truth) <= off, axis
    board.run(7.0)
    decoder, found = reports(messages(board))
    told, after = decoder.status, {report.axis: report for report in found if report.complete}
    for axis in AXES:
        offset = told[f"offset_{axis}"]
        assert offset == pytest.approx(register[axis] * step[axis], abs=1e-6)
        moved = after[axis].value("bias_mean") - before[axis].value("bias_mean")
        # the new mean is over about twice the samples: it moves by less than 4 sd of the old one
        assert abs(moved - offset) < 4.0 * before[axis].value("bias_sd"), axis
        assert after[axis].value("bias_sd") < 1.05 * before[axis].value("bias_sd")
        assert after[axis].value("count") > 1.5 * before[axis].value("count")
    assert told["motion"] == RESTING
    assert told["gate_alarm_count"] == 0
    # 17 windows before the gate saw rest, and around the writing 6, its time and the rest of that interval
    assert told["missing"] < 340 + 10 + RATE_HZ / BANK_HZ
    level = np.mean([sample for _, _, sample in board.sensor.taken[-400:]], axis=0)
    assert np.all(np.abs(level[:3]) < 0.25 / 0.05 * 4 / math.sqrt(12) + 4 * 18 / 20)
    assert abs(level[1]) < 4.0 + 4 * 18 / 20
    # the sensor forgets at a reset; the driver tells it again
    board.sensor.power_on()
    board.run(3.0)
    assert board.sensor.registers[0x1C] & 0x1FFF == register["gy"] & 0x1FFF
    # a reset that it misses is noticed, by a mark that should have gone: nothing is added twice
    board.sensor.reset_open, board.sensor.deaf, board.sensor.silent = True, 1, True
    board.run(0.3)
    board.sensor.silent = False
    board.run(3.0)
    assert board.sensor.deaf == 0
    assert status(board)["sensor_fault"] == 4
    assert board.sensor.registers[0x1C] & 0x1FFF == register["gy"] & 0x1FFF
    board.sensor.reset_open = False
    # so does a saved state after a power cut
    assert obey(board, "save", seconds=3.5) == [RESULT["done"]]
    board.power_cycle()
    board.run(2.0)
    assert board.value("app.told.state_found") == 1
    assert board.sensor.registers[0x1C] & 0x1FFF == register["gy"] & 0x1FFF
    board.run(3.0)
    assert obey(board, "write_offsets", 0, seconds=3.0) == [RESULT["done"]]
    assert {board.sensor.registers[address] for address in range(0x1A, 0x26, 2)} == {0}
    board.run(3.1)
    assert status(board)["offset_gy"] == 0.0
    assert tap.wrong() == 0
    assert board.machine.violations == board.machine.faults == []


def test_offsets_beside_the_sensors_own() -> None:
    """XGYRO_OFF has +40 of the sensor's own, as autonull leaves it: less may be added, down to 0, and a saved state
    brings it back although the driver does not know the 40 yet. What is forgotten stays forgotten."""
    board = Board(image(**ORDERS), seed=38)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0] + 9.0 + 4.0 - 10.0, *rest(k)[1:])  # 4 LSB of 0.05 with the 10 of the 40
    board.sensor.factory[0x1A] = 40
    board.sensor.power_on()
    board.run(7.0)
    assert obey(board, "write_offsets", 1, seconds=1.6) == [RESULT["done"]]
    register = board.sensor.registers[0x1A]
    assert 0 < register < 40  # about 16 less
    assert obey(board, "save", seconds=3.5) == [RESULT["done"]]
    board.power_cycle()
    board.run(2.0)
    assert board.value("app.told.state_found") == 1
    assert board.sensor.registers[0x1A] == register
    board.run(3.0)
    assert status(board)["offset_gx"] == pytest.approx((register - 40) * 0.0125, abs=1e-6)
    assert obey(board, "reset", 1, seconds=3.5) == [RESULT["done"]]
    assert board.value("app.told.state_saves") == 2
    learnt = board.value("app.imu.bank.counters.samples")
    board.power_cycle()
    board.run(1.0)
    assert board.value("app.told.state_found") == 1
    assert board.value("app.imu.bank.counters.samples") < learnt + 100
    assert board.sensor.registers[0x1A] == register
    assert board.machine.violations == board.machine.faults == []


def test_offsets_that_cannot_be_written() -> None:
    """A positive bias of x would need a negative XGYRO_OFF, with which the part loses sign bits: refused. Registers
    that do not read back: the sensor is restarted with what it had. While moving: not now."""
    board = Board(image(**ORDERS), seed=37)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0] + 30.0, *rest(k)[1:])
    board.run(7.0)
    assert obey(board, "write_offsets", 1, seconds=1.6) == [RESULT["failed"]]
    assert board.sensor.registers[0x1A] == 0
    board.sensor.writes_fail = True
    assert obey(board, "write_offsets", 2, seconds=1.6) == [RESULT["failed"]]
    board.sensor.writes_fail = False
    board.run(2.0)
    told = status(board)
    assert (told["sensor_state"], told["sensor_fault"]) == (2, 2)
    assert told["offset_gy"] == 0.0
    board.sensor.source = lambda k: (rest(k)[0] + (900.0 if k % 20 < 10 else 0.0), *rest(k)[1:])
    board.run(3.0)
    assert obey(board, "write_offsets", 2, seconds=1.6) == [RESULT["not_now"]]
    board.sensor.source = rest
    board.run(4.0)
    board.sensor.plug(False)
    board.run(1.0)
    assert obey(board, "write_offsets", 2, seconds=1.6) == [RESULT["not_now"]]
    assert board.machine.violations == []


def test_offsets_of_another_sensor() -> None:
    """What was taken off one sensor, and saved, would leave another with a negative XGYRO_OFF: it does not start, until
    all is taken back."""
    board = Board(image(**ORDERS), seed=38)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0] + 3.0, *rest(k)[1:])
    board.sensor.factory[0x1A] = 40
    board.sensor.power_on()
    board.run(7.0)
    assert obey(board, "write_offsets", 1, seconds=1.6) == [RESULT["done"]]
    assert obey(board, "save", seconds=3.5) == [RESULT["done"]]
    board.sensor.factory[0x1A] = 0
    board.power_cycle()
    board.run(4.0)
    told = status(board)
    assert told["sensor_fault"] == 2
    assert told["offset_gx"] < 0.0
    assert told["samples"] == board.value("app.imu.bank.counters.samples")
    assert obey(board, "write_offsets", 0, seconds=1.6) == [RESULT["done"]]
    board.run(4.0)
    told = status(board)
    assert (told["sensor_state"], told["offset_gx"]) == (2, 0.0)


def test_time_before_the_first_sample_of_a_restored_bank() -> None:
    """The sensor comes 20 s after a start with saved state: so long a gap, beside the time for which the module may
    have been off."""
    board = Board(image(**ORDERS), seed=36)
    board.run(4.0)
    assert obey(board, "save", seconds=3.5) == [RESULT["done"]]
    board.power_cycle()
    before = board.machine.now_us
    board.sensor.plug(False)
    board.run(1.0)
    known = board.value("app.imu.bank.counters.missing")
    board.run(9.0)
    assert obey(board, "save", seconds=3.5) == [RESULT["done"]]  # what has passed so far is in it
    kept = board.value("app.imu.bank.counters.missing") - known
    assert abs(kept - 1e-6 * (board.machine.now_us - before) * RATE_HZ) < 4.0 * RATE_HZ
    board.run(10.0)
    board.sensor.plug(True)
    tap = Tap(board)
    while not tap.seen:
        board.run(0.1)
    passed = 1e-6 * (board.machine.now_us - before) * RATE_HZ
    missing = board.value("app.imu.bank.counters.missing") - known
    assert abs(missing - passed) < 0.2 * RATE_HZ + RATE_HZ / BANK_HZ  # a look, a bank interval
