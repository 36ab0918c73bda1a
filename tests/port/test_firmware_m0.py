"""The nRF51822 image, unmodified, on a board of behavioural models (host_sim/parts/nrf51.py): samples and their places,
telemetry, commands, offsets, resets. Its saved state: test_firmware_faults.py.

Truths: the samples that the sensor's model made; the sensor's registers; the host's decoder; the codes of selfcal.dbc.
"""

from __future__ import annotations

import math
import subprocess
from pathlib import Path

import pytest
import yaml
from firmware import (
    MANY,
    QUIET_BANK_HZ,
    QUIET_RATE_HZ,
    ROOT,
    SLOW_RATE_HZ,
    NrfBoard,
    Tap,
    image,
    messages,
    parts,
    reports,
    set_up,
    status,
    tell,
)
from unicorn import UC_HOOK_CODE, Uc

from selfcal.model.file import Model
from selfcal.verbs.codegen import codegen
from selfcal.wire import command as verb
from selfcal.wire.frames import Decoder

KEY = bytes(range(16))
GATE_OFF = "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0"
RESULT = verb.codes("result")
POWER_ON, SOFTWARE, WATCHDOG, FAULT = 1, 3, 4, 5
ABSENT, FAILED = 1, 3  # sensor_fault, sensor_state


def board(name: str = "plain", flags: str = GATE_OFF, **options: object) -> parts.NrfBoard:
    """A board of the quiet image, its channel open."""
    made = NrfBoard(image(f"m0-{name}", flags, True, target="cortex-m0"), **options)
    made.run(0.1)
    made.usart.say(b"O\r")
    return made


def well(made: parts.NrfBoard) -> bool:
    """No rule of a part broken, no fault, no reset."""
    machine = made.machine
    return not (machine.violations or machine.faults or machine.resets)


def test_samples_and_telemetry() -> None:
    """Every sample of the sensor reaches the library once, unchanged and in its place; whole statuses arrive."""
    made = board(seed=3)
    tap = Tap(made)
    made.run(4.0)
    assert well(made)
    assert len(tap.pushed) > 560
    assert tap.wrong() == 0
    assert tap.misplaced(0) == 0
    assert sum(tap.skips) == 0
    decoder, _ = reports(messages(made))
    assert decoder.statistics.lost == decoder.statistics.damaged == decoder.statistics.refused == 0
    told = decoder.status
    assert (told["reset_cause"], told["clock"], told["sensor_state"]) == (POWER_ON, 1, 2)
    assert told["state_found"] == 0


def test_a_status_does_not_wait_for_a_report() -> None:
    """A report of six axes takes this core minutes and comes every ten: a sensor that is not there is told within ten
    seconds all the same."""
    made = board("alone", "-DBOARD_GATE=0", seed=3)
    made.sensor.plug(False)
    made.run(10.5)
    assert well(made)
    decoder, _ = reports(messages(made))
    assert decoder.status["sensor_state"] == FAILED
    assert decoder.status["sensor_fault"] == ABSENT
    assert decoder.statistics.lost == decoder.statistics.damaged == 0
    heard = len(made.frames)
    made.run(10.0)
    assert len(made.frames) == 2 * heard


def test_samples_keep_their_places_over_a_save() -> None:
    """The flash holds the processor up, 22 ms a page: what is not taken meanwhile is missing, and nothing is put where
    it does not belong. Time goes on: the status's time is the board's."""
    made = board("saving", f"{GATE_OFF} -DBOARD_SAVE_PERIOD_S=2U", seed=4)
    tap = Tap(made)
    made.run(6.5)
    assert made.value("app.told.state_saves") == 2
    assert well(made)
    assert tap.wrong() == 0
    assert tap.misplaced(0) == 0
    longest = max(tap.skips)
    print(f"\na save costs {longest} samples of {QUIET_RATE_HZ} a second")
    assert longest < 2.0 * QUIET_RATE_HZ  # port.h: 2 s
    us, data = next((us, data) for us, (kind, data) in reversed(made.frames) if kind == 0x200 and data[4] & 0x3F == 0)
    assert int.from_bytes(data[:4], "little") == pytest.approx(us / 1e3, abs=50.0)


def test_full_rate_queue() -> None:
    """819.2 Hz with the gate on the 16 MHz part: how many samples wait at most, of the 64 there is room for; none is
    lost. SELFCAL_CAMPAIGN: 20 s, so that the filters run over a batch of bank samples as well."""
    made = NrfBoard(image("m0-full", "-DBOARD_REPORT_MS=3000000", target="cortex-m0"), seed=5)
    tap = Tap(made)
    waiting = 0

    def look(uc: Uc, address: int, size: int, data: object) -> None:
        nonlocal waiting
        waiting = max(waiting, made.value("sensor.head") - made.value("sensor.tail"))

    take = made.machine.symbols["sensor_read"] & ~1
    made.machine.uc.hook_add(UC_HOOK_CODE, look, None, take, take)
    made.run(20.0 if MANY > 1 else 1.3)
    seen = made.value("sensor.common.counters.samples")
    lost = sum(missing for missing, _ in tap.seen) + made.value("sensor.common.counters.overruns")
    tell("819.2 Hz, Cortex-M0 at 16 MHz", seen, seen - lost, f"samples; {waiting} wait at most")
    assert well(made)
    assert seen > 700
    assert lost == 0
    assert tap.wrong() == 0
    assert waiting < 64


# ----------------------------------------------------------------------------------------------------------- commands

ORDERS = f"{GATE_OFF} {verb.build_flag(KEY)}"


def say(made: parts.NrfBoard, data: bytes, seconds: float = 3.0) -> dict[str, float]:
    """A command frame by SLCAN; the answer it draws, by name, within that time: telemetry goes first."""
    since = len(made.frames)
    made.usart.say(b"t2088" + data.hex().upper().encode() + b"\r")
    end = made.machine.now_us + seconds * 1e6
    while made.machine.now_us < end:
        made.run(0.05)
        for message in messages(made, since):
            if message.arbitration_id == 0x209:
                decoder = Decoder()
                decoder.feed(message)
                return decoder.answer
    return {}


def challenge(made: parts.NrfBoard) -> int:
    """The one that is open, or a new one: not within a second of another."""
    if made.value("app.command.paused"):
        made.run(1.0)
    return int(say(made, verb.payload("challenge"))["challenge"])


def obey(made: parts.NrfBoard, name: str, argument: int = 0, seconds: float = 3.0) -> int:
    data = verb.payload(name, argument, key=KEY, challenge=challenge(made))
    return int(say(made, data, seconds)["result"])


def test_commands() -> None:
    """A save, telemetry's period, a wrong tag, no challenge, no random numbers, a restart that says why it was one."""
    made = board("orders", ORDERS, seed=6)
    made.run(1.0)
    assert obey(made, "save") == RESULT["done"]
    assert made.value("app.told.state_saves") == 1
    assert obey(made, "telemetry_period", 250) == RESULT["done"]
    assert made.value("app.period_ms") == 250
    spent = verb.payload("telemetry_period", 300, key=KEY, challenge=0)
    assert say(made, spent)["result"] == RESULT["no_challenge"]
    spoilt = verb.payload("save", key=bytes(16), challenge=challenge(made))
    assert say(made, spoilt)["result"] == RESULT["wrong_tag"]
    made.run(1.1)
    made.rng.dead = True
    assert say(made, verb.payload("challenge"))["result"] == RESULT["not_now"]
    made.rng.dead = False
    assert well(made)
    assert obey(made, "reset") == RESULT["done"]
    made.run(1.0)
    assert [cause for _, cause in made.machine.resets] == ["software"]
    made.usart.say(b"O\r")
    made.run(1.2)
    told = status(made)
    assert (told["reset_cause"], told["state_found"]) == (SOFTWARE, 1)


def test_offsets_are_written_and_kept() -> None:
    """write_offsets: the sensor's register holds minus the bias, to its step and the bias's sd; a module that
    starts from the state saved writes it anew into a sensor that was reset."""
    elf = image("m0-offsets", ORDERS.replace("500", "2000"), True, 5.12, ("constant",), "cortex-m0")
    made = NrfBoard(elf, seed=7)
    made.run(0.1)
    made.usart.say(b"O\r")
    while made.value("app.report_number") < 2 or made.value("app.imu.computing"):
        made.run(0.1)
    assert obey(made, "write_offsets", 0b10, 60.0) == RESULT["done"]
    register = made.sensor.registers[0x1C]  # YGYRO_OFF
    written = (register & 0xFFF) - (register & 0x1000)
    # a bias of 4 LSB of 0.05 deg/s known to 18 LSB/sqrt(samples); the step is a quarter of one
    sd = 18.0 / made.value("app.imu.bank.counters.samples") ** 0.5
    assert written * 0.25 == pytest.approx(-4.0, abs=4.0 * sd + 0.125)
    assert obey(made, "save", seconds=60.0) == RESULT["done"]
    made.power_cycle(made.retained())
    made.run(1.5)
    assert made.sensor.registers[0x1C] == register
    assert not made.machine.violations


def test_a_reset_during_a_report() -> None:
    """The main loop is away for longer than the sensor's silence lasts: the samples' stamps tell. And a status comes,
    which does not wait for the report's end."""
    flags = "-DBOARD_REPORT_MS=5000 -DBOARD_GATE=0"
    made = NrfBoard(image("m0-busy", flags, True, 1.024, target="cortex-m0", rate_hz=SLOW_RATE_HZ), seed=5)
    made.run(0.1)
    made.usart.say(b"O\r")
    tap = Tap(made)
    while not (made.value("app.imu.computing") and made.value("app.imu.work.hypothesis") == 2):
        made.run(0.1)  # a report that began anew would be at an earlier law of the first axis
    settings = set_up(made)
    made.sensor.reset()
    made.run(1.5)
    assert made.value("app.imu.computing")
    axis = made.value("app.stage")
    assert (axis, made.value("app.imu.work.hypothesis")) >= (0, 2)
    assert made.value("sensor.common.counters.faults") >= 1
    assert set_up(made) == settings
    assert tap.wrong() == tap.mistimed() == tap.foreign() == 0
    long_ago = -10_000 % 2**32  # ten seconds before the start
    made.machine.uc.mem_write(parts.place(made.elf, "app.told_ms")[0], long_ago.to_bytes(4, "little"))
    made.run(0.5)
    assert made.value("app.imu.computing")
    assert made.value("app.stage") == axis
    decoder, found = reports(messages(made))
    assert decoder.status["sensor_fault_count"] >= 1
    assert not found
    assert well(made)


@pytest.mark.skipif(MANY == 1, reason="ten minutes: make campaigns")
def test_a_whole_report_of_six_axes() -> None:
    """All laws on six axes at 16 MHz, minutes of work: the module stays up, and every axis arrives."""
    flags = "-DBOARD_REPORT_MS=20000 -DBOARD_GATE=0"
    made = NrfBoard(image("m0-report", flags, True, 1.024, target="cortex-m0", rate_hz=SLOW_RATE_HZ), seed=5)
    made.run(0.1)
    made.usart.say(b"O\r")
    for _ in range(60):
        made.run(5.0)
        decoder, found = reports(messages(made))
        if sum(report.complete for report in found) == 6:
            break
    tell("six axes' report, cortex-m0", 1, int(well(made)), f"after {made.machine.now_us / 1e6:.0f} s")
    assert well(made)
    assert {report.axis for report in found if report.complete} == {"gx", "gy", "gz", "ax", "ay", "az"}
    assert decoder.statistics.damaged == decoder.statistics.refused == 0


def test_a_fault_and_a_stopped_main_loop_are_told() -> None:
    """A jump into nothing resets and is told; a main loop that is not healthy is reset by the watchdog within 9 s."""
    made = board(seed=8)
    made.run(0.5)
    made.machine.uc.reg_write(parts.arm.UC_ARM_REG_PC, 0x60000001)
    made.machine._asleep = False
    made.run(0.3)
    made.usart.say(b"O\r")
    made.run(1.2)
    assert [cause for _, cause in made.machine.resets] == ["software"]
    assert status(made)["reset_cause"] == FAULT
    address, _ = parts.place(made.elf, "app.corrupt")
    made.machine.uc.mem_write(address, b"\x01")
    made.run(9.0)
    assert [cause for _, cause in made.machine.resets] == ["software", "watchdog"]
    made.usart.say(b"O\r")
    made.run(1.2)
    assert status(made)["reset_cause"] == WATCHDOG


def test_without_its_crystal() -> None:
    made = board(seed=9, crystal=False)
    made.run(1.5)
    assert status(made)["clock"] == 2
    assert well(made)


@pytest.mark.parametrize("kind", ["regressor", "two terms"])
def test_an_extended_model_is_saved_again_and_again(kind: str, tmp_path: Path) -> None:
    """Its state is longer than the default model's, and so is the part of a slot that a save erases. After the third
    save both slots have been written before. A turn-on goes on through a reset, and begins anew with power."""
    tree = yaml.safe_load(Model.load().path.read_text())
    tree["bank_rate_hz"] = QUIET_BANK_HZ
    tree["groups"] = {"gyro": {**tree["groups"]["gyro"], "axes": ["gx"]}}
    tree["gate"]["N"] = {"gyro": 0.1}
    if kind == "regressor":
        tree["regressors"] = [{"name": "settling", "kind": "turn_on", "tau_s": 250, "sd": {"gyro": 1}}]
    else:
        terms = {"probability": 1, "terms": ["markov", {"kind": "markov", "bandwidth": 17.5}]}
        tree["hypotheses"] = {"random_walk": 1, "two_markov": terms}
        tree["nodes"] = {core: {"random_walk": 8, "two_markov": [8, 6]} for core in ("host", "cortex-m0")}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    codegen(tmp_path / "model.yaml", tmp_path, target="cortex-m0", rate=QUIET_RATE_HZ)
    flags = "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0 -DBOARD_SAVE_PERIOD_S=2U"
    settings = [f"MODEL_DIR={tmp_path}", f"OUT={tmp_path}", f"CFLAGS={flags}"]
    subprocess.run(["make", "-s", "-f", "port/cortex-m0/cortex-m0.mk", "cortex-m0", *settings], cwd=ROOT, check=True)
    board = NrfBoard(tmp_path / "selfcal.elf", seed=21)
    board.run(10.0)
    assert board.value("app.told.state_saves") >= 3
    assert board.value("app.told.state_save_failures") == 0
    samples = board.value("app.imu.bank.counters.samples")
    board.machine.reset("software")
    board.run(0.4)
    assert board.value("app.told.state_found") == 1
    assert board.value("app.imu.bank.powered") == 0
    board.power_cycle(board.retained())
    board.run(0.4)
    assert board.value("app.told.state_found") == 1  # the newest
    assert board.value("app.imu.bank.counters.samples") > samples - 3 * QUIET_RATE_HZ
    begun = int(board.value("app.imu.bank.counters.samples")) + int(board.value("app.imu.bank.counters.missing"))
    since = (begun + int(board.value("app.imu.bank.powered"))) % 2**64
    assert 0 <= since <= math.ceil(0.4 * QUIET_RATE_HZ)  # the first sample comes at once
