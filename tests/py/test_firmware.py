"""The unmodified STM32F405 image on a board of behavioural models: what it sends is what the host computes from the
samples the sensor made, and the ways it is set up follow the manuals (each model notes what breaks a rule:
`violations`).

Truth of the telemetry: the same C library over the same samples, called directly on the host. Probabilities and
evidence within what the wire rounds (contract: 1e-4, 0.01 nat). The libms of newlib and glibc differ in last bits of
float functions, which moves the edges of the cells that quantiles are read from: statistics within 0.02 posterior sd,
the tolerance of a float build."""

from __future__ import annotations

import can
import numpy as np
from firmware import AXES, Board, image, readings, reports

from selfcal.engines.library import Bank
from selfcal.model import Model
from selfcal.tables import make_tables

P_TOLERANCE, NAT_TOLERANCE, SD_TOLERANCE = 1e-4, 0.01, 0.02
QUIET = {"flags": "-DBOARD_REPORT_MS=500", "quiet": True}


def test_telemetry_on_the_bus_equals_the_host() -> None:
    board = Board(image("shipped"), seed=3, channel="test_firmware_equals_host")
    listener = can.Bus(interface="virtual", channel="test_firmware_equals_host")
    board.run(21.5)
    frames: list[can.Message] = []
    while (frame := listener.recv(0.0)) is not None:
        frames.append(frame)
    listener.shutdown()
    board.close()
    assert board.machine.violations == []
    assert board.machine.faults == []
    assert board.machine.resets == []
    decoder, found = reports(frames)
    assert decoder.statistics.lost == 0
    assert decoder.statistics.damaged == 0
    last = {report.axis: report for report in found if report.complete}
    assert sorted(last) == sorted(AXES)
    assert decoder.status["missing"] == 0

    tables = make_tables(Model.load(), 819.2, AXES, "cortex-m4f")
    bank = Bank(tables)
    delivered = readings([board.sensor.source(index) for index in board.sensor.read_twice])
    assert np.array_equal(np.diff(board.sensor.read_twice), np.ones(len(delivered) - 1))
    pushed = 0
    worst = 0.0
    for name, report in sorted(last.items(), key=lambda item: item[1].value("count")):
        want_n = int(report.value("count"))
        while bank.raw.count < want_n:
            bank.push(delivered[pushed : pushed + 1])
            pushed += 1
        got, want = report.result(), bank.report(AXES.index(name))
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
    print(f"{len(delivered)} samples, {len(frames)} frames; statistics within {worst:.4f} posterior sd")
