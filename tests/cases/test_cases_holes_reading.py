"""Holes of readers: a log that is run, that names other files, that never ends, that unpacks to gigabytes."""

from __future__ import annotations

import errno
import gzip
import json
import os
import re
import resource
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest

from selfcal.base.errors import UserError
from selfcal.base.limits import read_text, reading
from selfcal.base.output import check_writable
from selfcal.logs.framelog import WRITTEN
from selfcal.logs.loaders import FORMATS, TEXT, ZIP, child
from selfcal.logs.loaders.table import Hints
from selfcal.logs.recording import load, save
from selfcal.model.file import DEFAULT, Model
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.fleet import fleet
from selfcal.verbs.identify import identify
from selfcal.verbs.response import response
from selfcal.wire.command import read_key
from selfcal.wire.frame_writer import FrameWriter

from conftest import COMMAND, run

SUFFIXES = (*TEXT, ZIP, *(suffix for one in FORMATS for suffix in one.suffixes))
#: Writers of binary logs, one a format and storage.
BINARY = ("ros1", "ros2", "db3", "ulog", "blackbox", "dataflash", "tlog", "mcap_protobuf", "hdf5", "mat73", "parquet",
          "tdms", "mf4")  # fmt: skip
#: What a process does beyond reading files, by the names of Python's audit events.
DOES = ("subprocess.", "os.exec", "os.posix_spawn", "os.spawn", "os.system", "os.fork", "socket.connect", "socket.bind",
        "socket.sendto", "socket.getaddrinfo", "pty.", "sqlite3.")  # fmt: skip


@pytest.fixture
def short() -> logs.Drawn:
    """Half a second of an IMU."""
    return logs.Drawn(seconds=0.5, seed=5)


@pytest.fixture
def watched(forked: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Readers tell, by a call of this, what they did beyond reading, and which files under tmp_path they opened."""
    seen = tmp_path.with_name(f"{tmp_path.name}.seen")
    seen.touch()
    answer = child.answer

    def told(module: str, path: Path, hints: Hints, to: int) -> None:
        out = seen.open("a", encoding="utf-8", errors="backslashreplace")

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            if event.startswith(DOES):
                print(event, arguments, file=out, flush=True)
            if event in ("open", "os.remove", "os.rename") and not isinstance(arguments[0], int):
                place = Path(os.fsdecode(arguments[0])).resolve()
                if tmp_path in place.parents:
                    print(place, file=out, flush=True)

        sys.addaudithook(hook)
        answer(module, path, hints, to)

    monkeypatch.setattr(child, "answer", told)
    return lambda: list(dict.fromkeys(seen.read_text().splitlines()))


# ---------------------------------------------------------------------------------------------------- a log that is run


def script(path: Path) -> Path:
    """A program that leaves a mark beside the folder of `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\ntouch {path.parent.parent}/RUN\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("name", ["bin/log", "udp:log", "mcast:1", "http:/127.0.0.1/log", "file:log", "|log"])
def test_no_reader_runs_a_log(
    name: str, tmp_path: Path, watched: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program under the name of every format, in a folder bin/ and by names that a library may take for a place on
    the network: one line, nothing is run or called, and the reader opens no other file."""
    monkeypatch.chdir(tmp_path)
    dbc = tmp_path / "imu.dbc"
    dbc.write_text(logs.DBC, encoding="utf-8")
    for suffix in dict.fromkeys((*SUFFIXES, *WRITTEN)):
        path = script(Path(f"{name}{suffix}"))
        for given in (path, path.absolute()):
            frames = suffix in WRITTEN and suffix not in TEXT
            with pytest.raises(UserError) as refused:
                load(given, rate=10.0, dbc=dbc if frames else None)
            assert str(refused.value).startswith(str(given))
            assert "\n" not in str(refused.value)
    assert not (tmp_path / "RUN").exists()
    assert not list(tmp_path.rglob("RUN"))
    assert {line for line in watched() if not line.startswith(str(tmp_path / name.partition("/")[0]))} <= {str(dbc)}


@pytest.mark.usefixtures("forked")
def test_no_verb_runs_a_log(tmp_path: Path) -> None:
    """The same by the verbs that take a log in another way."""
    for suffix in (".tlog", ".bin", *WRITTEN):
        path = script(tmp_path / "bin" / f"flight{suffix}")
        for verb in (("monitor", "--read"), ("replay",)) if suffix in WRITTEN else (("replay",),):
            done = run(*verb, path)
            assert done.returncode == 2, done.stderr
            assert done.stderr.count("\n") == 1
    done = run("fleet", str(tmp_path / "bin" / "*"), "-o", str(tmp_path / "f.csv"), "--workers", "1", cwd=tmp_path)
    assert "Traceback" not in done.stderr
    assert (tmp_path / "f.csv").read_text().count("flight") >= 2
    assert not (tmp_path / "RUN").exists()


def test_a_tlog_in_bin_is_read(tmp_path: Path, short: logs.Drawn) -> None:
    """Truth: what was drawn; a tlog's numbers are mrad/s."""
    (tmp_path / "bin").mkdir()
    recording = load(logs.write_tlog(short, tmp_path / "bin"))
    assert recording.columns["gx"].values == pytest.approx(np.rint(short.gyro[:, 0] * 1e3) * 1e-3, abs=1e-3)


@pytest.mark.parametrize(
    "verb", [("identify", "--axis", "gx", "--plot", "a.png"), ("fleet", "-o", "f.csv", "--workers", "1")]
)
def test_nothing_of_the_folder_is_run(verb: tuple[str, ...], tmp_path: Path) -> None:
    """A folder of logs that has Python modules and settings of matplotlib in it: the user who is there reads a log as
    elsewhere."""
    log = logs.write_tdms(logs.Drawn(seconds=30.0, seed=6), tmp_path)
    for module in ("numpy", "json", "nptdms", "selfcal", "evil", "sitecustomize"):
        (tmp_path / f"{module}.py").write_text("open('RUN', 'w').close()\n")
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nbackend: module://evil\n")
    done = subprocess.run([*COMMAND, verb[0], log.name, *verb[1:]], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "RUN").exists()


# ----------------------------------------------------------------------------------------- a log that names other files


def aside(path: Path, count: int) -> Path:
    """Numbers in a file of their own, float64, as external storage has them."""
    np.arange(count, dtype=np.float64).tofile(path)
    return path


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("suffix", [".h5", ".mat"])
@pytest.mark.parametrize("kind", ["external", "virtual", "unlimited", "device"])
def test_a_dataset_in_another_file_is_refused(suffix: str, kind: str, tmp_path: Path) -> None:
    import h5py

    count, path = 350, tmp_path / f"log{suffix}"
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other.create_dataset("x", data=np.arange(count) * 0.5, maxshape=(None,))
    with h5py.File(path, "w", userblock_size=512 if suffix == ".mat" else 0) as file:
        file.create_dataset("t", data=np.arange(count) / 50.0).attrs["unit"] = "s"
        if kind in ("external", "device"):
            store = aside(tmp_path / "numbers", count) if kind == "external" else Path("/dev/zero")
            shape: dict[str, Any] = {"shape": (count,), "dtype": "f8"}
            dataset = file.create_dataset("gz", external=[(store, 0, 8 * count)], **shape)
        else:
            most = None if kind == "unlimited" else count
            layout = h5py.VirtualLayout((count,), "f8", maxshape=(most,))
            layout[: h5py.h5s.UNLIMITED if most is None else count] = h5py.VirtualSource(
                "other.h5", "x", shape=(count,), maxshape=(most,)
            )[: h5py.h5s.UNLIMITED if most is None else count]
            dataset = file.create_virtual_dataset("gz", layout)
        dataset.attrs["unit"] = "deg/s"
    with pytest.raises(UserError, match="dataset 'gz' lies in other files: write it into this one"):
        load(path)


@pytest.mark.usefixtures("forked")
def test_a_link_out_of_a_file_is_not_followed(tmp_path: Path) -> None:
    """Truth: gy is in the file itself, gz behind a link."""
    import h5py

    with h5py.File(tmp_path / "other.h5", "w") as other:
        other.create_dataset("x", data=np.zeros(200)).attrs["unit"] = "deg/s"
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file.create_dataset("t", data=np.arange(200) / 20.0).attrs["unit"] = "s"
        file.create_dataset("gy", data=np.arange(200) * 0.25).attrs["unit"] = "deg/s"
        file["gz"] = h5py.ExternalLink("other.h5", "/x")
        file["gx"] = h5py.SoftLink("/gz")
    assert list(load(tmp_path / "log.h5").columns) == ["gy"]


@pytest.mark.parametrize("name", BINARY)
def test_a_reader_opens_its_log_alone(
    name: str, tmp_path: Path, short: logs.Drawn, watched: Callable[[], list[str]]
) -> None:
    """Sound logs beside files that a library may look for."""
    log = logs.WRITERS[name](short, tmp_path)
    for more in ("_index", "-journal", "-wal", ".meta", ".index"):
        log.with_name(log.name + more).write_bytes(b"\0" * 100)
    assert load(log).samples > 1
    within = [str(log), *(str(one) for one in (log.iterdir() if log.is_dir() else []))]
    assert set(watched()) <= set(within)


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("name", ["%2e%2e%2fsecret.db3", "secret.db3?x.db3", "secret.db3#x.db3"])
@pytest.mark.parametrize("folder", [False, True])
def test_a_name_is_no_address_of_another_bag(name: str, folder: bool, tmp_path: Path, short: logs.Drawn) -> None:
    """Names of which an address makes another file: the file of this name is read, or none."""
    within = tmp_path / "logs"
    within.mkdir()
    bag = logs.write_ros2(short, tmp_path) if folder else logs.write_db3(short, tmp_path)
    database = next(bag.glob("*.db3")) if folder else bag
    for secret in (within / "secret.db3", tmp_path / "secret.db3"):
        shutil.copy(database, secret)
    log = within / name
    log.write_bytes(b"SQLite format 3\0")
    if folder:
        metadata = (bag / "metadata.yaml").read_text().replace(database.name, name)
        (within / "metadata.yaml").write_text(metadata)
    with pytest.raises(UserError, match="rename it"):
        load(within if folder else log)


@pytest.mark.usefixtures("forked")
def test_an_attachment_outside_is_not_read(tmp_path: Path, short: logs.Drawn, monkeypatch: pytest.MonkeyPatch) -> None:
    """A channel of an MDF whose attachment is a pipe beside it: the channel alone is read."""
    from asammdf import MDF
    from asammdf.blocks.mdf_v4 import MDF4

    log = logs.write_mf4(short, tmp_path)
    with MDF(log) as file:
        file.groups[0].channels[1].attachment = file.attach(b"1", "outside.bin", embedded=False)
        file.save(tmp_path / "with.mf4")
    for left in tmp_path.glob("outside*"):
        left.unlink()
    os.mkfifo(tmp_path / "outside.bin")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(MDF4, "_extract_attachment", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    assert load(tmp_path / "with.mf4").samples == short.t.size


# ------------------------------------------------------------------------------------------------- a log without an end


@pytest.mark.parametrize("suffix", (*SUFFIXES, ".zip.csv"))
def test_a_pipe_or_a_device_is_one_line(suffix: str, tmp_path: Path) -> None:
    """By its own name and by a link. Its reading would never end."""
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"device{suffix}").symlink_to("/dev/zero")
    for log in (tmp_path / f"pipe{suffix}", tmp_path / f"device{suffix}"):
        for dbc in (None, tmp_path / "imu.dbc"):
            with pytest.raises(UserError, match="is a pipe or a device"):
                load(log, dbc=dbc)


def test_a_database_that_is_a_pipe(tmp_path: Path) -> None:
    """Or that is not there: the line names the database, not the log."""
    log, _ = logs.write_frames(logs.Drawn(seconds=0.1), tmp_path, ".asc")
    os.mkfifo(tmp_path / "pipe.dbc")
    for dbc in (tmp_path / "pipe.dbc", tmp_path / "none.dbc"):
        with pytest.raises(UserError, match=f"^{dbc}: there is no such file, or it is a pipe or a device"):
            load(log, dbc=dbc)


def test_a_pipe_beside_a_log(tmp_path: Path, short: logs.Drawn) -> None:
    """In the place of metadata, in a ROS 2 folder, in a batch: refused or left out, at once."""
    bag = logs.write_ros2(short, tmp_path)
    os.mkfifo(bag / "more.db3")
    with pytest.raises(UserError, match=r"more\.db3: is a pipe or a device"):
        load(bag)
    log = logs.write_euroc(short, tmp_path)
    os.mkfifo(f"{log}.meta.json")
    assert load(log).samples == short.t.size
    os.mkfifo(tmp_path / "pipe.csv")
    done = run("fleet", tmp_path / "pipe.csv", log, "-o", tmp_path / "f.csv", "--workers", "1", cwd=tmp_path)
    assert f"{tmp_path / 'pipe.csv'}: is a pipe or a device: skipped" in done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "f.csv").exists()


@pytest.mark.usefixtures("forked")
def test_a_hole_is_no_time(tmp_path: Path, short: logs.Drawn, monkeypatch: pytest.MonkeyPatch) -> None:
    """A log of a few KB with a terabyte of hole behind: it gets the time of a few KB, not of 50 days."""
    monkeypatch.setattr(child, "_LEAST_S", 1.0)
    log = logs.write_ulog(short, tmp_path)
    os.truncate(log, 1 << 40)
    begun = time.monotonic()
    with pytest.raises(UserError, match=f"^{log}: "):
        load(log)
    assert time.monotonic() - begun < 30.0


def slow_bag(path: Path, rows: int) -> Path:
    """A bag that SQLite reads for minutes: each message is worked out of 20 MB."""
    with sqlite3.connect(path) as bag:
        bag.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "INSERT INTO topics VALUES (1, 'imu', 'sensor_msgs/msg/Imu', 'cdr');"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER);"
            f"WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < {rows})"
            "INSERT INTO messages(topic_id, timestamp) SELECT 1, k FROM n;"
            "ALTER TABLE messages ADD COLUMN"
            " data BLOB AS (substr(replace(hex(zeroblob(10000000 + id)), '0', '12'), 1, 9));"
        )
    return path


def by_file(bag: Path, zeros: int = 0, parts: int = 1) -> Path:
    """A ROS 2 folder whose database is packed as a file, with `zeros` behind it, which SQLite passes by; so often."""
    from rosbags.rosbag2.reader import zstd

    database = bag / "ros2.db3"
    packed = zstd.compress(database.read_bytes() + bytes(zeros))
    for k in range(parts):
        (bag / f"{k}.db3.zstd").write_bytes(packed)
    database.unlink()
    text = (bag / "metadata.yaml").read_text()
    text = re.sub(r"compression_format: .*", "compression_format: zstd", text)
    text = re.sub(r"compression_mode: .*", "compression_mode: FILE", text)
    listed = re.escape("- ros2.db3")
    text = re.sub(f"( *){listed}\n", lambda m: "".join(f"{m[1]}- {k}.db3.zstd\n" for k in range(parts)), text)
    (bag / "metadata.yaml").write_text(text)
    return bag


def readers() -> list[str]:
    """Command lines of the readers that are at work."""
    lines = []
    for one in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(one.read_bytes().replace(b"\0", b" ").decode("utf-8", "replace"))
        except OSError:  # it has ended
            continue
    return [line for line in lines if "selfcal.logs.loaders.child" in line]


@pytest.mark.parametrize("verb", [("fleet", "-o", "f.csv"), ("identify",)])
def test_a_command_ends_with_its_readers(verb: tuple[str, ...], tmp_path: Path) -> None:
    """SIGTERM while readers are at work: command and readers are gone within 2 s on an idle machine; 10 s here. What
    they unpacked goes with them."""
    names = [f"bag{k}" for k in range(2 if verb[0] == "fleet" else 1)]
    for k, name in enumerate(names):
        bag = logs.write_ros2(logs.Drawn(seconds=0.1), tmp_path).rename(tmp_path / name)
        (bag / "ros2.db3").unlink()
        slow_bag(bag / "ros2.db3", 3000 + k)
        (bag / "metadata.yaml").write_text((bag / "metadata.yaml").read_text().replace("name: /imu/data", "name: imu"))
        by_file(bag)
    left = tmp_path / "left"
    left.mkdir()
    process = subprocess.Popen(
        [*COMMAND, verb[0], *names, *verb[1:]],
        cwd=tmp_path,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "TMPDIR": str(left)},
    )
    mine = f"{names[-1]} "
    begun = time.monotonic()
    while len(list(left.rglob("*.db3"))) < len(names) and time.monotonic() < begun + 60.0:
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.2)
    assert any(mine in line for line in readers())
    process.terminate()
    told = time.monotonic()
    assert process.wait(10.0) in (128 + signal.SIGTERM, -signal.SIGTERM)
    while any(mine in line for line in readers()) and time.monotonic() < told + 10.0:
        time.sleep(0.02)
    print(f"{verb[0]}: ended in {time.monotonic() - told:.2f} s")
    assert not any(mine in line for line in readers())
    assert not list(left.iterdir())


# ----------------------------------------------------------------------------------------------------- no space is left


@pytest.mark.parametrize("name", [one for one in BINARY if one != "mf4"])
def test_a_reader_writes_no_file(
    name: str, tmp_path: Path, short: logs.Drawn, forked: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no byte can be written, logs are read as elsewhere. asammdf alone makes a file of its own."""
    log = logs.WRITERS[name](short, tmp_path)
    answer = child.answer

    def without(module: str, path: Path, hints: Hints, to: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        answer(module, path, hints, to)

    monkeypatch.setattr(child, "answer", without)
    assert load(log).samples > 1


def test_no_space_is_named(tmp_path: Path) -> None:
    """Of a library that unpacks into a file."""
    line = r"log\.mf4: no space left in /\S+ to unpack it: TMPDIR names another folder"
    with pytest.raises(UserError, match=line), reading(tmp_path / "log.mf4", "no MDF file"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# ------------------------------------------------------------------------------------------------------------- formulas


def with_formulas(path: Path, version: str, formulas: dict[str, str], clock: str = "") -> None:
    """An MDF of 40 rows, 5 Hz; raw counts 1, 2, ...; a channel without a formula has 0.125 deg/s a count."""
    from asammdf import MDF, Signal

    raw = np.arange(1.0, 41.0)
    signals = []
    for name in ("Gyro_X", "Gyro_Y", "Gyro_Z"):
        conversion = {"formula": formulas[name]} if name in formulas else {"a": 0.125, "b": 0.0}
        signals.append(Signal(raw, raw / 5.0, unit="deg/s", name=name, conversion=conversion))
    with MDF(version=version) as file:
        file.append(signals)
        if clock:
            from asammdf.blocks.v4_blocks import ChannelConversion

            file.groups[0].channels[0].conversion = ChannelConversion(conversion_type=3, formula=clock)
        file.save(path)


@pytest.mark.parametrize(("version", "suffix"), [("4.10", ".mf4"), ("3.30", ".mdf")])
@pytest.mark.parametrize(
    "formula", ["0.03*X1^1", "X1*0.02+1", "__import__('os').system('touch RUN')", "open('RUN','w')", "sin(X1)", ""]
)
def test_no_formula_of_an_mdf_is_run(
    version: str, suffix: str, formula: str, tmp_path: Path, forked: None,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Neither numexpr nor sympy gets it, and no raw count is taken for a rate. Truth: gz alone is linear."""
    if version == "3.30" and not formula:
        pytest.skip("version 3 has no empty formula")
    monkeypatch.chdir(tmp_path)
    for blocks in ("asammdf.blocks.v4_blocks", "asammdf.blocks.v2_v3_blocks"):
        for name in ("evaluate", "lambdify", "symbols"):
            monkeypatch.setattr(import_module(blocks), name, lambda *_, **__: Path("RUN").touch())
    names = ("Gyro_X", "Gyro_Y", "Gyro_Z")
    log = tmp_path / f"log{suffix}"
    with_formulas(log, version, dict.fromkeys(names[:2], formula))
    recording = load(log)
    assert list(recording.columns) == ["gz"]
    assert recording.columns["gz"].values == pytest.approx(np.arange(1.0, 41.0) * 0.125)
    assert "left out: Gyro_X, Gyro_Y: their values come by a formula" in capsys.readouterr().err
    with_formulas(tmp_path / f"all{suffix}", version, dict.fromkeys(names, formula))
    with pytest.raises(UserError, match="left out: Gyro_X, Gyro_Y, Gyro_Z: their values come by a formula"):
        load(tmp_path / f"all{suffix}")
    assert not Path("RUN").exists()


@pytest.mark.usefixtures("forked")
def test_a_clock_by_a_formula_is_refused(tmp_path: Path) -> None:
    with_formulas(tmp_path / "log.mf4", "4.10", {}, clock="X1*2")
    with pytest.raises(UserError, match="left out: time: their values come by a formula, 'X1"):
        load(tmp_path / "log.mf4")


# ------------------------------------------------------------------------------------------------------------ unpacking


def packed(path: Path, count: int) -> Path:
    """`count` equal rows of three axes, which pack to less than a hundredth."""
    import h5py
    import pyarrow as pa
    from pyarrow import parquet

    match path.suffix:
        case ".gz" | ".zip":
            text = b"t[s],gx[deg/s],gy[deg/s]\n" + b"1,2,3\n" * count
            if path.suffix == ".gz":
                path.write_bytes(gzip.compress(text, 9))
            else:
                with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
                    archive.writestr("Gyroscope.csv", text)
        case ".npz":
            np.savez_compressed(path, **{"gx[deg/s]": np.zeros(count), "gy[deg/s]": np.zeros(count)})
        case ".h5":
            with h5py.File(path, "w") as file:
                for name in ("gx", "gy"):
                    made = file.create_dataset(name, (count,), "f8", chunks=(1 << 16,), compression="gzip")
                    made.attrs["unit"] = "deg/s"
        case _:
            column = pa.array(np.zeros(count))
            parquet.write_table(pa.table({"gx": column, "gy": column}), path)
    return path


def test_members_that_are_one_are_refused(tmp_path: Path) -> None:
    """A zip that lists one member 700 times: its rows are read for an hour, and never were there."""
    path = tmp_path / "log.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        rows = np.random.default_rng(8).integers(0, 2, 3000).tolist()
        archive.writestr("Gyroscope.csv", "gz[deg/s]\n" + "".join(f"{row}\n" for row in rows))
        archive.filelist *= 700
    with pytest.raises(UserError, match="not a whole zip file: its members overlap"):
        load(path, rate=10.0)


@pytest.mark.parametrize("name", ["log.csv.gz", "log.zip", "log.npz", "log.h5", "log.parquet"])
def test_a_small_file_takes_little_memory(name: str, tmp_path: Path) -> None:
    """16 million rows in a file of less than a megabyte: refused with less memory than a fifth of their numbers."""
    log = packed(tmp_path / name, 16_000_000)
    assert log.stat().st_size < 1 << 20
    code = (
        "import resource, sys\nfrom selfcal.logs.recording import load\nfrom selfcal.base.errors import UserError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        f"try:\n    load({str(log)!r}, rate=10.0)\nexcept UserError as error:\n    print(error)\n"
        "print(max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))"
        " - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    line, grown_kb = done.stdout.splitlines()
    assert "times its size, as no sensor's readings do" in line
    print(name, grown_kb)
    assert int(grown_kb) < 16_000_000 * 16 / 5 / 1024 + 90_000  # and pyarrow


@pytest.mark.parametrize(("mib", "parts", "sound"), [(50, 1, True), (70, 1, False), (50, 2, False)])
def test_a_packed_bag_has_a_bound(
    mib: int, parts: int, sound: bool, tmp_path: Path, short: logs.Drawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A database of a few KB may unpack to 64 MiB, all parts of a bag together. Nothing stays."""
    bag = by_file(logs.write_ros2(short, tmp_path), mib << 20, parts)
    left = tmp_path / "left"
    left.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(left))
    if sound:
        assert load(bag).samples == short.t.size
    else:
        with pytest.raises(UserError, match=f"^{bag}: unpacks to more than 200 times its size"):
            load(bag)
    assert not list(left.iterdir())


# ------------------------------------------------------------------------------------------------ numbers that are none


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("folder", [False, True])
def test_messages_beside_a_database(folder: bool, tmp_path: Path, short: logs.Drawn) -> None:
    """A recorder that was killed: half of its messages are in the -wal. Truth: by the step that the line names, all."""
    bag = logs.write_ros2(short, tmp_path)
    with sqlite3.connect(bag / "ros2.db3") as database:
        database.execute("CREATE TABLE kept AS SELECT * FROM messages WHERE id % 2")
        database.execute("DELETE FROM messages WHERE id % 2")
    database.execute("PRAGMA journal_mode = wal")
    database.execute("INSERT INTO messages SELECT * FROM kept")
    database.commit()
    killed = Path(shutil.copytree(bag, tmp_path / "killed"))
    database.close()
    log = killed if folder else killed / "ros2.db3"
    with pytest.raises(UserError, match=r"messages are in ros2\.db3-wal, which is not read: bring them in by ") as told:
        load(log)
    _, name, step = shlex.split(str(told.value).partition(" in by ")[2])
    with sqlite3.connect(name) as copy:
        copy.execute(step)
    copy.close()
    assert load(log).samples == short.t.size


@pytest.mark.usefixtures("forked")
def test_invalid_samples_of_an_mdf_are_missing(tmp_path: Path) -> None:
    """Each channel has its own. Truth: the samples are their numbers, at 25 Hz; those called invalid are not there."""
    from asammdf import MDF, Signal

    count = np.arange(600)
    invalid = {"Gyro_X": count < 60, "Gyro_Y": count >= 540, "Gyro_Z": (count > 300) & (count < 361)}
    with MDF(version="4.10") as file:
        kinds = dict(zip(invalid, ("f8", "i2", "f4"), strict=True))
        file.append(
            [
                Signal(count.astype(kinds[name]), count / 25.0, unit="deg/s", name=name, invalidation_bits=none)
                for name, none in invalid.items()
            ]
        )
        file.save(tmp_path / "log.mf4")
    recording = load(tmp_path / "log.mf4")
    place = np.rint(recording.time_s * 25.0).astype(int)
    for axis, none in zip(("gx", "gy", "gz"), invalid.values(), strict=True):
        truth = np.where(none, np.nan, count)
        assert recording.columns[axis].values == pytest.approx(truth[place], nan_ok=True)


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("level", ["channel", "group", "file"])
def test_a_scale_that_is_not_known(level: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """nptdms gives raw counts for it. Truth: gy has a scale of its own, 0.5 deg/s a count."""
    from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter

    foreign = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "LookUp"}
    linear = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Slope": 0.5,
              "NI_Scale[0]_Linear_Y_Intercept": 0.0}  # fmt: skip
    at = {name: foreign if name == level else {} for name in ("channel", "group", "file")}
    own = {"unit_string": "deg/s", "wf_increment": 0.05}
    raw = np.arange(80, dtype=np.int16)
    root, group = RootObject(at["file"]), GroupObject("IMU", at["group"])
    gx = ChannelObject("IMU", "gx", raw, {**own, **at["channel"]})
    gy = ChannelObject("IMU", "gy", raw, {**own, **linear})
    with TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment([root, group, gx, gy])
    recording = load(tmp_path / "log.tdms")
    assert list(recording.columns) == ["gy"]
    assert recording.columns["gy"].values == pytest.approx(0.5 * raw)
    line = "left out: gx: their values come by a scale, 'LookUp', that is not known: export them as physical values"
    assert line in capsys.readouterr().err
    with TdmsWriter(tmp_path / "all.tdms") as writer:
        writer.write_segment([root, group, gx])
    with pytest.raises(UserError, match=line):
        load(tmp_path / "all.tdms")


def stamped(path: Path, rate: float, last: float) -> Path:
    """800 rows of noise, the last of which has another stamp."""
    noise = np.random.default_rng(10).normal(size=800)
    rows = [f"{k / rate if k < 799 else last!r},{value:.4f}\n" for k, value in enumerate(noise.tolist())]
    path.write_text("t[s],gy[deg/s]\n" + "".join(rows))
    return path


@pytest.mark.parametrize(
    ("rate", "last"), [(40.0, 2e10), (40.0, 4e12), (40.0, 6e18), (40.0, 1e305), (2e5, 9e8), (0.01, 3e10)]
)
def test_a_stamp_beyond_all_counts(rate: float, last: float, tmp_path: Path) -> None:
    """More seconds, or samples, than a tool counts: the line is named."""
    line = r"log\.csv: line 801: column 't': the time stamp is \S+ s after the one before: a recording spans at most"
    with pytest.raises(UserError, match=line):
        load(stamped(tmp_path / "log.csv", rate, last))


def test_the_longest_gap_is_counted(tmp_path: Path) -> None:
    """Just within the bound. Truth: the samples that fill the gap; `identify` has a result."""
    log = stamped(tmp_path / "log.csv", 40.0, 9.9e9)
    assert load(log).lost == pytest.approx(40.0 * 9.9e9, rel=1e-3)
    assert "error" not in identify(log)["axes"]["gy"]


def test_a_rate_beyond_all_counts(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("gx[deg/s]\n" + "0\n1\n" * 6000)
    with pytest.raises(UserError, match="12000 rows at 1e-06 Hz: a recording spans at most"):
        load(tmp_path / "log.csv", rate=1e-6)


# ---------------------------------------------------------------------------------------------- what verbs stumble over


def test_a_named_pipe_holds_nothing(tmp_path: Path) -> None:
    """As what is read beside a log, and as an output: refused, by a link too."""
    for suffix in (".yaml", ".asc", ".mcap"):
        os.mkfifo(tmp_path / f"pipe{suffix}")
        (tmp_path / f"link{suffix}").symlink_to(tmp_path / f"pipe{suffix}")
    for name in ("pipe", "link"):
        for read in (Model.load, read_key, lambda path: read_text(path, 9, "")):
            with pytest.raises(UserError, match=f"^{tmp_path / name}.yaml: is a named pipe: write it into a file"):
                read(tmp_path / f"{name}.yaml")
        for suffix, write in ((".yaml", check_writable), (".asc", FrameWriter), (".mcap", FrameWriter)):
            with pytest.raises(UserError, match=f"^{tmp_path / name}{suffix}: cannot be written: it is a named pipe"):
                write(tmp_path / f"{name}{suffix}")


def test_a_pipe_of_the_shell_is_read_and_written(tmp_path: Path) -> None:
    """`--model <(...) --json >(...)`."""
    log = stamped(tmp_path / "log.csv", 30.0, 799 / 30.0)
    model, its_end = os.pipe()
    answer, to = os.pipe()
    os.write(its_end, DEFAULT.read_bytes())
    os.close(its_end)
    command = [*COMMAND, "identify", log, "--model", f"/dev/fd/{model}", "--json", f"/proc/self/fd/{to}"]
    done = subprocess.run(command, pass_fds=(model, to), capture_output=True, text=True, check=False, timeout=60.0)
    os.close(to)
    assert done.returncode == 0, done.stderr
    with os.fdopen(answer, encoding="utf-8") as text:
        assert "gy" in json.load(text)["axes"]


@pytest.mark.parametrize("factor", [1.0, -20.0])
def test_a_temperature_that_copies_an_axis(factor: float, tmp_path: Path) -> None:
    """A logger wrote one column twice: it acts on nothing, and nothing is left of the axis beside it."""
    values = np.random.default_rng(9).normal(size=500)
    save(tmp_path / "log.csv", {"gy": ("deg/s", 0.1 * values), "temp": ("degC", 20.0 + factor * values)}, 5.0, {})
    assert not any("temp" in str(one) for one in diagnose(tmp_path / "log.csv")["axes"]["gy"]["findings"])
    with pytest.raises(UserError, match="column 'temp' does not change, or is a copy of an axis"):
        response(tmp_path / "log.csv", input="temp", output="gy")


def test_a_zero_byte_in_a_table_of_units(tmp_path: Path) -> None:
    save(tmp_path / "log.csv", {"gy": ("deg/s", np.arange(9.0))}, 5.0, {})
    (tmp_path / "units.csv").write_bytes(b"file,device\n\0,7\n")
    with pytest.raises(UserError, match=r"units\.csv: not a table of units: a byte 0x00 is in it"):
        fleet([tmp_path / "log.csv"], tmp_path / "f.csv", units_table=tmp_path / "units.csv")
