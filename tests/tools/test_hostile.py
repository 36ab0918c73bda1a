"""Files from strangers: whatever is in them, reading ends in a sound recording or model, or in one line.

Sound files of every form are changed at random: bytes, pieces, lengths, and words that are known to do harm. Each is
read under a limit of memory and within a time. `make campaigns` (SELFCAL_CAMPAIGN) tries that many times as many.
"""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import os
import random
import resource
import struct
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from selfcal.base import limits
from selfcal.base.errors import UserError
from selfcal.base.limits import LONGEST_S
from selfcal.logs.recording import Recording, load, save
from selfcal.model.file import DEFAULT, Model

from conftest import CAMPAIGN, ROOT

TIMES = CAMPAIGN
#: Changed copies of a recording.
COPIES = 120 * TIMES if TIMES > 1 else 30
#: s that one changed file may take, on a busy machine; each sound one takes below 0.05 s.
SLOWEST = 10.0
#: Bytes of address space beyond those in use: a sound file here takes below 1 MB.
ROOM = 1 << 30

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
STATED: dict[str, Any] = {"units": {name: "deg/s" if name[0] == "g" else "g" for name in AXES}, "rate": 100.0}
#: Words that did harm in one form or another.
WORDS = [
    b"\0", b"nan", b"inf", b"1e400", b"-1", b"0", b"9" * 400, b"1_0", b"[", b"]", b"(", b"{", b'"', b"'", b"#", b",",
    b";", b"\n", b"\r", b"\t", b"\x1b[2J", b"\xff\xfe", b"\xed\xa0\x80", b"2001-02-30", b"!!int x", b"!!python/x:x",
    b"&a [*a]", b"*a", b"? {a: 1}\n: 2", b"~", b"0x" + b"f" * 5000, b"h^1000", b"[/red]", b"%s", b"true", b"true,",
    struct.pack("<I", 2**32 - 1), struct.pack(">i", 2**31 - 1), struct.pack("<Q", 2**63), b"(1000000000000,)",
]  # fmt: skip


def changed(data: bytes, chance: random.Random) -> bytes:
    """`data` with one to four changes."""
    made = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at, length = chance.randrange(len(made) + 1), chance.choice((1, 1, 2, 4, 16, 200))
        match chance.randrange(6):
            case 0:
                made[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                made[at : at + length] = b""
            case 2:
                made[at:at] = made[at : at + length] * chance.choice((1, 2, 50))
            case 3:
                made[at : at + length] = chance.choice(WORDS)
            case 4:
                made[at:at] = chance.choice(WORDS)
            case 5:
                made[at:] = made[at:][: chance.choice((0, 10, 1000))]
        if not made:
            break
    return bytes(made)


@pytest.fixture(autouse=True)
def little_memory() -> Iterator[None]:
    """A limit on what a test may take; who goes beyond it gets a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def verdict(read: Callable[[], Any], path: Path) -> str:
    """The one line of what is refused, empty if it is not; anything else fails."""
    start = time.monotonic()
    try:
        read()
        said = ""
    except UserError as error:
        said = str(error)
        assert said.startswith(str(path)), said
        assert "\n" not in said and len(said) < 1000, said
        assert "too large for this machine" not in said and "(signal" not in said, said
    assert time.monotonic() - start < SLOWEST
    return said


def sound(recording: Recording) -> None:
    for name, column in recording.columns.items():
        assert column.values.shape == recording.clock_of(name).missing_before.shape
        assert not np.isinf(column.values).any() and np.isfinite(column.values).any()
        along = recording.along(name)
        assert np.isfinite(along.columns[name].values).all() and (along.missing_before >= 0).all()
        assert along.samples == along.columns[name].values.size
    assert recording.samples >= 2 and (recording.missing_before >= 0).all()
    assert limits.LEAST_RATE_HZ <= recording.rate_hz <= limits.MOST_RATE_HZ
    assert np.isfinite(recording.duration_s)


def r_file() -> bytes:
    """A numeric matrix of R's class imu, as R's save() writes it (R Internals, 1.8 Serialization Formats)."""

    def word(*numbers: int) -> bytes:
        return struct.pack(f">{len(numbers)}i", *numbers)

    def text(value: str) -> bytes:
        return word(0x40009, len(value)) + value.encode()

    def symbol(value: str) -> bytes:
        return word(1) + text(value)

    def strings(*values: str) -> bytes:
        return word(16, len(values)) + b"".join(map(text, values))

    names = [f"{kind}. {axis}" for kind in ("Gyro", "Accel") for axis in "XYZ"]
    values = np.random.default_rng(1).normal(size=120).astype(">f8")
    attributes = (
        word(0x402) + symbol("dim") + word(13, 2, 20, 6)
        + word(0x402) + symbol("dimnames") + word(19, 2, 254) + strings(*names)
        + word(0x402) + symbol("freq") + word(14, 1) + struct.pack(">d", 100.0)
        + word(0x402) + symbol("class") + strings("imu", "matrix") + word(254)
    )  # fmt: skip
    matrix = word(0x30E, 120) + values.tobytes() + attributes
    return b"RDX2\nX\n" + word(2, 0x30401, 0x20300) + word(0x402) + symbol("run1") + matrix + word(254)


def sound_files(folder: Path) -> dict[str, bytes]:
    rng = np.random.default_rng(1)
    columns = {name: ("deg/s" if name[0] == "g" else "g", rng.normal(size=20)) for name in AXES}
    meta = {"truth": {"gx": {"hypothesis": "random_walk", "N": 0.1}}, "seed": 1}
    for name, lsb in (("log.csv", {}), ("log.npz", {}), ("lsb.npz", {"gx": 0.05})):
        save(folder / name, columns, 100.0, meta, lsb=lsb, t=np.arange(20) / 100.0)
    np.savez(folder / "plain.npz", **{f"{name}[{unit}]": values for name, (unit, values) in columns.items()})
    arrays = {name: values for name, (_, values) in columns.items()}
    savemat(folder / "log.mat", {**arrays, "meta": json.dumps({"rate_hz": 100.0})}, do_compression=True)
    savemat(folder / "plain.mat", {**arrays, "note": "text", "s": {"a": 1}})
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    csv = files["log.csv"]
    files["semicolons.txt"] = b"# a comment\n" + csv.replace(b",", b";").replace(b".", b",")
    files["log.csv.gz"] = gzip.compress(csv)
    plain = r_file()
    files |= {"plain.rda": plain, "log.rda": gzip.compress(plain), "xz.rda": lzma.compress(plain)}
    files |= {"bz.rdata": bz2.compress(plain), "log.rds": plain.removeprefix(b"RDX2\n")}
    for path in folder.iterdir():
        path.unlink()
    return files


LOADERS = ("log.csv", "semicolons.txt", "log.csv.gz", "log.npz", "lsb.npz", "plain.npz", "log.mat", "plain.mat",
           "plain.rda", "log.rda", "xz.rda", "bz.rdata", "log.rds")  # fmt: skip
#: Of these, forms that state no units.
UNITLESS = (".mat", ".rda", ".rdata", ".rds")


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("name", LOADERS)
def test_changed_recordings(tmp_path: Path, name: str) -> None:
    files = sound_files(tmp_path)
    path, beside = tmp_path / name, tmp_path / f"{name}.meta.json"
    chance = random.Random(name)
    refused = 0
    for trial in range(COPIES + 1):
        data = files[name]
        if name == "log.csv":
            meta = files["log.csv.meta.json"]
            beside.write_bytes(changed(meta, chance) if trial % 4 == 3 else meta)
        if trial and not (name == "log.csv" and trial % 4 == 3):
            data = changed(data, chance)
            if name == "log.csv.gz" and trial % 2:  # within, and whole
                data = gzip.compress(changed(gzip.decompress(files[name]), chance))
        path.write_bytes(data)
        options = {"rate": 100.0} if name == "plain.npz" else STATED if name.endswith(UNITLESS) else {}
        said = verdict(lambda: sound(load(path, **options)), path)  # noqa: B023
        assert said == "" or trial > 0, said
        refused += said != ""
    assert refused > COPIES / 4  # the changes are no harmless ones


def test_changed_model_files(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    chance = random.Random("model")
    sources = [DEFAULT.read_bytes(), (ROOT / "tools" / "selfcal" / "model" / "models" / "sums.yaml").read_bytes()]
    refused = 0
    for _ in range(500 * TIMES):
        path.write_bytes(changed(chance.choice(sources), chance))
        refused += verdict(lambda: Model.load(path), path) != ""
    assert refused > 100 * TIMES


# ------------------------------------------------------------------------------------------------- what is made by hand


def npz_of(path: Path, header: str, data: bytes = bytes(16), **info: Any) -> None:
    """An npz of one column with this array header."""
    text = (header + "\n").encode()
    with zipfile.ZipFile(path, "w", info.get("packing", zipfile.ZIP_DEFLATED)) as archive:
        archive.writestr("gx[deg/s].npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data)


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (True,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (18446744073709551618,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-2,)}",
        "{'descr': ['<f8'], 'fortran_order': False, 'shape': (2,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': __import__('os')}",
        "(" * 5000,
        "{1: \0}",
    ],
)
def test_npz_headers(tmp_path: Path, header: str) -> None:
    path = tmp_path / "log.npz"
    npz_of(path, header)
    assert "cannot be read: " in verdict(lambda: load(path, rate=1.0), path)


def test_npz_packing_and_doubles(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    npz_of(path, "{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}", packing=zipfile.ZIP_LZMA)
    assert "packed in another way" in verdict(lambda: load(path, rate=1.0), path)
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "w") as archive:
        for _ in range(2):
            archive.writestr("gx[deg/s].npy", b"")
    assert "cannot be read" in verdict(lambda: load(path, rate=1.0), path)
    np.savez(path, **{"gx[deg/s]": np.zeros(2)})
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("gx[deg/s].npy", zipfile.ZipFile(path).read("gx[deg/s].npy"))
    assert "column 'gx[deg/s]' appears twice" in verdict(lambda: load(path, rate=1.0), path)


@pytest.mark.parametrize("step", [2**62, 2**63 - 1])
def test_integer_stamps_that_wrap(tmp_path: Path, step: int) -> None:
    """The difference of two int64 may be beyond int64: forwards it is taken, backwards refused. 2^64 ns are more than
    the 1e10 s that a recording spans."""
    path = tmp_path / "log.npz"
    np.savez(path, **{"t[ns]": np.array([step, -step, step]), "gx[deg/s]": np.zeros(3)})
    assert "row 2: column 't': time runs backwards" in verdict(lambda: load(path), path)
    np.savez(path, **{"t[ns]": np.array([-step, 0, step]), "gx[deg/s]": np.zeros(3)})
    if 2 * step * 1e-9 > LONGEST_S:
        assert "a recording spans at most" in verdict(lambda: load(path), path)
    else:
        assert "a sampling rate of" in verdict(lambda: load(path), path) or load(path).samples == 3


def test_a_bomb_of_text(tmp_path: Path) -> None:
    """20 KB that unpack to 20 MB of one row without an end, or of empty lines: a few blocks are in memory, no more."""
    path = tmp_path / "log.csv.gz"
    for filling, what in ((b"1", "longer than"), (b"\n", "unpacks to more than 25 times its size")):
        path.write_bytes(gzip.compress(b"t[s],gx[deg/s]\n0,1\n" + filling * 20_000_000, 1))
        start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        assert what in str(verdict_of(path))
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start < 200_000  # KB; it was 20 times the text


def verdict_of(path: Path) -> UserError:
    with pytest.raises(UserError) as caught:
        load(path, rate=1.0)
    return caught.value


@pytest.mark.parametrize(
    "line",
    [
        "a " * 2_000_000,
        " " * 4_000_000,
        "(" * 4_000_000,
        "gx(" * 1_000_000,
        "[ " * 2_000_000,
        "#" * 4_000_000,
        ("(" * 255 + ",") * 16_000,
        "\n".join(["(" * 200 + ")," * 100] * 1000),
        ", ,," * 1_000_000,
        ",".join(["gx"] * 900),
    ],
    ids=range(10),
)
def test_headers_that_take_long(tmp_path: Path, line: str) -> None:
    """The time to find a header, and to fill empty cells, grows with the file and not with its square."""
    path = tmp_path / "log.csv"
    for text in (line, f"{line}\nt[s] gx[deg/s]\n", f"t[s],gx[deg/s]\n{line}\n0,1\n"):
        path.write_text(text)
        assert "log.csv: " in str(verdict_of(path))
        verdict(lambda: load(path, rate=1.0), path)


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("name", ["log.rda", "log.mat"])
def test_a_bomb_of_arrays(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """More unpacked than is allowed is not unpacked."""
    monkeypatch.setattr("selfcal.logs.loaders.table.MOST_UNPACKED_BYTES", 10_000)
    path = tmp_path / name
    if name == "log.mat":
        savemat(path, {"gx": np.zeros(100_000)}, do_compression=True)
    else:
        path.write_bytes(gzip.compress(r_file() + bytes(1_000_000)))
    assert "it unpacks to more than" in verdict(lambda: load(path, **STATED), path)


@pytest.mark.parametrize(
    ("meta", "what"),
    [
        ("[" * 100_000, "nested too deep"),
        ('{"rate_hz": 1' + "0" * 400 + "}", "'rate_hz' must be a number above 0"),
        ('{"truth": {"gx": {"N": "' + "x" * 61 + '"}}}', "truth of 'gx': 'N' is"),
        ('{"truth": {"gx": {"hypothesis": "\\u001b[2J"}}}', "truth of 'gx'"),
        ('{"truth": {"gx": {"N": NaN}}}', "truth of 'gx': 'N' is nan"),
        ('{"truth": 1}', "'truth' must be a mapping of axes"),
        ('{"rows": 3}', "2 rows where log.csv.meta.json says 3: it was cut"),
        (" " * ((1 << 20) + 1), "larger than 1048576 bytes"),
    ],
)
def test_metadata(tmp_path: Path, meta: str, what: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text("gx[deg/s]\n1\n2\n")
    (tmp_path / "log.csv.meta.json").write_text(meta)
    assert what in verdict(lambda: load(path), path)


BASE = DEFAULT.read_text(encoding="utf-8")
MODELS = {
    "aliases": (BASE + "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
        f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(20)
    ), "more than 10000 values, aliases counted"),
    "itself": (BASE + "z: &z [*z]\n", "an alias stands for itself"),
    "tag": (BASE.replace("bank_rate_hz: 1.0", "bank_rate_hz: !!int x"), "line 6: not valid YAML"),
    "map as a key": (BASE + "? {a: 1}\n: 2\n", "a name must be text"),
    "tab": (BASE + "\tx: 1\n", "indent by spaces"),
    "digits": (BASE.replace("bank_rate_hz: 1.0", "bank_rate_hz: 0x" + "f" * 6000), "bank_rate_hz: must be a number"),
    "taps": (BASE.replace("filter_taps: 2", "filter_taps: 2147483647"), "a whole number from 1 to 1024"),
    "rate": (BASE.replace("rate_hz: 819.2", "rate_hz: 1e18"), "must be 1e-06 to 1e+06 Hz"),
    "unit": (BASE.replace("unit: deg/s", "unit: deg^999999999999999999999"), "unknown unit"),
    "size": (BASE + "#" * 300_000, "larger than 262144 bytes"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "what"), MODELS.values(), ids=MODELS)
def test_model_files(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(text)
    assert text != BASE and what in verdict(lambda: Model.load(path), path)


def test_a_date_is_a_name(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(BASE.replace("name: ", "name: 2001-02-30 # ", 1))
    assert Model.load(path).name == "2001-02-30"


def test_nothing_of_a_file_reaches_the_terminal_raw(tmp_path: Path) -> None:
    """A file name that is no UTF-8, with an escape, and one that looks like markup."""
    command = [str(Path(sys.executable).with_name("selfcal")), "identify"]
    for name in (b"\xff\x1b[2J.csv", b"[red].csv", b"a\nb.csv"):
        (tmp_path / os.fsdecode(name)).write_bytes(b"t[s],gx[deg/s]\n0,1\n1,x\n")
        done = subprocess.run([*command, name], capture_output=True, cwd=tmp_path, check=False)
        assert done.returncode == 2
        assert done.stderr.startswith(b"selfcal: error: ") and done.stderr.count(b"\n") == 1
        assert b"\x1b" not in done.stderr and b"\xff" not in done.stderr


def test_a_name_that_looks_like_markup_is_shown_as_it_is(tmp_path: Path) -> None:
    rows = "".join(f"{value}\n" for value in np.random.default_rng(1).normal(0.0, 0.05, 300))
    (tmp_path / os.fsdecode(b"[red]\xff\x1b[2J.csv")).write_text("gx[deg/s]\n" + rows)
    command = [str(Path(sys.executable).with_name("selfcal")), "identify", os.fsdecode(b"[red]\xff\x1b[2J.csv")]
    done = subprocess.run([*command, "--rate", "1"], capture_output=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert b"[red]\\udcff\\x1b[2J.csv: 300 samples" in done.stdout


def test_a_packed_text_that_grows_without_bound_is_refused(tmp_path: Path) -> None:
    """Equal rows pack to a thousandth: a small file would take gigabytes. Refused while it is read."""
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"t[s],gx[deg/s]\n" + b"0,0\n" * 8_000_000))
    with pytest.raises(UserError, match="unpacks to more than 25 times its size"):
        load(path)
