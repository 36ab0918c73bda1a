"""`monitor --stream` and `--log x.mcap`, read by clients that know nothing of selfcal: sockets, websockets, json, mcap.

Truth: the values that tests/lib/telemetry_stream.c sent, and for `selfcal demo` what the frame log of the same run
holds.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from test_replay_can import COMMAND, demonstration
from websockets.sync.client import connect

from selfcal.base.errors import UserError
from selfcal.logs.framelog import LONGEST_LINE, FrameLog
from selfcal.verbs.monitor import monitor
from selfcal.wire.frames import Decoder
from selfcal.wire.streams import McapLog, check_stream

from conftest import CASE_RECORDS
from wire_stream import AXES, lines, stream


def frames(path: Path, sent: list[str]) -> Path:
    """SLCAN lines as candump logs them, a millisecond apart."""
    text = [f"({1e3 + 1e-3 * k:.6f}) can0 {line[1:4]}#{line[5:]}\n" for k, line in enumerate(sent)]
    path.write_text("".join(text))
    return path


def sent_reports(seed: int, count: int) -> list[tuple[str, float]]:
    """Axis and bias of each report, in their order."""
    return [(one.message.lower(), one.truth["bias_mean"]) for one in stream(seed, count) if one.message in AXES]


@contextmanager
def datagrams(server: socket.socket) -> Iterator[list[dict[str, Any]]]:
    """What comes by UDP during the block, and what is on its way at the end of it."""
    told: list[dict[str, Any]] = []
    over = threading.Event()

    def run() -> None:
        while True:
            try:
                told.append(json.loads(server.recv(1 << 16)))
            except TimeoutError:
                if over.is_set():
                    return

    server.settimeout(0.2)
    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield told
    finally:
        over.set()
        thread.join()


def test_udp_has_each_report_once_and_in_order(tmp_path: Path) -> None:
    """Numbers come as the wire has them: float32, exactly."""
    log = frames(tmp_path / "in.log", lines(stream(31, 4)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        with datagrams(server) as told:
            monitor(read=log, stream=[f"udp-json:127.0.0.1:{server.getsockname()[1]}"])
    found = [(axis, numbers) for one in told for axis, numbers in one["node0"].items()]
    assert [(axis, numbers["bias"]["mean"]) for axis, numbers in found] == sent_reports(31, 4)
    assert all(numbers["complete"] for _, numbers in found)
    stamps = [one["timestamp"] for one in told]
    assert stamps == sorted(stamps) and 1e3 <= stamps[0] < stamps[-1] < 1e3 + 2.0  # the log's, in s
    first = next(one for one in stream(31, 4) if one.message == "GX")
    laws = next(numbers for axis, numbers in found if axis == "gx")["laws"]
    assert [law["probability"] for law in laws.values()] == [first.truth[f"h{k}_probability"] for k in range(3)]


def test_lines_on_stdout_and_nothing_else(tmp_path: Path) -> None:
    log = frames(tmp_path / "in.log", lines(stream(32, 3)))
    command = [*COMMAND, "monitor", "--read", str(log), "--stream", "jsonl", "--axis", "gy"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    expected = [mean for axis, mean in sent_reports(32, 3) if axis == "gy"]
    assert [one["node0"]["gy"]["bias"]["mean"] for one in told] == expected


def test_a_report_that_lost_frames_states_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What did not come is not there; the report is, once."""
    sent = stream(33, 2)
    first = next(one for one in sent if one.message == "AX")
    log = frames(tmp_path / "in.log", [line for line in lines(sent) if line != first.lines[2]])
    monitor(read=log, stream=["jsonl"], axes=["ax"])
    told = [json.loads(line)["node0"]["ax"] for line in capsys.readouterr().out.splitlines()]
    assert [one["complete"] for one in told] == [False, True]


def test_mcap_has_frames_and_reports_and_is_read_back(tmp_path: Path) -> None:
    """By the library of the format; and `--read` gives the run again."""
    sent = lines(stream(34, 3))
    monitor(read=frames(tmp_path / "in.log", sent), log=tmp_path / "run.mcap", json=tmp_path / "a.json")
    topics: dict[str, list[dict[str, Any]]] = {}
    with (tmp_path / "run.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            topics.setdefault(channel.topic, []).append(json.loads(message.data))
    assert len(topics.pop("/selfcal/frames")) == len(sent)
    expected: dict[str, list[float]] = {}
    for axis, mean in sent_reports(34, 3):
        expected.setdefault(f"/selfcal/node0/{axis}", []).append(mean)
    assert {topic: [one["bias"]["mean"] for one in told] for topic, told in topics.items()} == expected
    monitor(read=tmp_path / "run.mcap", json=tmp_path / "b.json")
    first, again = (json.loads((tmp_path / name).read_text())["axes"] for name in ("a.json", "b.json"))
    assert first == again and set(first) == {axis.lower() for axis in AXES}


def test_a_killed_mcap_is_read_and_a_hostile_one_takes_no_memory(tmp_path: Path) -> None:
    """Cut anywhere behind its frames' channel it gives the whole frames before; a record that states 4 GB ends it."""
    sent = lines(stream(35, 2))
    monitor(read=frames(tmp_path / "in.log", sent), log=tmp_path / "run.mcap")
    whole = (tmp_path / "run.mcap").read_bytes()
    for share in (0.3, 0.5, 0.8):
        (tmp_path / "cut.mcap").write_bytes(whole[: int(share * len(whole))])
        with FrameLog(tmp_path / "cut.mcap") as log:
            count = 0
            while log.recv(0.0) is not None:
                count += 1
            assert log.damage
        assert 0 < count < len(sent)
    with (tmp_path / "big.mcap").open("wb") as file:
        writer = McapLog(file)
        file.write(struct.pack("<BQ", 5, 1 << 32))
        file.write(b"\0" * (2 * LONGEST_LINE))
        assert writer is not None
    with pytest.raises(UserError, match="no frame log"):
        FrameLog(tmp_path / "big.mcap")


def foxglove_client(port: int, told: list[tuple[str, dict[str, Any]]], ends: threading.Event) -> None:
    """Subscribes to every channel that is advertised, and keeps what comes."""
    deadline = time.monotonic() + 60.0
    while True:
        try:
            link = connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])  # type: ignore[list-item]
            break
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.05)
    topics: dict[int, str] = {}
    with link:
        while not ends.is_set():
            try:
                message = link.recv(timeout=0.2)
            except TimeoutError:
                continue
            except Exception:  # the server has gone
                return
            if isinstance(message, str):
                said = json.loads(message)
                new = said.get("channels", [])
                topics |= {one["id"]: one["topic"] for one in new}
                ids = [one["id"] for one in new]
                if "Unknown channel" in said.get("message", ""):  # the server advertises it before it knows it
                    time.sleep(0.05)
                    ids = [int(said["message"].rpartition(" ")[2])]
                wanted = [{"id": one, "channelId": one} for one in ids]
                if wanted:
                    link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            elif message[0] == 1:
                subscription, _ = struct.unpack_from("<IQ", message, 1)
                told.append((topics[subscription], json.loads(message[13:])))


def test_demo_is_streamed_whole(tmp_path: Path) -> None:
    """UDP and websocket at once, of a quarter of an hour of `demo`, in `make cases` of an hour. Truth: the reports that
    a decoder makes of the frames in the log of the same run. The websocket's client may come after the first ones, to
    each channel by itself."""
    pytest.importorskip("foxglove")
    seconds, speed = (3600.0, 120.0) if CASE_RECORDS else (900.0, 100.0)
    seen: list[tuple[str, dict[str, Any]]] = []
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ends = threading.Event()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server,
        demonstration("--speed", f"{speed:g}") as (_, watch),
    ):
        server.bind(("127.0.0.1", 0))
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        viewer = threading.Thread(target=foxglove_client, args=(port, seen, ends))
        viewer.start()
        command = [*COMMAND, "monitor", "--channel", watch.split()[-1], "--log", str(tmp_path / "run.log")]
        command += ["--stream", f"udp-json:127.0.0.1:{server.getsockname()[1]}"]
        command += ["--stream", f"foxglove:127.0.0.1:{port}", "--duration", f"{seconds / speed + 2.0:g}"]
        with datagrams(server) as told:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        ends.set()
        viewer.join()
    decoder, expected = Decoder(), []
    with FrameLog(tmp_path / "run.log") as log:
        while (frame := log.recv(0.0)) is not None:
            expected += decoder.feed(frame)
    expected += decoder.flush()
    truth = [(one.axis, one.time_s, one.value("bias_mean")) for one in expected]
    assert len(truth) >= 0.5 * 6 * seconds / speed, done.stderr
    found = [(axis, one["time_s"], one["bias"].get("mean")) for d in told for axis, one in d["node0"].items()]
    assert found == truth
    by_socket = [(one["axis"], one["time_s"], one["bias"].get("mean")) for _, one in seen]
    places = [truth.index(one) for one in by_socket]
    assert places == sorted(set(places))
    for axis in {one[0] for one in truth}:  # a channel at a time is subscribed: from then on nothing is lost
        of_axis = [place for place, one in enumerate(truth) if one[0] == axis]
        got = [place for place in places if truth[place][0] == axis]
        assert got == of_axis[-len(got) :]
        assert 3 * len(got) >= len(of_axis)  # a loaded machine takes seconds until the client has subscribed
    assert all(topic == f"/selfcal/node0/{one['axis']}" for topic, one in seen)


@pytest.mark.parametrize(
    "wanted",
    ["csv", "ros", "ros:0", "ros:a:1", "udp-json:1", "udp-json:h:0", "udp-json:h:7e4", "jsonl:a:1", "foxglove::9"],
)
def test_wrong_streams_are_one_line(wanted: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--stream"):
        check_stream(wanted)
    for both in ({"stream": ["jsonl"], "json": "-"}, {"stream": ["ros:50", "jsonl"]}):
        with pytest.raises(UserError, match="both for stdout"):
            monitor(read=tmp_path / "x.log", **both)


def test_ros_messages_are_those_of_its_definitions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`rosbags` has the definitions of ROS 2: each message is written by them and read back. Truth: the reports' own
    numbers; a reading's variance is N^2 times the rate, its bias' beside it."""
    stores = pytest.importorskip("rosbags.typesys")
    types = stores.get_typestore(stores.Stores.ROS2_HUMBLE)

    def made(kind: str, told: Any) -> Any:
        """The message of a type."""
        if not isinstance(told, dict):
            return told
        fields = types.get_msgdef(kind).fields
        assert set(told) == {name for name, _ in fields}
        found = {}
        for name, (_, of) in fields:
            inner = told[name]
            if name in ("status", "values"):
                found[name] = [made(of[0][1], one) for one in inner]
            elif isinstance(inner, list):
                found[name] = np.array(inner)
            else:
                found[name] = made(of if isinstance(of, str) else "", inner)
        return types.types[kind](**found)

    monitor(read=frames(tmp_path / "in.log", lines(stream(37, 2))), stream=["ros:250"])
    sent = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {one["topic"] for one in sent} == {"/diagnostics", "/selfcal/node0/imu"}
    for one in sent:
        message = made(one["type"], one["msg"])
        back = types.deserialize_cdr(types.serialize_cdr(message, one["type"]), one["type"])
        assert back.header.stamp.sec == 1000
        if one["topic"] == "/diagnostics":
            assert back.status[0].hardware_id == "node0" and len(back.status[0].values) >= 4
    first, last = (one["msg"] for one in (sent[1], sent[-1]))
    assert first["linear_acceleration_covariance"][0] == first["orientation_covariance"][0] == -1.0
    reports = {one.message: one.truth for one in stream(37, 2) if one.message in AXES}  # the last of each axis
    for message, field, factor, axes in (
        (last, "angular_velocity", np.pi / 180.0, ("GX", "GY", "GZ")),
        (last, "linear_acceleration", 1.0, ("AX", "AY", "AZ")),
    ):
        for k, axis in enumerate(axes):
            truth = reports[axis]
            law = max(range(3), key=lambda h: truth[f"h{h}_probability"])
            variance = (truth[f"h{law}_N_mean"] ** 2 * 250.0 + truth["bias_sd"] ** 2) * factor**2
            assert message[f"{field}_covariance"][4 * k] == pytest.approx(variance, rel=1e-6)
            assert message[field]["xyz"[k]] == pytest.approx(truth["bias_mean"] * factor, rel=1e-6)


def test_a_taken_port_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    log = frames(tmp_path / "in.log", lines(stream(36, 1)))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UserError, match=r"--stream foxglove: 127\.0\.0\.1:"):
            monitor(read=log, stream=[f"foxglove:127.0.0.1:{taken.getsockname()[1]}"])
