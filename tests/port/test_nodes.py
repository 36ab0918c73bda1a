"""Modules of any model, and several on one bus: names, nodes and versions, from the firmware to the monitor's JSON.

Truth: the library over the same samples, called directly; the DBC files that `selfcal dbc` writes, read by cantools.
"""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from test_replay import NAT_TOLERANCE, P_TOLERANCE, SD_TOLERANCE, part_of_shipped

from selfcal.adequacy.one_over_f import with_white
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.logs.recording import Recording, load
from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.verbs.dbc import dbc
from selfcal.verbs.monitor import monitor
from selfcal.verbs.replay import replay
from selfcal.wire import frames as wire
from selfcal.wire.frames import ROOT, Decoder
from selfcal.wire.known_models import KnownModels
from selfcal.wire.replay import build, can_bus, write_rows

from conftest import needs_multicast, run
from wire_stream import lines, message, serial_line, stream

SUMS = ROOT / "tools" / "selfcal" / "model" / "models" / "sums.yaml"


def text_of(sent_lines: list[str]) -> bytes:
    return "".join(line + "\r" for line in sent_lines).encode()


def library(recording: Recording, model: Model, axes: tuple[str, ...]) -> dict[str, Any]:
    """The library without firmware and wire."""
    bank = Bank(make_tables(model, recording.rate_hz, axes))
    samples = [recording.in_unit(name, model.group_of(name).unit).astype("f4") for name in axes]
    for missing, row in zip(recording.missing_before, zip(*samples, strict=True), strict=True):
        if missing:
            bank.raw.skip(int(missing))
        bank.push([row])
    return {name: bank.report(index) for index, name in enumerate(axes)}


def assert_result(axis: dict[str, Any], want: Any) -> None:
    """Probabilities to 1e-4, evidence differences to 0.01 nat, the rest to 1e-3 posterior sd."""
    assert list(axis["hypotheses"]) == list(want.probability)
    best = max(axis["log_evidence"].values()), max(want.log_evidence.values())
    for law, probability in want.probability.items():
        assert abs(axis["hypotheses"][law] - probability) <= P_TOLERANCE
        assert abs(axis["log_evidence"][law] - best[0] - (want.log_evidence[law] - best[1])) <= NAT_TOLERANCE
        assert list(axis["parameters"][law]) == list(want.parameters[law])
        for parameter, estimate in want.parameters[law].items():
            for statistic in ("mean", "median", "sd", "q05", "q95"):
                difference = axis["parameters"][law][parameter][statistic] - getattr(estimate, statistic)
                assert abs(difference) <= SD_TOLERANCE * estimate.sd, (law, parameter, statistic)
    assert abs(axis["bias_now"]["mean"] - want.bias_mean) <= SD_TOLERANCE * want.bias_sd


def test_a_model_of_sums_goes_over_the_wire(tmp_path: Path) -> None:
    """Six laws, three of them sums: the firmware's answer is the library's, N of 1/f noise beside it in both."""
    recording = load(part_of_shipped(tmp_path / "part.npz"))
    model = Model.load(SUMS)
    found = replay(tmp_path / "part.npz", axes=("gx",), model=SUMS, report_every=600.0, plot=tmp_path / "run.png")
    tables = make_tables(model, recording.rate_hz, ("gx",))
    at = tables.dt_s, int(recording.duration_s / tables.dt_s), tables.block
    want = with_white(library(recording, model, ("gx",))["gx"], model.group_of("gx"), *at)
    assert_result(found["axes"]["gx"], want)
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


class Playing:
    """The host firmware of a node over a recording, its frames on a CAN bus, begun after a second."""

    def __init__(self, folder: Path, bus: str, recording: Recording, model: Model, axes: Sequence[str], node: int):
        firmware = build(model, recording.rate_hz, axes)
        rows = folder / f"rows{node}.bin"
        write_rows(recording, model, axes, rows)
        command = [str(firmware), str(rows), "--report-every", "100", "--can", bus, "--node", str(node)]
        self.process = subprocess.Popen(["sh", "-c", 'sleep 1; exec "$@"', "sh", *command], stdout=subprocess.DEVNULL)


@needs_multicast
def test_two_modules_on_one_bus_are_not_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Node 0 runs the default model on two axes, node 3 the one with sums on one of them, at the same time.

    One monitor: each has its own counters, names and numbers. The log keeps both, and the DBC file of one reads it."""
    recording = load(part_of_shipped(tmp_path / "part.npz"))
    plain, sums = Model.load(), Model.load(SUMS)
    bus, link = can_bus("")
    monkeypatch.setattr("selfcal.wire.frames.open_bus", lambda *_, **__: link)
    modules = [
        Playing(tmp_path, bus, recording, plain, ("gx", "az"), 0),
        Playing(tmp_path, bus, recording, sums, ("gx",), 3),
    ]
    outcome = monitor(
        interface="udp_multicast",
        channel="the bus",
        model=SUMS,
        duration=10.0,
        log=tmp_path / "frames.log",
        json=tmp_path / "both.json",
        plot=tmp_path / "run.png",
    )
    assert [module.process.wait(30) for module in modules] == [0, 0]
    frames = 6 * (46 + 2 * 52) + 46 + 6 * (46 + 7 + 8 + 13 + 4 * 18 + 6) + 46
    assert (outcome.received, outcome.lost, outcome.damaged, outcome.refused) == (frames, 0, 0, 0)
    assert not outcome.contact_lost
    said = capfd.readouterr().err
    assert "node 0   module time 600.0 s   finished" in said
    assert "node 3   module time 600.0 s   finished" in said
    document = json.loads((tmp_path / "both.json").read_text())
    assert document["schema"] == "selfcal.modules/1"
    assert {number: one["node"] for number, one in document["modules"].items()} == {"0": 0, "3": 3}
    truth = {"0": library(recording, plain, ("gx", "az")), "3": library(recording, sums, ("gx",))}
    for number, axes in truth.items():
        assert list(document["modules"][number]["axes"]) == list(axes)
        for name, want in axes.items():
            assert_result(document["modules"][number]["axes"][name], want)
    for number in (0, 3):
        assert (tmp_path / f"run-node{number}.png").read_bytes().startswith(b"\x89PNG")

    monitor(read=tmp_path / "frames.log", node=3, model=SUMS, json=tmp_path / "one.json")
    alone = json.loads((tmp_path / "one.json").read_text())
    assert alone["axes"] == document["modules"]["3"]["axes"]
    assert alone["node"] == 3

    database = cantools.database.load_string(dbc(SUMS, node=3, output=tmp_path / "three.dbc"), "dbc")
    assert (tmp_path / "three.dbc").read_text().startswith('VERSION "4"')
    last: dict[str, Any] = {}
    with can.LogReader(str(tmp_path / "frames.log")) as reader:
        for frame in reader:
            if frame.arbitration_id >= 0x200 + 3 * 128:
                entry = database.get_message_by_frame_id(frame.arbitration_id)
                values = entry.decode(bytes(frame.data), decode_choices=False)
                assert isinstance(values, dict)
                last |= {f"{entry.name}.{name}": value for name, value in values.items()}
    gx = document["modules"]["3"]["axes"]["gx"]
    assert (
        last["M3_GX_WALK_AND_MARKOV.markov_ratio_median"]
        == gx["parameters"]["walk_and_markov"]["markov_ratio"]["median"]
    )
    assert last["M3_GX_FLICKER.probability"] == gx["hypotheses"]["flicker"]
    assert last["M3_GX.bias_mean"] == gx["bias_now"]["mean"]


def status_of(tables: Any) -> dict[str, float]:
    return {"model_id": float(tables.id), "bank_interval": tables.dt_s, "bank_block": float(tables.block)}


@pytest.mark.parametrize("rate_hz", [819.2, 100.0, 10.0, 0.3])
def test_a_module_s_model_is_known_by_its_id(rate_hz: float) -> None:
    """For every target, every choice of axes and every rate: the names of the model whose tables they are."""
    models = KnownModels(SUMS)
    for path in (None, SUMS):
        model = Model.load(path)
        for target in model.nodes:
            for axes in (model.axes, ("gx",), ("gy", "ax", "az")):
                names = models.names(status_of(make_tables(model, rate_hz, axes, target)))
                assert names.hypotheses == tuple(model.hypotheses)
    assert not models.names(status_of(make_tables(Model.load(), rate_hz)) | {"model_id": 7.0}).known
    assert models.advice({"model_id": 7.0, "bank_interval": 1.0, "bank_block": 10.0}).endswith("--model FILE")


@pytest.mark.parametrize("interval", [0.0, -1.0, 1e-38, 3e38, float("inf"), float("nan")])
@pytest.mark.parametrize("block", [0.0, 1.0, 2.0**32 - 1.0])
def test_no_model_has_hostile_intervals(interval: float, block: float) -> None:
    assert not KnownModels().names({"model_id": 1.0, "bank_interval": interval, "bank_block": block}).known


def of_version_3(line: str) -> str:
    """A line as a module of wire version 3 sends it: item 1 of its status is 3."""
    frame = message(line)
    bits = int.from_bytes(frame.data, "little")
    if frame.arbitration_id != 0x200 or bits >> 32 & 0x3F != 1:
        return line
    bits = bits & ~0xFFFFFFFF & (1 << 52) - 1 | 3
    bits |= wire.frame_crc(frame.arbitration_id, bits.to_bytes(8, "little")) << 52
    return f"{line[:5]}{bits.to_bytes(8, 'little').hex().upper()}"


def test_a_module_of_version_3_is_refused_by_the_monitor(tmp_path: Path) -> None:
    """Live and from a log, with the version in the message, and without a number of it."""
    sent = [of_version_3(line) for line in lines(stream(21, 3))]
    complaint = "the module speaks wire version 3, this tool reads version 4: "
    with serial_line(text_of(sent)) as path, pytest.raises(UserError, match=complaint):
        monitor(channel=path, duration=20.0, json=tmp_path / "none.json")
    with can.Logger(str(tmp_path / "old.log")) as logger:
        for line in sent:
            logger(message(line))
    done = run("monitor", "--read", tmp_path / "old.log")
    assert done.returncode == 2
    assert complaint in done.stderr.splitlines()[-1]
    assert "bias" not in done.stderr
    assert not (tmp_path / "none.json").exists()


def test_a_firmware_of_another_version_is_refused_by_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here it is the tool that is of another version."""
    part_of_shipped(tmp_path / "part.npz", 60.0)
    monkeypatch.setattr(wire, "version", lambda: 5)
    with pytest.raises(UserError, match="the module speaks wire version 4, this tool reads version 5: "):
        replay(tmp_path / "part.npz", axes=("gx",))


def test_an_old_module_beside_a_new_one_does_not_end_the_view(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Node 0 speaks version 3: said so in its place. Node 5's reports are shown and written."""
    old = [of_version_3(line) for line in lines(stream(21, 3))]
    new = lines(stream(22, 3, node=5))
    with can.Logger(str(tmp_path / "both.log")) as logger:
        for pair in zip(old, new, strict=True):
            for line in pair:
                logger(message(line))
    monitor(read=tmp_path / "both.log", json=tmp_path / "new.json")
    assert "the module speaks wire version 3, this tool reads version 4" in " ".join(capfd.readouterr().err.split())
    assert json.loads((tmp_path / "new.json").read_text())["node"] == 5


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["dbc", "--node", "12", str(SUMS)], "--node 12: a bus has nodes 0 to 11"),
        (["dbc", "no-such.yaml"], "cannot read the model file"),
        (["dbc", str(SUMS), "-o", "/no-such-folder/x.dbc"], "there is no folder"),
        (["monitor", "--channel", "x", "--node", "-1"], "--node -1: a bus has nodes 0 to 11"),
        (["monitor", "--channel", "x", "--model", "no-such.yaml"], "cannot read the model file"),
        (["demo", "--node", "12"], "--node 12: a bus has nodes 0 to 11"),
        (["command", "save", "--node", "12", "--channel", "x"], "--node 12: a bus has nodes 0 to 11"),
    ],
)
def test_user_errors_are_one_line(options: list[str], complaint: str) -> None:
    done = run(*options)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_command_goes_to_its_node() -> None:
    """And the answer of another node is none: here node 4 says what node 2 was asked."""
    from selfcal.wire import command

    assert command.frame(bytes(8), 0).arbitration_id == 0x208
    assert command.frame(bytes(8), 2).arbitration_id == 0x208 + 2 * 128
    heard: list[can.Message] = []
    with can.Bus(interface="virtual", channel="selfcal-nodes") as bus:

        def modules() -> None:
            order = bus.recv(10.0)
            assert order is not None
            heard.append(order)
            for node in (4, 2):
                bits = node | 0 << 32
                identifier = 0x209 + node * 128
                bits |= wire.frame_crc(identifier, bits.to_bytes(8, "little")) << 52
                bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=bits.to_bytes(8, "little")))

        thread = threading.Thread(target=modules)
        thread.start()
        with wire.open_bus("virtual", "selfcal-nodes") as link:
            link.bus.send(command.frame(command.payload("challenge"), 2))
            assert command.answer_in(link, "challenge", 10.0, 1, 2) == 2
        thread.join()
    assert heard[0].arbitration_id == 0x208 + 2 * 128


def test_a_decoder_of_a_node_takes_nothing_of_another() -> None:
    decoder = Decoder(node=1)
    for line in lines(stream(21, 1)):
        decoder.feed(message(line))
    assert decoder.statistics.received == 0
