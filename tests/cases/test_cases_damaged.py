"""A damaged log gives the rows that it had, or says what is lost; a checksum that a form has is checked.

Truth: the log before a byte of it was changed, and which messages were. Every damage is drawn by a seed.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest

from selfcal.base.errors import UserError
from selfcal.logs.recording import Recording, load
from selfcal.show.results import Recording as Entry
from selfcal.verbs.identify import identify

from conftest import case_records, run, shared_case

pytestmark = pytest.mark.usefixtures("forked")

#: Forms with a checksum over every number: none may change.
CHECKED = ("tlog", "mcap_json", "mcap_protobuf")
#: Forms of lines: what is cut out of one may leave a sound line.
LINES = (".asc", ".trc", ".log")
FORMS = (
    *("ros1", "ros2", "db3", "ulog", "ulog_default", "vehicle_imu", "blackbox", "dataflash", "ros2_mcap"),
    *("hdf5", "mat73", "parquet", "tdms", "mf4", ".blf", *LINES, *CHECKED),
)
#: Damaged logs of a form and a kind: `make test` and `make cases`.
FEW, MANY = 3, 60
#: Bytes that a damage takes; none is a whole number of messages of a form here.
WIDTHS = (1, 1, 3, 17, 199)


@pytest.fixture(scope="module")
def drawn() -> logs.Drawn:
    return logs.Drawn(seconds=6.0, seed=11)


def written(name: str, drawn: logs.Drawn, folder: Path) -> tuple[Path, Path, dict[str, Any]]:
    """A log, the file of it that is damaged, and how it is read."""
    if name[0] == ".":
        path, dbc = logs.write_frames(drawn, folder, name)
        return path, path, {"dbc": dbc}
    path = logs.WRITERS[name](drawn, folder)
    return path, path if path.is_file() else next(path.glob("*.db3")), {}


def spoiled(data: bytes, kind: str, at: int, chance: random.Random) -> bytes:
    """`data` damaged from a place on."""
    made, width = bytearray(data), chance.choice(WIDTHS)
    if kind == "cut":
        return data[:at]
    if kind == "drop":
        del made[at : at + width]
    for k in range(at, min(at + width, len(made))):
        made[k] = {"zero": 0, "flip": made[k] ^ 1 << chance.randrange(8), "drop": made[k]}[kind]
    return bytes(made)


def outcome(path: Path, options: dict[str, Any], sound: Recording) -> str:
    """What a reading comes to: `refused`, `told`, `same`, `changed` numbers in all rows, or `silent`."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            found = load(path, **options)
    except UserError as error:
        assert "\n" not in str(error) and str(error).startswith(str(path))
        return "refused"
    if found.damaged:
        assert 0 <= found.damaged.bytes <= found.damaged.whole and found.damaged.messages > 0
        assert found.damaged.words in said.getvalue()
        return "told"
    if said.getvalue().count("\n") > len(sound.notes):
        return "told"
    counts = [{k: np.isfinite(one.values).sum() for k, one in of.columns.items()} for of in (found, sound)]
    if counts[0] != counts[1] or found.samples != sound.samples:
        return "silent"
    equal = all(np.array_equal(found.columns[k].values, one.values, equal_nan=True) for k, one in sound.columns.items())
    return "same" if equal and np.array_equal(found.time_s, sound.time_s) else "changed"


@pytest.mark.parametrize("name", FORMS)
def test_a_damaged_log_says_so(name: str, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Cut, with bits flipped, bytes zeroed and bytes left out. A log that is cut between two messages is a shorter log:
    a byte less must be told. Without a checksum a damage may make another sound message: once in 50 at most."""
    path, file, options = written(name, drawn, tmp_path)
    data = file.read_bytes()
    with contextlib.redirect_stderr(io.StringIO()):
        sound = load(path, **options)
    assert not sound.damaged
    found: Counter[str] = Counter()
    for kind in ("cut", "flip", "zero", *(() if name in LINES else ("drop",))):
        for trial in range(case_records(FEW, MANY)):
            chance = random.Random(f"{name} {kind} {trial}")
            at = chance.randrange(len(data) // 20, len(data))
            file.write_bytes(spoiled(data, kind, at, chance))
            came = outcome(path, options, sound)
            if came == "silent" and kind == "cut":
                file.write_bytes(data[: at - 1])
                came = outcome(path, options, sound)
            found[came] += 1
    if name in CHECKED:
        assert found["silent"] + found["changed"] == 0, found
    assert found["silent"] <= sum(found.values()) / 50, found
    assert found["told"] + found["refused"] > sum(found.values()) / 4  # the damages are no harmless ones


# ----------------------------------------------------------------------------------------------- counts by their truth


def starts(name: str, data: bytes) -> list[int]:
    """Where the messages with numbers begin in a log of one kind of them."""
    if name == "tlog":
        size = 8 + data[9] + 12
        return list(range(0, len(data), size))
    if name == "dataflash":
        first = data.index(b"\xa3\x95\x8c")
        return list(range(first, len(data), 40))
    found, at = [], 16
    while at < len(data):
        if data[at + 2 : at + 3] == b"D":
            found.append(at)
        at += 3 + int.from_bytes(data[at : at + 2], "little")
    return found


@pytest.mark.parametrize("name", ["tlog", "dataflash", "vehicle_imu"])
@pytest.mark.parametrize("count", [1, 7])
def test_the_count_is_exact(name: str, count: int, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Messages apart from each other lose the byte by which they are known: so many, and all of their bytes."""
    path = logs.WRITERS[name](drawn, tmp_path)
    sound, data = load(path), bytearray(path.read_bytes())
    places = starts(name, bytes(data))
    size = places[1] - places[0]
    for k in range(count):
        data[places[20 + 70 * k] + {"tlog": 40, "dataflash": 1, "vehicle_imu": 2}[name]] ^= 0x21
    path.write_bytes(data)
    hurt = load(path)
    assert (hurt.damaged.bytes, hurt.damaged.messages, hurt.damaged.whole) == (count * size, count, len(data))
    assert hurt.samples == sound.samples - count
    kept = np.delete(np.arange(sound.samples), [20 + 70 * k for k in range(count)])
    for axis in ("gx", "az"):
        assert np.array_equal(hurt.columns[axis].values, sound.columns[axis].values[kept])


def test_no_number_of_a_damaged_chunk(drawn: logs.Drawn, tmp_path: Path) -> None:
    """MCAP: the messages of a chunk whose checksum does not fit are left out, all others are as they were."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "chunks.mcap"
    for packing in (CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4):
        with path.open("wb") as stream:
            writer = Writer(stream, chunk_size=6000, compression=packing)
            writer.start()
            schema = writer.register_schema("imu", "jsonschema", b"{}")
            channel = writer.register_channel("/imu", "json", schema)
            for ns, row in zip(drawn.ns.tolist(), drawn.gyro.tolist(), strict=True):
                message = {"stamp": {"sec": ns // 10**9, "nsec": ns % 10**9}}
                message |= {"angular_velocity": dict(zip("xyz", row, strict=True))}
                writer.add_message(channel, ns, json.dumps(message).encode(), ns)
            writer.finish()
        data = path.read_bytes()
        chunks, at = [], 8
        while at < len(data) - 8:
            end = at + 9 + struct.unpack_from("<Q", data, at + 1)[0]
            chunks += [(at, end)] if data[at] == 6 else []
            at = end
        assert len(chunks) > 3
        for at, end in chunks[:3]:
            hurt = bytearray(data)
            hurt[(at + end) // 2] ^= 0x10
            path.write_bytes(hurt)
            recording = load(path)
            lost = recording.damaged.messages
            assert recording.samples == drawn.t.size - lost and 10 < lost < drawn.t.size / 3
            assert recording.damaged.bytes == end - at
            gx = recording.columns["gx"].values
            first = (
                int(np.argmax(gx != drawn.gyro[: gx.size, 0])) if (gx != drawn.gyro[: gx.size, 0]).any() else gx.size
            )
            assert np.array_equal(gx, np.delete(drawn.gyro[:, 0], slice(first, first + lost)))
        path.write_bytes(data)
        assert not load(path).damaged


def test_the_whole_file_s_checksum(drawn: logs.Drawn, tmp_path: Path) -> None:
    """MCAP without chunks has one checksum for all messages: a changed number is refused."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "plain.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start()
        channel = writer.register_channel("/imu", "json", writer.register_schema("imu", "jsonschema", b"{}"))
        for ns, row in zip(drawn.ns.tolist(), drawn.gyro.tolist(), strict=True):
            stamp = {"sec": ns // 10**9, "nsec": ns % 10**9}
            message = {"stamp": stamp, "angular_velocity": dict(zip("xyz", row, strict=True))}
            writer.add_message(channel, ns, json.dumps(message).encode(), ns)
        writer.finish()
    data = path.read_bytes()
    assert load(path).samples == drawn.t.size
    place = data.index(b'"x": ', len(data) // 2) + 9
    path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    with pytest.raises(UserError, match="the checksum of its data does not fit"):
        load(path)


def test_the_case_of_a_changed_chunk(drawn: logs.Drawn, tmp_path: Path) -> None:
    sound = logs.write_mcap_protobuf(drawn, tmp_path)
    hurt = shared_case("S02_mcap_crc.py", tmp_path, str(sound), str(tmp_path / "hurt.mcap"))
    with pytest.raises(UserError, match=r"hurt\.mcap: damaged: .* % of the file could not be read"):
        load(hurt)


# ------------------------------------------------------------------------------------------------- no damage, and words


def test_what_is_no_damage(drawn: logs.Drawn, tmp_path: Path) -> None:
    """Messages of MAVLink that the dialect does not know; a chip's bytes that were never written."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None)
    path = logs.write_tlog(drawn, tmp_path)
    data = path.read_bytes()
    size = 8 + data[9] + 12
    frame = dialect.MAVLink_attitude_message(5, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    frame._header.msgId, frame.crc_extra = 54321, 77
    foreign = struct.pack(">Q", 99) + frame.pack(link)
    assert 54321 not in dialect.mavlink_map
    mixed = b"".join(data[at : at + size] + foreign for at in range(0, len(data), size))
    path.write_bytes(mixed)
    assert load(path).samples == drawn.t.size and not load(path).damaged
    path.write_bytes(mixed.replace(foreign, foreign[:30] + b"\x55" + foreign[31:], 2))
    assert load(path).damaged.messages == 2
    for name in ("dataflash", "blackbox"):
        path = logs.WRITERS[name](drawn, tmp_path)
        path.write_bytes(path.read_bytes() + b"\xff" * 3000)
        assert load(path).samples == drawn.t.size and not load(path).damaged


def hurt_tlog(drawn: logs.Drawn, folder: Path) -> tuple[Path, int]:
    """A log of 600 messages, ten of which are damaged, and the bytes of a message."""
    path = logs.write_tlog(drawn, folder)
    data = bytearray(path.read_bytes())
    size = 8 + data[9] + 12
    for k in range(10):
        data[(30 + 50 * k) * size + 25] ^= 4
    path.write_bytes(data)
    return path, size


def test_every_output_says_it(drawn: logs.Drawn, tmp_path: Path) -> None:
    """A line on the terminal of every verb that reads, the count in JSON; of a sound log nothing."""
    path, size = hurt_tlog(drawn, tmp_path)
    words = "1.7 % of the file could not be read: 10 messages or more"  # 10 of 600
    document = identify(path, axes=("gx",), suspicion=False)
    assert document["recording"]["damaged"] == {"bytes": 10 * size, "messages": 10, "words": words}
    assert words in document["recording"]["notes"]
    assert isinstance(document.recording, Entry) and document.recording.damaged is not None
    assert document.recording.damaged.messages == 10
    for verb in (("convert", path, "-o", tmp_path / "out.csv"), ("identify", path, "--axis", "gx")):
        done = run(*verb)
        assert done.returncode == 0 and f"selfcal: {path}: {words}\n" in done.stderr
    done = run("identify", tmp_path / "out.csv", "--axis", "gx", "--json", "-")
    assert "damaged" not in json.loads(done.stdout)["recording"] and "could not be read" not in done.stderr


def test_a_batch_names_it(drawn: logs.Drawn, tmp_path: Path) -> None:
    path, _ = hurt_tlog(drawn, tmp_path)
    done = run("fleet", path, "-o", tmp_path / "t.csv", "--workers", "1", "--axis", "gx")
    assert done.returncode == 0 and f"{path}: 1.7 % of the file could not be read" in done.stderr


def test_lines_that_were_skipped_count(drawn: logs.Drawn, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{t:.2f},{gx:.6f}\n" for t, gx in zip(drawn.t, drawn.gyro[:, 0], strict=True)]
    rows[100], rows[300] = "12 apples\n", ",,,\n"
    path.write_text("t[s],gx[rad/s]\n" + "".join(rows))
    hurt = load(path, skip_bad=True)
    assert (hurt.damaged.bytes, hurt.damaged.messages) == (14, 2)
    assert hurt.samples == len(rows) - 2
    path.write_text("t[s],gx[rad/s]\n" + "".join(rows[400:])[:-3])
    assert load(path).damaged.messages == 1


@pytest.mark.parametrize(
    ("suffix", "spoil"), [(".asc", lambda line: line[:9] + b"!" + line[10:]), (".trc", bytes.swapcase)]
)
def test_lines_of_frames(suffix: str, spoil: Callable[[bytes], bytes], drawn: logs.Drawn, tmp_path: Path) -> None:
    path, dbc = logs.write_frames(drawn, tmp_path, suffix)
    lines = path.read_bytes().splitlines(keepends=True)
    sound = load(path, dbc=dbc)
    places = (100, 333, 700)
    for at in places:
        lines[at] = b"?" + spoil(lines[at])[1:]
    path.write_bytes(b"".join(lines))
    hurt = load(path, dbc=dbc)
    assert hurt.damaged.messages == 3
    assert hurt.damaged.bytes == pytest.approx(
        sum(len(lines[at]) for at in places), abs=3
    )  # ends of lines, as one sign
    assert sound.samples - 3 <= hurt.samples <= sound.samples
