"""The unmodified STM32F405 image on a board of behavioural models: what it sends is what the host computes from the
samples the sensor made, and the ways it is set up follow the manuals (each model notes what breaks a rule:
`violations`).

Truth of the telemetry: the same C library over the same samples, called directly on the host. Probabilities and
evidence within what the wire rounds (contract: 1e-4, 0.01 nat). The libms of newlib and glibc differ in last bits of
float functions, which moves the edges of the cells that quantiles are read from: statistics within 0.02 posterior sd,
the tolerance of a float build."""

from __future__ import annotations

import math
from typing import Any

import can
import numpy as np
import pytest
from firmware import AXES, QUIET_RATE_HZ, SLOW_RATE_HZ, Board, Tap, image, reports, status
from gated import Gated

from selfcal.model.file import Model
from selfcal.wire.frames import wire_names

P_TOLERANCE, NAT_TOLERANCE, SD_TOLERANCE = 1e-4, 0.01, 0.02
STATUS_FRAMES = 46
QUIET: dict[str, Any] = {"flags": "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0", "quiet": True}


def test_telemetry_on_the_bus_equals_the_host() -> None:
    """The image as it ships, at 819.2 Hz: a report of six axes, one sample in 97 stale and 0.14 s without
    data-ready. What the library was given is exactly what the sensor made, each in its place; what it then sent is what
    the host makes of that."""
    board = Board(image("shipped"), seed=3, channel="test_firmware_equals_host")
    listener = can.Bus(interface="virtual", channel="test_firmware_equals_host")
    tap = Tap(board)
    board.sensor.stale = lambda k: k % 97 == 5
    most_waiting = 0
    while board.machine.now_us < 13.0e6:
        board.sensor.silent = 6.0e6 < board.machine.now_us < 6.14e6
        board.run(0.01)
        most_waiting = max(most_waiting, board.value("sensor.head") - board.value("sensor.tail"))
    frames: list[can.Message] = []
    while (frame := listener.recv(0.0)) is not None:
        frames.append(frame)
    listener.shutdown()
    board.close()
    assert board.machine.violations == []
    assert board.machine.faults == []
    assert board.machine.resets == []
    assert tap.wrong() == 0
    assert tap.misplaced(0) == 0
    decoder, found = reports(frames)
    assert decoder.statistics.lost == 0
    assert decoder.statistics.damaged == 0
    last = {report.axis: report for report in found if report.complete}
    assert sorted(last) == sorted(AXES)
    assert decoder.status["missing"] > 200
    assert decoder.status["sensor_overrun_count"] == 0

    host = Gated(Model.load(), 819.2, AXES, "cortex-m4f")
    bank, fed, worst = host.bank, 0, 0.0
    for name, report in sorted(last.items(), key=lambda item: item[1].value("count")):
        while bank.raw.count < int(report.value("count")):
            missing, sample = tap.seen[fed]
            host.feed(missing, np.array(sample, dtype=np.float32))
            fed += 1
        got, want = report.result(wire_names(Model.load())), bank.report(AXES.index(name))
        assert got.n == want.n >= 3
        best = max(got.log_evidence.values()), max(want.log_evidence.values())
        assert abs(got.bias_mean - want.bias_mean) <= SD_TOLERANCE * want.bias_sd
        for law, probability in want.probability.items():
            assert abs(got.probability[law] - probability) <= P_TOLERANCE
            assert abs(got.log_evidence[law] - best[0] - (want.log_evidence[law] - best[1])) <= NAT_TOLERANCE
            for parameter, estimate in want.parameters[law].items():
                for statistic in ("mean", "median", "sd", "q05", "q95"):
                    difference = getattr(got.parameters[law][parameter], statistic) - getattr(estimate, statistic)
                    worst = max(worst, abs(difference) / estimate.sd)
                    assert abs(difference) <= SD_TOLERANCE * estimate.sd, (name, law, parameter, statistic)
    assert [sample for _, sample in tap.pushed][: sum(host.used)] == [
        sample for (_, sample), used in zip(tap.seen, host.used, strict=False) if used
    ]
    print(
        f"{len(tap.seen)} samples, {sum(missing for missing, _ in tap.seen)} missing, {len(frames)} frames; "
        f"statistics within {worst:.4f} sd; "
        f"at most {most_waiting} samples waited"
    )


@pytest.mark.parametrize("kbit_per_s", [125, 250, 500, 1000])
def test_can_bit_rate_is_what_it_is_built_for(kbit_per_s: int) -> None:
    """From BTR by RM0090 32.7.7: the rate exactly, the sample point within 80 to 90 %. The model acknowledges only what
    fits its own rate to 0.5 %."""
    board = Board(
        image(f"can{kbit_per_s}", f"-DBOARD_REPORT_MS=500 -DBOARD_CAN_KBITPS={kbit_per_s}", quiet=True), seed=1
    )
    board.can.bus_bit_s = 1000.0 * kbit_per_s
    board.run(0.9)
    ts1, ts2 = (board.can.btr >> 16 & 15) + 1, (board.can.btr >> 20 & 7) + 1
    assert math.isclose(board.can.bit_us, 1000.0 / kbit_per_s, rel_tol=1e-12)
    assert 0.80 <= (1 + ts1) / (1 + ts1 + ts2) <= 0.90
    assert len(board.frames) == STATUS_FRAMES
    assert board.machine.violations == []


def test_another_crystal() -> None:
    """25 MHz: the clocks are those of the data sheet, and a second on the board is one on the bus."""
    board = Board(image("hse25", f"{QUIET['flags']} -DBOARD_HSE_HZ=25000000", quiet=True), seed=1)
    board.rcc.hse_hz = 25e6
    board.run(2.2)
    assert board.rcc.pclk1_hz == 42e6
    assert status(board)["clock"] == 1
    assert len(board.frames) == 4 * STATUS_FRAMES
    third, fourth = (board.frames[-k * STATUS_FRAMES][0] for k in (2, 1))
    assert fourth - third == pytest.approx(0.5e6, abs=2e3)  # two ms that a turn may take
    assert board.machine.violations == []


def test_frames_leave_in_order_without_gaps() -> None:
    """Counters of the frames on the bus: each one more than the last, though three mailboxes are filled at once."""
    board = Board(image("quiet", **QUIET), seed=1)
    board.run(2.2)
    counters = [int.from_bytes(frame[1], "little") >> 38 & 0x3F for _, frame in board.frames]
    assert counters == [i % 64 for i in range(len(counters))]
    assert len(counters) == 4 * STATUS_FRAMES


def test_serial_line_speaks_slcan() -> None:
    """What python-can sends on opening is answered, frames follow; after C there are none."""
    board = Board(
        image(
            "serial", "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0 -DBOARD_CAN_KBITPS=0 -DBOARD_USART_BAUD=1000000", quiet=True
        ),
        seed=1,
    )
    board.usart.host_baud = 1e6
    board.run(0.2)
    board.usart.say(b"C\rS6\r\rO\rO\rV\rN\r")
    board.run(0.2)
    assert bytes(board.text) == b"\r\r\r\r\rV0101\rNSCAL\r"
    board.run(0.7)
    lines = bytes(board.text).split(b"\r")[7:]
    frames = [
        can.Message(arbitration_id=int(line[1:4], 16), data=bytes.fromhex(line[5:].decode()), is_extended_id=False)
        for line in lines
        if line
    ]
    decoder, _ = reports(frames)
    assert len(frames) == 2 * STATUS_FRAMES  # at 0.5 and 1 s
    assert decoder.statistics.damaged == decoder.statistics.lost == 0
    assert decoder.status["sensor_state"] == 2
    board.usart.say(b"C\r")
    board.run(0.1)
    board.text.clear()
    board.run(1.0)
    assert bytes(board.text) == b""
    assert board.machine.violations == []


@pytest.mark.parametrize(("name", "rate_hz", "divisor"), [("quiet", QUIET_RATE_HZ, 10), ("slow", SLOW_RATE_HZ, 16)])
def test_set_up_of_the_sensor(name: str, rate_hz: float, divisor: int) -> None:
    """Registers after start, data sheet tables 15 to 18: 1638.4 Hz over `divisor`, +-300 deg/s, two taps, data-ready on
    DIO1 rising; one self-test; every sample read by two bursts."""
    board = Board(image(name, **QUIET, rate_hz=rate_hz), seed=1)
    board.run(1.5)
    registers = board.sensor.registers
    assert (registers[0x36], registers[0x38], registers[0x34]) == (divisor - 1, 0x0401, 0x0006)
    made = [index for index, us, _ in board.sensor.taken if 0.6e6 < us < 1.49e6]  # the last may still be being read
    assert [index for index in board.sensor.read_twice if made[0] <= index <= made[-1]] == made
    assert status(board)["sensor_fault_count"] == 0
