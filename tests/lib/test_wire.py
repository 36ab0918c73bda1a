"""The wire: what the C code packs against the DBC, and the decoder on sound and on damaged streams.

Truth: tests/lib/telemetry_stream.c prints the numbers it puts in, by struct member; the DBC is read by cantools, which
is not ours. Numbers are printed with 17 digits and must come back exactly, but for evidence differences.
"""

from __future__ import annotations

import math
import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from signal import SIGINT

import can
import cantools
import numpy as np
import pyte
import pytest
from numpy.typing import NDArray

from selfcal import _firmware
from selfcal.base.errors import UserError
from selfcal.wire import frames_codegen
from selfcal.wire.dbc_file import Names, dbc_text
from selfcal.wire.frames import AXES, AxisReport, Decoder, Statistics, Streams, frame_crc, load_dbc, open_bus

from wire_stream import ROOT, Sent, lines, message, serial_line, stream

DBC = ROOT / "lib" / "selfcal.dbc"
COMMON = {"item", "counter", "time", "crc"}
REPORT_FRAMES = 46
STATUS_FRAMES = 46
PLACES = ("N", "p1", "p2")
#: Names of the stream's three hypotheses, in its order.
NAMES = Names(
    ("random_walk", "gauss_markov", "constant"),
    (("N", "K"), ("N", "sigma_m", "alpha"), ("N",)),
    tuple((f"z{column}", "K") for column in range(6)),
)
CYCLE = STATUS_FRAMES + len(AXES) * REPORT_FRAMES


def changed_dbc(old: str, new: str) -> cantools.database.can.Database:
    text = DBC.read_text()
    assert old in text
    return cantools.database.load_string(text.replace(old, new, -1 if old.strip().isdigit() else 1), "dbc")


# ---------------------------------------------------------------------------------------------------- the one source


def test_committed_files_are_the_generated_ones() -> None:
    """`python -m selfcal.wire.frames_codegen` writes them."""
    assert DBC.read_text() == dbc_text()
    assert (ROOT / "lib" / "selfcal_frames.h").read_text() == frames_codegen.header(load_dbc())
    wire = (ROOT / "lib" / "WIRE.md").read_text(encoding="utf-8")
    assert wire == frames_codegen.page(wire, load_dbc())


def test_names_of_a_model_are_symbols_of_a_dbc() -> None:
    """Whatever a model calls its parts: at most 32 letters, digits and underscores, all different."""
    names = Names(
        ("a law / with a name that is much too long", "a law / with a name that is much too long, too", "2nd"),
        (("N",), ("N", "K"), ("N", "B", "alpha")),
        (("temperature.sin", "degC"), ("temperature_sin", "degC"), ("ax", "m/s^2")),
    )
    database = cantools.database.load_string(dbc_text(11, names, ("gy", "az")), "dbc")
    for entry in database.messages:
        assert re.fullmatch(r"M11_[A-Z]\w{0,27}", entry.name, re.ASCII)
        symbols = [signal.name for signal in entry.signals]
        assert len(set(symbols)) == len(symbols)
        assert all(re.fullmatch(r"[A-Za-z_]\w{0,31}", one, re.ASCII) for one in symbols)
        assert 0x200 + 11 * 128 <= entry.frame_id < 0x800
    assert len({entry.name for entry in database.messages}) == len(database.messages) == 1 + 2 + 4 + 2 * (2 + 3)
    coefficient = database.get_message_by_name("M11_AZ_COEFFICIENTS").get_signal_by_name("temperature_sin_mean")
    assert coefficient.unit == "m/s^2/degC"


def test_table_names_every_signal_and_unit() -> None:
    table = frames_codegen.table(load_dbc())
    for entry in load_dbc().messages:
        for signal in entry.signals:
            assert f"`{signal.name}`" in table
            if signal.unit is not None:
                assert signal.unit in table


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            "BO_ 513 GX: 8 MODULE\n SG_ item M : 32|6@1+",
            "BO_ 513 GX: 8 MODULE\n SG_ item M : 32|5@1+",
            "GX.item: must be bits",
        ),
        ("BO_ 512 STATUS: 8 MODULE", "BO_ 512 STATUS: 9 MODULE", "STATUS: must have 8 bytes"),
        ("c5_probability m17 :", "c5_probability m18 :", "GX_COEFFICIENTS: each column must have three items"),
    ],
)
def test_dbc_that_c_cannot_pack_is_refused(old: str, new: str, complaint: str) -> None:
    with pytest.raises(UserError, match=re.escape(complaint)):
        frames_codegen.header(changed_dbc(old, new))


def test_crc_check_value() -> None:
    """CRC-12/CDMA2000 in the catalogue of parametrised CRC algorithms (G. Cook)."""
    assert _firmware.crc12(b"123456789") == 0xD4D


# -------------------------------------------------------------------------------------- C packs, standard tools decode


def expected_values(sent: Sent) -> dict[str, float]:
    """What the frames must decode to, from the numbers that went in."""
    values = {name: number for name, number in sent.truth.items() if not name.endswith("_ln_evidence")}
    evidence = {name: number for name, number in sent.truth.items() if name.endswith("_ln_evidence")}
    if evidence:
        values["ln_evidence"] = float(np.float32(max(evidence.values())))
        values |= {f"{name}_diff": number - max(evidence.values()) for name, number in evidence.items()}
        values["end_items"] = len(sent.lines)
        # the flags of a hypothesis share an item: those of places that it lacks are 0
        flags = [f"h{k}_{place}_flags" for k in range(int(values["hypotheses"])) for place in PLACES]
        values = dict.fromkeys(flags, 0.0) | values
    return values


def assert_equal(name: str, value: float, truth: float) -> None:
    """Exact, but for evidence differences, which travel in steps of 0.001 nat (contract: 0.01)."""
    if name.endswith("_diff"):
        assert abs(value - truth) <= 0.0005 + 1e-9, name
    else:
        assert value == truth, name


def prefix(message_name: str) -> str:
    """What distinguishes a signal of this message from those of the axis's other messages."""
    match = re.fullmatch(r"[AG][XYZ]_H(\d)", message_name)
    return f"h{match[1]}_" if match else ""


@pytest.mark.parametrize(("hypotheses", "columns"), [(1, 0), (2, 1), (3, 0), (8, 6)])
def test_cantools_reads_every_item_that_c_packs(hypotheses: int, columns: int) -> None:
    database = cantools.database.load_file(DBC)
    seen: set[tuple[str, str]] = set()
    frames = 0
    for sent in stream(7, 20, hypotheses, columns=columns):
        decoded: dict[str, float] = {}
        for line in sent.lines:
            frame = message(line)
            values = database.decode_message(frame.arbitration_id, bytes(frame.data), decode_choices=False)
            assert values["counter"] == frames % 64
            assert values["time"] == int(sent.truth["time_ms"]) // 1000 % 256
            if "frames_sent" in values:
                assert values["frames_sent"] == frames
            before = prefix(database.get_message_by_frame_id(frame.arbitration_id).name)
            decoded |= {f"{before}{name}": value for name, value in values.items() if name not in COMMON}
            frames += 1
        truth = expected_values(sent)
        constant = {"wire_version", "frames_sent"} if sent.message == "STATUS" else set()
        assert decoded.keys() - constant == truth.keys()
        for name, number in truth.items():
            assert_equal(name, decoded[name], number)
            seen.add((sent.message, name))
    if hypotheses == 8:  # CORRECTED, COMMAND, ANSWER: tests/port/test_firmware_commands.py
        others = ("CORRECTED", "COMMAND", "ANSWER")
        everything = {
            (m.name.partition("_")[0], f"{prefix(m.name)}{s.name}")
            for m in database.messages
            for s in m.signals
            if s.name not in COMMON and m.name not in others and not m.name.endswith("_ADEQUACY")
        }
        unsent = {("STATUS", "wire_version"), ("STATUS", "frames_sent")}
        laws = {0: 2, 1: 3, 2: 1}  # places of the stream's laws; of the others the flags alone are sent, as 0
        unsent |= {
            (axis.upper(), f"h{k}_{place}_{statistic}")
            for axis in AXES
            for k in range(8)
            for place in PLACES[laws[k % 3] :]
            for statistic in ("mean", "median", "sd", "q05", "q95")
        }
        assert everything - seen == unsent


def test_a_dbc_with_a_model_s_names_reads_the_frames_of_its_node() -> None:
    """Node 5, whose identifiers are 5 * 128 higher; names and units of NAMES in place of the places'."""
    database = cantools.database.load_string(dbc_text(5, NAMES), "dbc")
    for sent in stream(7, 2, columns=6, node=5):
        decoded: dict[str, float] = {}
        for line in sent.lines:
            frame = message(line)
            entry = database.get_message_by_frame_id(frame.arbitration_id)
            assert entry.name.startswith("M5_")
            values = entry.decode(bytes(frame.data), decode_choices=False)
            assert isinstance(values, dict)
            for name, value in values.items():
                decoded[f"{entry.name}.{name}"] = float(value)  # type: ignore[arg-type]
        if sent.message == "STATUS":
            continue
        for k, law in enumerate(NAMES.hypotheses):
            name = f"M5_{sent.message}_{law.upper()}"
            assert decoded[f"{name}.probability"] == sent.truth[f"h{k}_probability"]
            for place, parameter in zip(PLACES, NAMES.parameters[k], strict=False):
                assert decoded[f"{name}.{parameter}_median"] == sent.truth[f"h{k}_{place}_median"]
        assert decoded[f"M5_{sent.message}_COEFFICIENTS.z3_mean"] == sent.truth["c3_mean"]
    walk = database.get_message_by_name("M5_AX_RANDOM_WALK")
    assert walk.get_signal_by_name("K_mean").unit == "m/s^3/sqrt(Hz)"
    assert not any(signal.name.startswith("p") and signal.name != "probability" for signal in walk.signals)


# ------------------------------------------------------------------------------------------------- decoder, sound input


def feed(decoder: Decoder, frames: Iterable[str]) -> list[AxisReport]:
    return [report for line in frames for report in decoder.feed(message(line))]


def reports_of(sent: Iterable[Sent]) -> list[Sent]:
    return [one for one in sent if one.message != "STATUS"]


def unwrapped_s(index: int) -> float:
    """Module time of report `index`, from 0, of a stream of telemetry_stream.c, which starts just before 2^32 ms."""
    return (4294940000 + 1500 * (index // len(AXES) + 1)) / 1000


def test_reports_arrive_whole_and_in_time_past_the_wrap() -> None:
    sent = stream(3, 40)
    decoder = Decoder()
    reports = feed(decoder, lines(sent))
    truth = reports_of(sent)
    assert len(reports) == len(truth) == 240
    for index, (report, want) in enumerate(zip(reports, truth, strict=True)):
        assert report.complete
        assert report.axis == want.message.lower()
        assert report.time_s == unwrapped_s(index)
        for name, number in expected_values(want).items():
            assert_equal(name, report.value(name), number)
    s = decoder.statistics
    assert (s.received, s.lost, s.damaged, s.refused) == (40 * CYCLE, 0, 0, 0)
    assert decoder.status["state"] == 2


def test_reports_of_a_slow_module_keep_their_time() -> None:
    """A Cortex-M0 takes 12 s for an axis's report, and tells its status meanwhile: no restart, and no later time."""
    slow_ms = 12_000
    sent = stream(21, 3, slow_ms=slow_ms)
    decoder = Decoder(from_start=True)
    reports: list[AxisReport] = []
    for line in lines(sent):
        before_ms = decoder.time_ms
        reports += decoder.feed(message(line))
        assert decoder.time_ms >= before_ms
    assert len(reports) == 18
    for index, report in enumerate(reports):
        cycle = index // len(AXES)
        assert report.complete
        assert report.time_s == (4294940000 + 1500 * (cycle + 1) + slow_ms * index) / 1000


def test_result_is_what_went_in() -> None:
    sent = stream(5, 1)
    (report, *_) = feed(Decoder(), lines(sent))
    truth = reports_of(sent)[0].truth
    result = report.result(NAMES)
    assert result.n == truth["count"]
    assert tuple(result.probability) == NAMES.hypotheses
    best = max(truth[f"h{k}_ln_evidence"] for k in range(3))
    for k, (law, parameters) in enumerate(zip(NAMES.hypotheses, NAMES.parameters, strict=True)):
        # differences to 0.01 nat (the contract), whatever the common offset lost in float32
        difference = result.log_evidence[law] - max(result.log_evidence.values())
        assert abs(difference - (truth[f"h{k}_ln_evidence"] - best)) <= 0.001
        assert tuple(result.parameters[law]) == parameters
        for place, name in zip(PLACES, parameters, strict=False):
            estimate = result.parameters[law][name]
            assert estimate.identified == bool(int(truth[f"h{k}_{place}_flags"]) & 1)
            assert estimate.off_grid == bool(int(truth[f"h{k}_{place}_flags"]) & 8)
            for statistic in ("mean", "median", "sd", "q05", "q95"):
                assert getattr(estimate, statistic) == truth[f"h{k}_{place}_{statistic}"]
    by_place = report.result()
    assert list(by_place.parameters) == ["h0", "h1", "h2"]
    assert [list(parameters) for parameters in by_place.parameters.values()] == [["N", "p1"], list(PLACES), ["N"]]


def test_coefficients_are_told_by_column() -> None:
    sent = stream(5, 1, columns=2)
    (report, *_) = feed(Decoder(), lines(sent))
    truth = reports_of(sent)[0].truth
    assert report.complete
    assert report.coefficients(NAMES) == {
        f"z{c}": tuple(truth[f"c{c}_{key}"] for key in ("mean", "sd", "probability")) for c in range(2)
    }


def test_an_evidence_at_the_end_of_its_item_is_no_number() -> None:
    """32 bits of 0.001 nat end at -2 147 483.648, as C packs -infinity."""
    (report, *_) = feed(Decoder(), lines(stream(5, 1)))
    report.values["h2_ln_evidence_diff"] = -2147483.648
    assert report.result(NAMES).log_evidence["constant"] == -math.inf


# ------------------------------------------------------------------------------------------------ other versions, nodes


def version_3(line: str) -> can.Message:
    """A status frame as a module of wire version 3 sends it: item 1 says so."""
    frame = message(line)
    item = int.from_bytes(frame.data, "little") >> 32 & 0x3F
    return with_bits(line, value=(0, 32, 3)) if frame.arbitration_id == 0x200 and item == 1 else frame


def test_a_module_of_another_version_is_refused_by_its_number() -> None:
    """Nothing is told of it but the version, whatever its frames would mean here."""
    decoder = Decoder(from_start=True)
    reports = [report for line in lines(stream(3, 2)) for report in decoder.feed(version_3(line))]
    assert reports == []
    assert decoder.surely_foreign
    assert decoder.foreign.startswith("the module speaks wire version 3, this tool reads version 4: ")
    assert decoder.status == {"wire_version": 3.0}
    assert decoder.statistics.refused == 0
    reports = feed(decoder, lines(stream(3, 2)))  # the firmware was changed
    assert not decoder.foreign
    assert any(report.complete for report in reports)


def test_a_lone_frame_of_another_version_is_not_sure() -> None:
    """A frame that passed the checksum by chance: the next whole status puts it right."""
    sent = lines(stream(3, 2))
    decoder = Decoder(from_start=True)
    for line in sent[:10]:
        decoder.feed(version_3(line))
    assert decoder.foreign
    assert not decoder.surely_foreign
    reports = feed(decoder, sent[10:])
    assert not decoder.surely_foreign or not decoder.foreign
    assert sum(report.complete for report in reports) == 6


def test_streams_of_several_nodes_are_kept_apart() -> None:
    """Two modules whose frames alternate: each has its own counters, reports and status."""
    sent = {node: lines(stream(3 + node, 3, node=node)) for node in (0, 7)}
    streams = Streams()
    reports = [
        report for pair in zip(*sent.values(), strict=True) for line in pair for report in streams.feed(message(line))
    ]
    assert list(streams.known) == [0, 7]
    for node in (0, 7):
        truth = reports_of(stream(3 + node, 3, node=node))
        mine = [report for report in reports if report.node == node]
        assert len(mine) == len(truth)
        for report, want in zip(mine, truth, strict=True):
            assert report.complete
            for name, number in expected_values(want).items():
                assert_equal(name, report.value(name), number)
        assert streams.decoders[node].status["model_id"] == stream(3 + node, 3, node=node)[0].truth["model_id"]
    assert streams.statistics == Statistics(received=sum(map(len, sent.values())))


def test_one_node_may_be_looked_at_alone() -> None:
    streams = Streams(node=7)
    for node in (0, 7):
        for line in lines(stream(3 + node, 3, node=node)):
            streams.feed(message(line))
    assert list(streams.decoders) == [7]
    assert (streams.statistics.received, streams.statistics.refused) == (3 * CYCLE, 0)


def test_strangers_make_at_most_twelve_streams() -> None:
    """Frames of every identifier with right and wrong checksums: those that no node sends are refused."""
    generator = np.random.default_rng(9)
    streams = Streams()
    for line in lines(stream(3, 3)):
        streams.feed(message(line))
    for _ in range(20_000):
        payload = int.from_bytes(generator.bytes(8), "little") & (1 << 52) - 1
        identifier = int(generator.integers(0, 2048))
        right = frame_crc(identifier, payload.to_bytes(8, "little")) if generator.random() < 0.5 else 0
        data = (payload | right << 52).to_bytes(8, "little")
        streams.feed(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
    assert len(streams.decoders) <= 12
    s = streams.statistics
    assert s.damaged > 0
    assert s.refused > 0


def test_a_frame_that_passes_by_chance_shows_no_module() -> None:
    streams = Streams()
    for line in lines(stream(3, 3)):
        streams.feed(message(line))
    streams.feed(message(lines(stream(3, 1, node=4))[50]))
    assert list(streams.known) == [0]
    assert (streams.statistics.received, streams.statistics.refused) == (3 * CYCLE, 1)


# --------------------------------------------------------------------------------------------- decoder, damaged input


def with_bits(line: str, **fields: tuple[int, int, int]) -> can.Message:
    """A frame with fields (first bit, width, value) changed and its checksum put right."""
    frame = message(line)
    bits = int.from_bytes(frame.data, "little")
    for start, width, value in fields.values():
        bits = bits & ~(((1 << width) - 1) << start) | value << start
    bits &= (1 << 52) - 1
    bits |= frame_crc(frame.arbitration_id, bits.to_bytes(8, "little")) << 52
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False, data=bits.to_bytes(8, "little"))


def test_every_error_of_one_to_three_bits_is_caught() -> None:
    """Hamming distance 4 of the polynomial at 67 + 12 bits (found by enumeration: no word of weight 1, 2 or 3)."""
    frame = message(lines(stream(1, 1))[20])
    word = int.from_bytes(frame.data, "little") | frame.arbitration_id << 64
    positions = range(75)

    def sound(bits: int) -> bool:
        data = (bits & (1 << 64) - 1).to_bytes(8, "little")
        return bits >> 52 & 0xFFF == frame_crc(bits >> 64, data)

    assert sound(word)
    # The code is linear: with all syndromes of single errors different and none the sum of two others, no error of up
    # to three bits goes unseen.
    syndromes = []
    for i in positions:
        bits = word ^ 1 << i
        data = (bits & (1 << 64) - 1).to_bytes(8, "little")
        syndromes.append((bits >> 52 & 0xFFF) ^ frame_crc(bits >> 64, data))
    assert 0 not in syndromes
    assert len(set(syndromes)) == len(syndromes)
    pairs = {a ^ b for i, a in enumerate(syndromes) for b in syndromes[:i]}
    assert not pairs & set(syndromes)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda frame: can.Message(arbitration_id=0x208, is_extended_id=False, data=frame.data),
        lambda frame: can.Message(arbitration_id=frame.arbitration_id, is_extended_id=True, data=frame.data),
        lambda frame: can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False, data=frame.data[:7]),
        lambda frame: can.Message(
            arbitration_id=frame.arbitration_id, is_extended_id=False, is_remote_frame=True, dlc=8
        ),
        lambda frame: can.Message(
            arbitration_id=frame.arbitration_id, is_extended_id=False, data=frame.data, is_fd=True
        ),
    ],
    ids=["id", "extended", "short", "remote", "fd"],
)
def test_wrong_form_is_refused(spoil: object) -> None:
    assert callable(spoil)
    decoder = Decoder()
    assert decoder.feed(spoil(message(lines(stream(1, 1))[20]))) == []
    assert (decoder.statistics.refused, decoder.statistics.received) == (1, 0)


def test_contradictions_with_a_right_checksum_are_refused() -> None:
    all_lines = lines(stream(1, 1))
    opening = all_lines[STATUS_FRAMES]
    sent_count = all_lines[STATUS_FRAMES - 1]
    for frame in (
        with_bits(opening, item=(32, 6, 60)),  # no such item
        with_bits(
            opening, time=(44, 8, (int(stream(1, 1)[0].truth["time_ms"]) // 1000 + 1) % 256)
        ),  # not that of time_ms
        with_bits(sent_count, value=(0, 32, 14)),  # not that of the counter
    ):
        decoder = Decoder()
        decoder.feed(frame)
        assert (decoder.statistics.refused, decoder.statistics.received) == (1, 0)


def corrected_frame(counter: int, item: int, value: int) -> can.Message:
    """A frame of message CORRECTED of the module's third second."""
    fields = {"value": (0, 32, value), "item": (32, 6, item), "counter": (38, 6, counter), "time": (44, 8, 2)}
    return with_bits("t2078" + "0" * 16, **fields)


def test_a_corrected_sample_holds_nothing_of_the_one_before() -> None:
    """Axis gx (items 1 and 7) is in the first set, not in the second: its value must not stand beside the new time."""
    decoder, no_reasons = Decoder(), {f"reason_{axis}": 0.0 for axis in AXES}
    for counter, (item, value) in enumerate([(0, 2000), (1, 0x3F800000), (7, 0x3F000000), (13, 2), (0, 2100), (13, 1)]):
        decoder.feed(corrected_frame(counter, item, value))
        if counter == 3:
            sample = {"time_ms": 2000.0, "corrected_gx": 1.0, "sd_gx": 0.5, "motion": 2.0}
            assert decoder.corrected == sample | no_reasons
    assert decoder.corrected == {"time_ms": 2100.0, "motion": 1.0} | no_reasons
    assert (decoder.statistics.received, decoder.statistics.refused) == (6, 0)


def test_a_corrected_sample_takes_nothing_of_the_next_whose_first_frame_is_lost() -> None:
    """Samples at 2000 and 2100 ms whose readings are 1 and 2; the loss of any frame, and of any two in a row."""
    samples = [[(0, 2000), (1, 0x3F800000), (2, 0x3F800000)], [(0, 2100), (1, 0x40000000), (2, 0x40000000)]]
    sent = list(enumerate(frame for sample in samples for frame in sample))
    for lost in ({first, second} for first in range(6) for second in (first, first + 1)):
        decoder = Decoder()
        for counter, (item, value) in sent:
            if counter not in lost:
                decoder.feed(corrected_frame(counter, item, value))
                readings = {decoder.corrected[name] for name in decoder.corrected if name != "time_ms"}
                assert readings <= {{2000.0: 1.0, 2100.0: 2.0}.get(decoder.corrected.get("time_ms", 0.0))}


def test_repeated_and_late_frames_are_refused() -> None:
    all_lines = lines(stream(1, 2))
    decoder = Decoder(from_start=True)
    order = [line for line in all_lines for _ in range(2)]  # every frame twice
    reports = feed(decoder, order)
    assert sum(report.complete for report in reports) == 12
    assert (decoder.statistics.refused, decoder.statistics.lost) == (len(all_lines), 0)
    feed(decoder, [all_lines[-3], all_lines[-9]])
    assert decoder.statistics.refused == len(all_lines) + 2


@pytest.mark.parametrize("start", [0, 5, STATUS_FRAMES, STATUS_FRAMES + 20, STATUS_FRAMES + 45, 200, CYCLE - 1])
@pytest.mark.parametrize("length", [1, 2, 31, 32, 33, 62, 63, 64, 65, 128, CYCLE - 1, CYCLE, CYCLE + 1, 320, 600])
def test_a_burst_of_lost_frames_is_counted_and_nothing_is_mixed(start: int, length: int) -> None:
    """A gap of any length, multiples of the counter's 64 and of the report's length included: no report may hold values
    of two, and the next status makes the count exact."""
    sent = stream(2, 8)
    all_lines = lines(sent)
    start += CYCLE
    decoder = Decoder(from_start=True)
    reports = feed(decoder, all_lines[:start] + all_lines[start + length :])
    truth = [expected_values(one) for one in reports_of(sent)]
    for report in reports:
        at = [
            i
            for i, one in enumerate(reports_of(sent))
            if one.message.lower() == report.axis and report.time_s <= unwrapped_s(i) < report.time_s + 1
        ]
        assert len(at) == 1
        assert report.complete == (report.values.keys() == truth[at[0]].keys())
        for name, value in report.values.items():
            assert_equal(name, value, truth[at[0]][name])
    s = decoder.statistics
    assert s.lost == len(all_lines) - s.received
    assert s.lost - length == s.refused <= 2  # given up while the counter was found again
    assert sum(report.complete for report in reports) >= 48 - 6 * (length // CYCLE + 2)


def test_module_that_starts_anew_is_followed() -> None:
    decoder = Decoder()
    feed(decoder, lines(stream(2, 3)))
    before = decoder.statistics.received
    reports = feed(decoder, lines(stream(4, 3))[10:])
    assert sum(report.complete for report in reports) == 18
    assert decoder.statistics.received >= before + 3 * CYCLE - 12
    assert decoder.statistics.lost < 64


# --------------------------------------------------------------------------------------------------------- serial noise


def spoil(data: bytes, seed: int, share: float) -> bytes:
    """`share` of the bytes replaced by a random one, dropped or doubled, a third each."""
    generator = np.random.default_rng(seed)
    array = np.frombuffer(data, np.uint8).copy()
    kind = np.where(generator.random(array.size) < share, generator.integers(1, 4, array.size), 0)
    array[kind == 1] = generator.integers(0, 256, int((kind == 1).sum()))
    copies = np.ones(array.size, int)
    copies[kind == 2] = 0
    copies[kind == 3] = 2
    return bytes(np.repeat(array, copies))


def test_ten_thousand_frames_over_a_noisy_pty() -> None:
    """1 % of the bytes corrupted, dropped or doubled. Sent frames are known, so are the reports they belong to."""
    sent = stream(11, 36)
    sent_frames = [(int(line[1:4], 16), bytes.fromhex(line[5:])) for line in lines(sent)]
    assert len(sent_frames) == 36 * (STATUS_FRAMES + 6 * REPORT_FRAMES)  # a status and six axes each
    data = spoil("".join(line + "\r" for line in lines(sent)).encode(), seed=5, share=0.01)
    truth = [expected_values(one) for one in reports_of(sent)]
    decoder = Decoder(from_start=True)
    accepted: list[tuple[int, bytes]] = []
    reports: list[AxisReport] = []
    begun = time.monotonic()
    with serial_line(data) as path, open_bus("slcan", path, bitrate=500000, sleep_after_open=0.0) as link:
        while (frame := link.recv(0.5)) is not None:
            before = decoder.statistics.received
            reports += decoder.feed(frame)
            if decoder.statistics.received > before:
                accepted.append((frame.arbitration_id, bytes(frame.data)))
        malformed = link.malformed
        assert not link.closed
    assert time.monotonic() - begun < 60
    reports += decoder.flush()

    at = -1
    for one in accepted:
        at = sent_frames.index(one, at + 1)  # ValueError: never sent, or out of order
    s = decoder.statistics
    print(
        f"\n{len(sent_frames)} frames sent: {s.received} accepted, {s.lost} lost; arrived: {s.damaged} bad checksum, "
        f"{s.refused} refused, {malformed} lines malformed"
    )
    assert s.received == len(accepted)
    assert s.lost == at + 1 - len(accepted)
    assert 0.15 < s.lost / len(sent_frames) < 0.25  # 1 - 0.99^22 = 0.198: every byte of the line counts
    assert s.damaged > 0
    assert s.refused > 0
    assert malformed > 0

    for report in reports:
        at_report = [
            i
            for i, one in enumerate(reports_of(sent))
            if one.message.lower() == report.axis and report.time_s <= unwrapped_s(i) < report.time_s + 1
        ]
        assert len(at_report) == 1
        assert report.complete == (report.values.keys() == truth[at_report[0]].keys())
        for name, value in report.values.items():
            assert_equal(name, value, truth[at_report[0]][name])
    assert sum(len(report.values) for report in reports) > 0.7 * 36 * 6 * REPORT_FRAMES


def random_frames_accepted(count: int, seed: int) -> int:
    """How many of `count` frames with a right form and random payload have a right checksum."""
    generator = np.random.default_rng(seed)
    data = generator.integers(0, 256, (count, 8), dtype=np.uint8)
    table = np.array([crc12_by_division(byte) for byte in range(256)], dtype=np.uint16)
    crc: NDArray[np.uint16] = np.full(count, 0xFFF, np.uint16)
    covered = np.column_stack([np.full((count, 3), (2, 1, 8), np.uint8), data[:, :6], data[:, 6] & 0x0F])
    for column in covered.T:
        crc = (crc << 8 & 0xFFF) ^ table[crc >> 4 ^ column]
    return int((crc == (data[:, 6] >> 4 | data[:, 7].astype(np.uint16) << 4)).sum())


def crc12_by_division(byte: int) -> int:
    remainder = byte << 12
    for bit in range(19, 11, -1):
        if remainder >> bit & 1:
            remainder ^= 0x1F13 << bit - 12
    return remainder


def test_share_of_random_frames_that_pass_the_checksum() -> None:
    """2^-12 for payloads that are nothing but noise: the worst damage. Tolerance: 4 standard errors of the count."""
    count = 1 << 22
    passed = random_frames_accepted(count, seed=1)
    share, error = passed / count, math.sqrt(passed) / count
    print(f"\nrandom payloads: {passed} of {count} pass: {share * 4096:.3f} +- {error * 4096:.3f} times 2^-12")
    assert abs(share - 2**-12) <= 4 * error


def slip_through(chunks: int, seed: int) -> tuple[int, int]:
    """Damaged lines that still have the form of a frame, and how many of them pass the checksum with other contents."""
    sound = {(line[1:4].encode(), bytes.fromhex(line[5:])) for line in lines(stream(12, 36))}
    data = b"".join(line.encode() + b"\r" for line in lines(stream(12, 36)))
    form = re.compile(rb"t(20[0-6]|2[2-4][0-9A-F])8([0-9A-Fa-f]{16})")
    formed = passed = 0
    for chunk in range(chunks):
        for line in spoil(data, seed + chunk, 0.01).split(b"\r"):
            match = form.match(line)  # python-can ignores what follows
            if match is None:
                continue
            payload = bytes.fromhex(match[2].decode())
            if (match[1], payload) in sound:
                continue
            formed += 1
            passed += (payload[6] >> 4 | payload[7] << 4) == frame_crc(int(match[1], 16), payload)
    return formed, passed


def test_share_of_noisy_lines_that_slip_through_the_checksum() -> None:
    """At most what 12 bits promise. Few damaged bytes make short bursts, which the polynomial catches for certain."""
    formed, passed = slip_through(chunks=int(os.environ.get("SELFCAL_SLIP_CHUNKS", "30")), seed=100)
    expected = formed / 4096
    print(f"\nnoisy lines: {passed} of {formed} that look like frames pass the checksum; 2^-12 would be {expected:.1f}")
    assert formed > 10000
    assert passed <= expected + 3 * math.sqrt(expected)


# ----------------------------------------------------------------------------------------- other people's tools alone


def test_python_can_logger_and_cantools_decode(tmp_path: Path) -> None:
    """can_logger writes the stream to a candump file, cantools decodes that: neither knows of our code."""
    sent = stream(13, 3)
    log = tmp_path / "frames.log"
    data = "".join(line + "\r" for line in lines(sent)).encode()
    with serial_line(data) as path:
        command = [sys.executable, "-m", "can.logger", "-i", "slcan", "-c", path, "-b", "500000", "-f", str(log)]
        logger = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        size, end = -1, time.monotonic() + 30
        while (time.monotonic() < end and size != (size := log.stat().st_size if log.exists() else 0)) or size <= 0:
            time.sleep(1.0)
            assert logger.poll() is None, logger.stderr.read() if logger.stderr else ""
        logger.send_signal(SIGINT)  # it writes out what it holds
        logger.wait(10)
    decode = [sys.executable, "-m", "cantools", "decode", "--single-line", str(DBC)]
    with log.open("rb") as stream_in:
        text = subprocess.run(decode, stdin=stream_in, capture_output=True, text=True, check=True).stdout
    rows = [row for row in text.splitlines() if "::" in row]
    assert len(rows) == len(lines(sent))
    for name in ("STATUS", *(axis.upper() for axis in AXES)):
        mine = [row for row in rows if re.search(rf":: {name}(_H\d)?\(", row)]
        assert len(mine) == 3 * (STATUS_FRAMES if name == "STATUS" else REPORT_FRAMES)
    for one in reports_of(sent):
        shown = [float(m[1]) for row in rows if (m := re.search(rf":: {one.message}\(.*\bbias_mean: (\S+)", row))]
        assert one.truth["bias_mean"] in shown


@pytest.mark.parametrize("suffix", ["asc", "blf", "csv", "trc"])
def test_python_can_logs_read_back(suffix: str, tmp_path: Path) -> None:
    """The loggers `selfcal monitor --log` offers keep every frame as it was."""
    frames = [message(line) for line in lines(stream(13, 3))]
    file = tmp_path / f"frames.{suffix}"
    with can.Logger(str(file)) as logger:
        for index, frame in enumerate(frames):
            frame.timestamp = 1.0e9 + 0.001 * index
            logger(frame)
    decoder = Decoder(from_start=True)
    with can.LogReader(str(file)) as reader:
        reports = [report for frame in reader for report in decoder.feed(frame)]
    assert sum(report.complete for report in reports) == 18
    assert decoder.statistics.received == len(frames)


def test_cantools_monitor_shows_the_stream() -> None:
    """The curses monitor of cantools on the same line: its screen names our messages and signals."""
    sent = stream(13, 3)
    data = "".join(line + "\r" for line in lines(sent)).encode()
    with serial_line(data) as path:
        child, screen = pty.fork()
        if child == 0:
            os.environ.update(TERM="linux", LINES="400", COLUMNS="200")
            arguments = ["monitor", "-i", "slcan", "-c", path, "-b", "500000", str(DBC)]
            os.execv(sys.executable, [sys.executable, "-m", "cantools", *arguments])
        # What is on the wire are changes of the picture: a terminal emulator puts it together.
        terminal = pyte.Screen(200, 400)
        emulator = pyte.ByteStream(terminal)
        wanted = [r"A[XYZ]_H1 :: item=13\(", r"N_mean: \S+ m/s\^2/sqrt\(Hz\)", r"Discarded: 0, Errors: 0"]
        picture = ""
        end = time.monotonic() + 60
        while time.monotonic() < end and not all(re.search(part, picture) for part in wanted):
            if select.select([screen], [], [], 0.2)[0]:
                try:
                    emulator.feed(os.read(screen, 65536))
                except OSError:
                    break
                picture = "\n".join(terminal.display)
        os.write(screen, b"q")
        while time.monotonic() < end and os.waitpid(child, os.WNOHANG)[0] == 0:
            if select.select([screen], [], [], 0.2)[0]:
                try:
                    os.read(screen, 65536)
                except OSError:
                    time.sleep(0.1)
        os.close(screen)
    for part in wanted:
        assert re.search(part, picture), f"{part} in\n{picture}"
