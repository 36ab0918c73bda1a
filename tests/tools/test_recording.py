"""Recordings: what is read is what was written, and every bad input is one line that names file, line and column.

Truth: the values, stamps and gaps that a test writes.
"""

import gzip
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.logs.loaders import FORMATS, TEXT
from selfcal.logs.loaders.headings import parse_scales
from selfcal.logs.recording import load, save

from conftest import shared_recording

#: Every log that a test here opens, `convert` writes without loss.
pytestmark = pytest.mark.usefixtures("reads_back")

HEAD = b"t[s],gx[deg/s],temp[degC]\n"
ROWS = HEAD + b"0.0,0.5,25\n0.1,0.25,25.5\n0.2,0.125,26\n"


def written(tmp_path: Path, data: bytes, name: str = "log.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    return path


def complaint(path: Path, **options: Any) -> str:
    """The error of loading `path`: one line that names it."""
    with pytest.raises(UserError) as caught:
        load(path, **options)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


# ---------------------------------------------------------------------------------------------------------- good ones


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
@pytest.mark.parametrize(
    "data",
    [
        ROWS,
        ROWS.replace(b"\n", b"\r\n"),
        b"\xef\xbb\xbf" + ROWS,
        ROWS + b"\n \n",
        ROWS.replace(b",", b" , "),
        ROWS.replace(b"gx[deg/s]", b'"gx[deg/s]"'),
        ROWS.replace(b"0.25,", b'"2.5e-1",'),
    ],
    ids=["plain", "crlf", "bom", "blank end", "spaces", "quoted name", "quoted cell"],
)
def test_csv(tmp_path: Path, name: str, data: bytes) -> None:
    recording = load(written(tmp_path, data, name))
    assert list(recording.columns) == ["gx", "temp"]
    assert recording.columns["gx"].values.tolist() == [0.5, 0.25, 0.125]
    assert recording.in_unit("temp", "K").tolist() == [298.15, 298.65, 299.15]
    assert (recording.samples, recording.rate_hz) == (3, 10.0)
    assert recording.duration_s == pytest.approx(0.3, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "one"), [("rad/s", 180 / np.pi), ("deg/h", 1 / 3600), ("rad/h", 180 / np.pi / 3600), ("deg/s", 1.0)]
)
def test_units_are_honoured(tmp_path: Path, unit: str, one: float) -> None:
    path = written(tmp_path, f"gx[{unit}]\n1\n2\n".encode())
    assert load(path, rate=1.0).in_unit("gx", "deg/s") == pytest.approx([one, 2 * one], rel=1e-14)


@pytest.mark.parametrize(("unit", "step"), [("s", "0.01"), ("ms", "10"), ("us", "10000"), ("ns", "10000000")])
def test_units_of_time(tmp_path: Path, unit: str, step: str) -> None:
    rows = "".join(f"{int(k * float(step) * 1e9) / 1e9!r},0\n" for k in range(100, 110))
    assert load(written(tmp_path, f"t[{unit}],gx[deg/s]\n{rows}".encode())).rate_hz == pytest.approx(100.0, rel=1e-9)


def test_foreign_header(tmp_path: Path) -> None:
    path = written(tmp_path, b"time,GYR X,note\n5,1,start\n7,2,\n9,3,end\n")
    recording = load(path, columns={"gx": "GYR X", "t": "time"}, units={"gx": "rad/s", "t": "ms"})
    assert list(recording.columns) == ["gx"]
    assert recording.columns["gx"].unit == "rad/s"
    assert recording.rate_hz == 500.0


def test_lsb_and_scale(tmp_path: Path) -> None:
    path = written(tmp_path, b"gx[LSB],ax[LSB]\n10,-20\n11,-21\n")
    recording = load(path, rate=1.0, scale=parse_scales(["gx=0.05", "ax=3.33[mg]"]))
    assert recording.in_unit("gx", "deg/s") == pytest.approx([0.5, 0.55], rel=1e-14)
    assert recording.in_unit("ax", "mg") == pytest.approx([-66.6, -69.93], rel=1e-14)
    one = load(written(tmp_path, b"gx[LSB]\n10\n11\n"), rate=1.0, scale=0.05)
    assert (one.columns["gx"].unit, one.columns["gx"].values[0]) == ("deg/s", 0.5)


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz", "log.npz"])
def test_round_trip(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(1)
    columns = {"gx": ("deg/s", rng.normal(size=50)), "az": ("m/s^2", rng.normal(-9.8, 1.0, 50))}
    time = np.delete(np.arange(54), [7, 8, 9, 30]) / 8.0
    save(tmp_path / name, columns, 8.0, {"truth": {"gx": {"N": 1}}}, t=time)
    recording = load(tmp_path / name)
    assert recording.rate_hz == 8.0
    assert {k: v for k, v in enumerate(recording.missing_before) if v} == {7: 3, 27: 1}
    assert recording.duration_s == 54 / 8.0
    assert recording.time_s.tolist() == time.tolist()
    assert recording.meta["truth"] == {"gx": {"N": 1}}
    for column, (unit, values) in columns.items():
        assert recording.columns[column].unit == unit
        assert recording.columns[column].values == pytest.approx(values, rel=5e-9)  # CSV keeps 9 digits


def test_npz_in_lsb_is_the_form_of_the_real_recordings(tmp_path: Path) -> None:
    counts = np.array([-3, 0, 5, 32767])
    save(tmp_path / "log.npz", {"gx": ("deg/s", counts * 0.05)}, 100.0, lsb={"gx": 0.05})
    with np.load(tmp_path / "log.npz") as archive:
        assert archive["gx"].dtype == np.int16
        assert archive["gx"].tolist() == counts.tolist()
        assert json.loads(str(archive["meta"])) == {"rate_hz": 100.0, "columns": {"gx": {"unit": "deg/s", "lsb": 0.05}}}
    recording = load(tmp_path / "log.npz")
    assert recording.rate_hz == 100.0
    assert recording.columns["gx"].values == pytest.approx(counts * 0.05, rel=1e-15)


def test_a_later_save_leaves_no_older_meta(tmp_path: Path) -> None:
    columns = {"gx": ("deg/s", np.zeros(3))}
    save(tmp_path / "log.csv", columns, 1.0, {"seed": 1})
    save(tmp_path / "log.csv", columns, 1.0)
    assert load(tmp_path / "log.csv").meta == {}


@pytest.mark.parametrize("ends_at", range(3))
def test_no_meta_stands_beside_another_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends_at: int) -> None:
    """A save that ends at any of its steps on the disk: removing the older meta, then renaming table and meta."""
    path = tmp_path / "log.csv"
    save(path, {"gx": ("deg/s", np.full(3, 1.0))}, 1.0, {"seed": 1})
    steps = []

    def until(step: Callable[..., Any]) -> Callable[..., Any]:
        def taken(self: Path, *arguments: Any, **options: Any) -> Any:
            if len(steps) == ends_at:
                monkeypatch.undo()
                raise KeyboardInterrupt
            steps.append(step.__name__)
            return step(self, *arguments, **options)

        return taken

    monkeypatch.setattr(Path, "unlink", until(Path.unlink))
    monkeypatch.setattr(Path, "replace", until(Path.replace))
    with pytest.raises(KeyboardInterrupt):
        save(path, {"gx": ("deg/s", np.full(3, 2.0))}, 1.0, {"seed": 2})
    recording = load(path)
    assert recording.meta.get("seed") in (recording.columns["gx"].values[0], None)
    assert sorted(file.name for file in tmp_path.iterdir()) in (["log.csv"], ["log.csv", "log.csv.meta.json"])


def test_real_recording() -> None:
    """Length, rate and mean of az are stated with the data: 10^6 rows at 100 Hz, az between -1017.4 and -1014.7 mg."""
    recording = shared_recording("adis16405_run1.npz")
    assert list(recording.columns) == ["gx", "gy", "gz", "ax", "ay", "az"]
    assert (recording.samples, recording.rate_hz, recording.duration_s) == (1_000_000, 100.0, 10_000.0)
    assert -1017.4 < recording.in_unit("az", "mg").mean() < -1014.7
    assert np.unique(np.rint(recording.in_unit("gx", "deg/s") / 0.05)).size > 10


# --------------------------------------------------------------------------------------------------------- time stamps


def stamped(tmp_path: Path, time: NDArray[np.float64], **options: Any) -> tuple[float, dict[int, int]]:
    save(tmp_path / "log.npz", {"gx": ("deg/s", np.zeros(time.size))}, 1.0, t=time)
    recording = load(tmp_path / "log.npz", **options)
    return recording.rate_hz, {row: int(n) for row, n in enumerate(recording.missing_before) if n}


def test_gaps_are_counted(tmp_path: Path) -> None:
    kept = np.delete(np.arange(1000), [3, 500, 501, *range(700, 900)])
    rate, missing = stamped(tmp_path, kept * 0.01)
    assert rate == pytest.approx(100.0, rel=1e-9)
    assert missing == {3: 1, 499: 2, 697: 200}


def test_many_gaps_and_jitter(tmp_path: Path) -> None:
    """2 % missing at random, jitter of 10 % of the interval (sd): a gap of one then shows as 1 +- 0.14 intervals, so
    hardly any of 2000 is misjudged by half an interval, and the rate is right to the share of those in the length."""
    rng = np.random.default_rng(2)
    lost = rng.random(100_000) < 0.02
    lost[[0, -1]] = False
    time = np.flatnonzero(~lost) * 0.01 + rng.normal(0.0, 0.001, np.count_nonzero(~lost))
    rate, missing = stamped(tmp_path, time)
    assert sum(missing.values()) == pytest.approx(np.count_nonzero(lost), abs=10)
    assert rate == pytest.approx(100.0, rel=1.1e-4)


def test_late_samples_are_no_gap(tmp_path: Path) -> None:
    time = np.arange(1000) * 0.01
    time[[100, 400]] += 0.008
    assert stamped(tmp_path, time) == (pytest.approx(100.0, rel=1e-9), {})


def test_stamps_coarser_than_the_interval(tmp_path: Path) -> None:
    """819.2 Hz in whole milliseconds: steps of 1 and 2 ms, none missing; the first step may be misjudged, it has one
    neighbour only, and 1 of 20000 moves the rate by 5e-5."""
    time = np.floor(np.arange(20_000) / 0.8192) / 1000.0
    rate, missing = stamped(tmp_path, time)
    assert rate == pytest.approx(819.2, rel=1e-4)
    assert sum(missing.values()) <= 1


#: Rate (Hz) and lattice (s) of time stamps; the interval is from 0.33 lattice steps (three samples a stamp) to 12.
LATTICES = [
    (819.2, 1e-3), (1000.0, 1e-3), (333.3, 1e-3), (95.0, 1e-3),
    (150.0, 1e-2), (98.0, 1e-2), (100.0, 1e-2), (102.4, 1e-2), (300.0, 1e-2),
]  # fmt: skip


@pytest.mark.parametrize("lost", [0.0, 0.01, 0.03])
@pytest.mark.parametrize(("rate", "lattice"), LATTICES)
def test_coarse_stamps_with_missing_samples(tmp_path: Path, rate: float, lattice: float, lost: float) -> None:
    """20 000 samples, stamps cut to the lattice, samples lost at random: the rate to 3e-4, or one line asking for it.

    A sample is within a lattice step of its stamp, so that a few gaps can be misjudged by one: 6 of 20 000 make 3e-4.
    """
    rng = np.random.default_rng([round(rate * 10), round(lost * 1000)])
    kept = rng.random(20_000) >= lost
    kept[[0, -1]] = True
    index = np.flatnonzero(kept)
    time = np.floor((index / rate + 0.01 * rng.random()) / lattice) * lattice
    try:
        found, missing = stamped(tmp_path, time - time[0])
    except UserError as error:
        assert lost >= 0.03, error  # only where three of a hundred are missing
        what = r"column 't': stamps of .* s (are too coarse to tell|make no even grid).*: give --rate HZ"
        assert re.search(what, str(error))
        found, missing = stamped(tmp_path, time - time[0], rate=rate)
    assert found == pytest.approx(rate, rel=3e-4)
    assert sum(missing.values()) == pytest.approx(20_000 - index.size, abs=6)


@pytest.mark.parametrize("samples", [300, 3000, 30_000])
@pytest.mark.parametrize("lost", [0.05, 0.1, 0.2])
def test_a_thinned_record_on_every_lattice_point(tmp_path: Path, samples: int, lost: float) -> None:
    """10 Hz stamped in tenths of a second, up to one sample in five lost at random: each gap is what the stamps say."""
    rng = np.random.default_rng([samples, round(100 * lost)])
    index = np.flatnonzero(rng.random(samples) >= lost)
    found, missing = stamped(tmp_path, np.round((index - index[0]) * 0.1, 6))
    assert found == pytest.approx(10.0, rel=1e-9)
    assert sum(missing.values()) == index[-1] - index[0] + 1 - index.size


def test_a_thinned_record_of_another_rate_asks_for_it(tmp_path: Path) -> None:
    """9.5 Hz stamped in tenths of a second, one sample in ten lost: not 10 Hz."""
    index = np.flatnonzero(np.random.default_rng(1).random(3000) >= 0.1)
    time = np.floor((index - index[0]) / 9.5 * 10.0) / 10.0
    try:
        found, _ = stamped(tmp_path, time)
    except UserError as error:
        assert "give --rate HZ" in str(error)
        found, _ = stamped(tmp_path, time, rate=9.5)
    assert found == pytest.approx(9.5, rel=3e-4)


def test_an_unbroken_coarse_record_has_no_gap(tmp_path: Path) -> None:
    """Whatever the phase of the first stamp, and however short the record. A step or two of two ms among steps of one
    may as well be lost samples of 1000 Hz."""
    for samples in (5, 20, 100, 2000):
        for phase in np.linspace(0.0, 0.99, 12):
            for rate in (819.2, 700.0, 999.0):
                time = np.floor(np.arange(samples) * 1e3 / rate + phase) / 1e3
                found, missing = stamped(tmp_path, time - time[0])
                jumps = np.count_nonzero(np.diff(time) > 1.5e-3)
                assert missing == {} or (len(missing) == jumps <= 2 and found == pytest.approx(1000.0))
                assert found == pytest.approx(rate, rel=(1.3 + len(missing)) / (samples - 1))  # a step at either end


def test_a_clock_that_wanders_under_coarse_stamps(tmp_path: Path) -> None:
    """20 parts in a million to and fro over 200 000 samples with 1 in 200 missing."""
    rng = np.random.default_rng(4)
    true = np.cumsum((1.0 + 2e-5 * np.sin(np.arange(200_000) / 20_000.0)) / 819.2)
    kept = rng.random(true.size) >= 0.005
    kept[[0, -1]] = True
    time = np.floor(true[kept] * 1e3) / 1e3
    found, missing = stamped(tmp_path, time - time[0])
    assert found == pytest.approx((true.size - 1) / (true[-1] - true[0]), rel=3e-5)
    assert sum(missing.values()) == pytest.approx(true.size - np.count_nonzero(kept), abs=6)


def test_stamps_repeat_only_for_being_coarse(tmp_path: Path) -> None:
    """Three samples a stamp are fine; one row twice is not, nor are stamps that never move."""
    time = np.floor(np.arange(300) / 3.0) / 100.0
    assert stamped(tmp_path, time)[0] == pytest.approx(300.0, rel=0.01)
    time = np.arange(3000) / 100.0
    for row in (200, 250, 1700, 2900):
        time[row:] -= 0.01
    with pytest.raises(UserError, match="row 201: column 't': the time stamp repeats"):
        stamped(tmp_path, time)
    with pytest.raises(UserError, match="row 2: column 't': the time stamp repeats"):
        stamped(tmp_path, np.zeros(300))


def test_short_coarse_records_with_a_gap_ask_for_the_rate(tmp_path: Path) -> None:
    """30 samples at 819.2 Hz in whole ms, two missing: other rates explain that as well."""
    time = np.floor(np.delete(np.arange(40), [11, 25]) / 0.8192) / 1e3
    with pytest.raises(UserError, match="too coarse to tell"):
        stamped(tmp_path, time)
    found, missing = stamped(tmp_path, time, rate=819.2)
    assert found == 819.2
    assert sum(missing.values()) == pytest.approx(2, abs=1)


def test_stated_rate_is_taken_where_it_agrees(tmp_path: Path) -> None:
    time = np.arange(100) * 0.01
    assert stamped(tmp_path, time, rate=99.5)[0] == 99.5
    for wrong in (50.0, 150.0, 200.0):
        with pytest.raises(UserError, match=r"column 't' does not agree with --rate"):
            stamped(tmp_path, time, rate=wrong)


@pytest.mark.parametrize("sign", [",", ";"])
def test_a_separator_between_quotes_separates_nothing(sign: str, tmp_path: Path) -> None:
    """RFC 4180: a quoted cell may hold separators, and two quotes for one. Truth: the numbers that are written."""
    path, values = tmp_path / "quoted.csv", np.random.default_rng(3).normal(size=40).round(6)
    head = sign.join(["t[s]", f'"note{sign} ""one"" [x]"', '"gx[deg/s]"', "b"])
    rows = [sign.join([str(k), f'"a{sign}{sign} ""{k}"""', f"{value:.6f}", "3"]) for k, value in enumerate(values)]
    path.write_text("\n".join([head, *rows]) + "\n")
    np.testing.assert_array_equal(load(path).columns["gx"].values, values)


# ----------------------------------------------------------------------------------------------------------- bad ones

BAD_CSV = {
    "empty": (b"", "the file is empty"),
    "blank lines": (b"\n \n\n", "line 1: the file holds empty lines only"),
    "header only": (HEAD, "line 1: there is a header but no rows"),
    "one row": (HEAD + b"0,1,2\n", "line 2: one row only, a recording needs two or more"),
    "unclosed quote": (ROWS + b'0.3,"1,26\n', "line 5: column 'gx': an unclosed quote: '\"1'"),
    "quote within": (ROWS + b'0.3,1"2,26\n', "line 5: column 'gx': an unclosed quote: '1\"2'"),
    "unclosed quote in header": (b't[s],"gx[deg/s]\n0,1\n1,2\n', "line 1: column 2: an unclosed quote: '\"gx[deg/s]'"),
    "unclosed bracket": (b"t[s],gx[deg/s\n0,1\n1,2\n", "line 1: column 'gx[deg/s': the brackets of its unit do not"),
    "unopened bracket": (b"t[s],gx deg/s]\n0,1\n1,2\n", "line 1: column 'gx deg/s]': the brackets of its unit do not"),
    "text cell": (ROWS + b"0.3,x1,26\n", "line 5: column 'gx': 'x1' is not a number"),
    "empty time": (ROWS + b",1,26\n", "line 5: column 't': no time stamp (an empty cell or NaN)"),
    "nan time": (ROWS + b"NaN,1,26\n", "line 5: column 't': no time stamp (an empty cell or NaN)"),
    "no sample": (HEAD + b"0,,26\n1,nan,26\n", "no sensor column holds a number"),
    "infinity": (ROWS + b"0.3,1,-inf\n", "line 5: column 'temp': infinite"),
    "overflow": (ROWS + b"0.3,1e999,1\n", "line 5: column 'gx': infinite"),
    "underscore": (ROWS + b"0.3,1_0,1\n", "line 5: column 'gx': '1_0' is not a number"),
    "time text": (ROWS + b"12:00,1,26\n", "line 5: column 't': '12:00' is not a number"),
    "time backwards": (ROWS + b"0.15,1,26\n", "line 5: column 't': time runs backwards"),
    "time repeated": (ROWS + b"0.2,1,26\n", "line 5: column 't': the time stamp repeats"),
    "short row": (ROWS + b"0.3,1\n", "line 5: 2 cells where the header has 3"),
    "long row": (ROWS + b"0.3,1,26,\n0.4,1\n", "line 5: 4 cells where the header has 3"),
    "rows that even out": (ROWS + b"0.3,1,26,7\n0.4,1\n", "line 5: 4 cells where the header has 3"),
    "blank line within": (HEAD + b"0,1,2\n\n0.1,1,2\n0.2,1,2\n", "line 3: an empty line"),
    "no unit": (b"t[s],gx\n0,1\n1,2\n", "line 1: column 'gx' has no unit: write gx[deg/s] in the header or give"
                " --unit gx=deg/s"),
    "unknown unit": (b"t[s],gx[furlong]\n0,1\n1,2\n", "line 1: column 'gx' has the unknown unit 'furlong' (known:"),
    "LSB without scale": (b"t[s],gx[LSB]\n0,1\n1,2\n", "line 1: columns with counts of a size that"),
    "time in volts": (b"t[V],gx[deg/s]\n0,1\n1,2\n", "line 1: column 't' is in V, which is not a time"),
    "duplicate column": (b"t[s],gx[deg/s],gx[rad/s]\n0,1,1\n1,2,1\n", "line 1: column 'gx' appears twice"),
    "same column twice": (b"t[s],gx[deg/s],gx[deg/s]\n0,1,1\n1,2,1\n", "line 1: column 'gx' appears twice"),
    "no sensor": (b"t[s],temp[degC]\n0,1\n1,2\n", "line 1: no sensor column (gx, gy, gz, ax, ay, az) among"),
    "no header": (b"0,1,2\n1,2,3\n", "line 1: no sensor column (gx, gy, gz, ax, ay, az) among '0,1,2'"),
    "no time": (b"gx[deg/s]\n1\n2\n", "there is no time column: add t[s] or give --rate HZ"),
    "two separators": (b"t[s];gx[deg/s],a\n0;1,2\n1;2,3\n", "line 1: ',' or ';' could separate the columns: keep one"),
    "two decimal signs": (b"t[s];gx[deg/s]\n0,5;1\n1.5;2\n", "line 3: column 't': '1.5': both ',' and '.' are used as"),
    "thousands": (b"t[s];gx[deg/s]\n0;1\n1;1.234,5\n", "line 3: column 'gx': '1.234,5': both ',' and '.' are used"),
    "comments only": (b"# t[s],gx[deg/s]\n# none\n", "line 1: the file holds comments only"),
    "no header in sight": (b"\n" * 1001 + ROWS, "line 1001: no header in the first 1000"),
    "cut off at two rows": (HEAD + b"0,1,2\n1,2,3", "line 2: one row only, a recording needs two or more"),
    "columns": (b",".join(b"c%d[V]" % k for k in range(100_000)) + b"\n1\n", "line 1: column 1001: more than 1000 "),
    "long heading": (b"g" * 300 + b"[V]\n1\n", "line 1: column 1: a heading of more than 256 characters"),
    "escape in heading": (b"gx[deg/s],\x1b[31m[V]\n1,2\n", "line 1: a heading of more than 256 characters, or some"),
    "markup in heading": (b"gx[/red](V)\n1\n2\n", "line 1: column 'gx[/red]': the brackets of its unit do not"),
    "long line": (ROWS + b"1" * (9 << 20), "line 5: longer than 4,194,304 bytes"),
    "zeros": (bytes(9 << 20), "line 1: not text (byte 0x00)"),
    "binary junk": (bytes(range(1, 256)) * 20, "line 2: not text (byte 0x80)"),
    "zero bytes": (ROWS + b"0.3,\0,1\n", "line 5: not text (byte 0x00)"),
    "not utf-8": (ROWS + b"0.3,\xb5,1\n", "line 5: not text (byte 0xb5)"),
}  # fmt: skip


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
@pytest.mark.parametrize(("data", "expected"), BAD_CSV.values(), ids=BAD_CSV)
def test_bad_csv(tmp_path: Path, name: str, data: bytes, expected: str) -> None:
    text = complaint(written(tmp_path, data, name))
    if data == b"" and name == "log.csv.gz":
        expected = "line 1: the file holds empty lines only"
    assert text.startswith(expected)


def test_first_fault_of_a_long_file(tmp_path: Path) -> None:
    rows = [f"{k / 100},0.5,25" for k in range(50_000)]
    rows[41_234] = "412.34,oops,25"
    rows[45_000] = "450,nan,25"
    text = complaint(written(tmp_path, HEAD + "\n".join(rows).encode()))
    assert text == "line 41236: column 'gx': 'oops' is not a number"  # the header is line 1


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"columns": {"gx": "nope"}}, "line 1: there is no column 'nope' for --column gx=nope"),
        ({"columns": {"gy": "gx"}, "units": {"ax": "g"}}, "line 1: there is no column 'ax' for --unit"),
        ({"columns": {"gy": "gx", "gx": "gx"}}, "line 1: column 'gx' is mapped to two names"),
        ({"columns": {"temp": "gx"}}, "line 1: column 'temp' appears twice"),
        ({"scale": {"gx": (0.05, None)}}, "line 1: column 'gx' is in deg/s: --scale is for columns in LSB"),
        ({"scale": {"ax": (0.05, None)}}, "line 1: there is no column 'ax' for --scale"),
        ({"sensors": ("mx",)}, "line 1: no sensor column (mx) among"),
    ],
)
def test_bad_options(tmp_path: Path, options: dict[str, Any], expected: str) -> None:
    assert complaint(written(tmp_path, ROWS), **options).startswith(expected)


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan")])
def test_bad_scale(tmp_path: Path, size: float) -> None:
    path = written(tmp_path, b"gx[LSB]\n1\n2\n")
    text = complaint(path, rate=1.0, scale={"": (size, None)})
    assert text == "line 1: column 'gx': the size of one LSB must be a number above 0"


@pytest.mark.parametrize("texts", [["x=1=2"], ["gx=big"], ["gx="], ["gx=1", "gx=2"]])
def test_bad_scale_texts(texts: list[str]) -> None:
    with pytest.raises(UserError, match="--scale"):
        parse_scales(texts)


def test_no_recording_at_all(tmp_path: Path) -> None:
    assert complaint(tmp_path / "absent.csv") == "cannot be read: No such file or directory"
    (tmp_path / "folder.csv").mkdir()
    assert complaint(tmp_path / "folder.csv").startswith("is a folder: name a recording in it")
    assert complaint(written(tmp_path, ROWS, "log.xls")).startswith("not a recording: its name ends in none of .csv,")


def test_damaged_gzip(tmp_path: Path) -> None:
    whole = gzip.compress(ROWS * 100)
    path = tmp_path / "log.csv.gz"
    for data in (whole[:-20], whole[:15], ROWS, whole[:40] + b"\xff" * 20 + whole[60:]):
        path.write_bytes(data)
        assert complaint(path).startswith("not a whole gzip file: ")


def test_error_values_of_a_channel_are_no_readings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A probe reads 85 at 30 places of 4000 and -127 at 10, the supply falls for 8 s: the fall is a reading."""
    t = np.arange(4000)
    temp = np.round(31.0 + 3.0 * np.sin(t / 500.0), 2)
    supply = np.where((t > 900) & (t < 908), 3.3, 5.0)
    failed = temp.copy()
    failed[50:3650:120] = 85.0
    failed[100:3700:360] = -127.0
    rows = "".join(f"{k},{k % 7},{a},{b}\n" for k, a, b in zip(t, failed, supply, strict=True))
    recording = load(written(tmp_path, b"t[s],gx[deg/s],temp[degC],supply[V]\n" + rows.encode()))
    assert np.abs(recording.columns["temp"].values - temp).max() < 0.02  # what a straight line misses
    np.testing.assert_array_equal(recording.columns["supply"].values, supply)
    assert "temp: 40 of 4000 readings are far from all others, the first 85: left out" in capsys.readouterr().err


@pytest.mark.parametrize(("rows", "step"), [(40, 30), (500, 400), (40, 20), (100, 97)])
def test_batches_that_repeat_the_end_of_the_last_one(tmp_path: Path, rows: int, step: int) -> None:
    """A logger that writes a window again is refused; --skip-bad has each row once, at the rate that it was read at."""
    random = np.random.default_rng(rows)
    gx = np.round(random.standard_normal(6000), 2)
    places = np.concatenate([np.arange(k, min(k + rows, gx.size)) for k in range(0, gx.size - rows + step, step)])
    text = "".join(f"{0.05 * k:.3f},{gx[k]:.2f}\n" for k in places)
    log = written(tmp_path, b"t[s],gx[deg/s]\n" + text.encode())
    with pytest.raises(UserError, match="rows are written again, which --skip-bad leaves out"):
        load(log)
    recording = load(log, skip_bad=True)
    assert recording.rate_hz == pytest.approx(20.0, rel=1e-6)  # the printed digits
    np.testing.assert_array_equal(recording.columns["gx"].values, gx)
    assert not recording.missing_before.any()


def test_a_counter_that_wraps_may_repeat_a_row(tmp_path: Path) -> None:
    """Stamps of 16 bits at a rate that divides them come again, and coarse readings with them by chance."""
    gx = np.round(2.0 * np.random.default_rng(2).standard_normal(40_000))
    text = "".join(f"{8 * k % 65536},{value:.0f}\n" for k, value in enumerate(gx))
    recording = load(written(tmp_path, b"t[ms],gx[deg/s]\n" + text.encode()))
    np.testing.assert_array_equal(recording.columns["gx"].values, gx)


def test_damaged_meta_beside_a_csv(tmp_path: Path) -> None:
    path = written(tmp_path, ROWS)
    beside = tmp_path / "log.csv.meta.json"
    for text in ("{", "[1]", "\xff"):
        beside.write_bytes(text.encode("latin-1"))
        with pytest.raises(UserError, match=r"log\.csv\.meta\.json: (meta: )?not a JSON"):
            load(path)


GX = np.array([1.0, 2.0, 3.0])
TIME = np.array([0.0, 1.0, 2.0])
BAD_NPZ = {
    "no columns": ({}, "there are no columns"),
    "no unit": ({"gx": GX, "t[s]": TIME}, "column 'gx' has no unit: write gx[deg/s]"),
    "two dimensions": ({"gx[deg/s]": np.ones((3, 2)), "t[s]": TIME}, "column 'gx' has 2 dimensions, not one"),
    "lengths": ({"gx[deg/s]": GX[:2], "t[s]": TIME}, "column 't' has 3 rows, 'gx' has 2"),
    "texts": ({"gx[deg/s]": np.array(["1", "2"])}, "column 'gx' holds no numbers (its type is <U1)"),
    "complex": ({"gx[deg/s]": GX + 1j}, "column 'gx' holds no numbers (its type is complex128)"),
    "nan": ({"gx[deg/s]": np.array([1.0, np.nan]), "t[s]": TIME[:2]}, "1 row with a sample, a recording needs two"),
    "nan time": ({"gx[deg/s]": GX[:2], "t[s]": np.array([0.0, np.nan])}, "row 2: column 't': no time stamp"),
    "infinity": ({"gx[deg/s]": np.array([np.inf, 0.0]), "t[s]": TIME[:2]}, "row 1: column 'gx': infinite"),
    "backwards": ({"gx[deg/s]": GX, "t[ns]": np.array([9, 8, 10], np.uint64)},
                  "row 2: column 't': time runs backwards"),
    "one row": ({"gx[deg/s]": GX[:1], "t[s]": TIME[:1]}, "one row only, a recording needs two or more"),
    "no rows": ({"gx[deg/s]": GX[:0], "t[s]": TIME[:0]}, "no rows, a recording needs two or more"),
    "objects": ({"gx[deg/s]": np.array([1, None])}, "column 'gx' holds no numbers (its type is object)"),
    "no time": ({"gx[deg/s]": GX}, "there is no time column"),
    "meta is no JSON": ({"gx[deg/s]": GX, "meta": np.array("{")}, "meta: not a JSON text"),
    "meta is numbers": ({"gx[deg/s]": GX, "meta": GX}, "meta: cannot be read: it is no text"),
    "meta is a list": ({"gx[deg/s]": GX, "meta": np.array("[]")}, "meta: not a JSON mapping"),
    "meta columns": ({"gx": GX, "meta": np.array('{"columns": {"gx": 5}}')}, "meta: 'columns' must be a mapping"),
    "meta rate": ({"gx[deg/s]": GX, "meta": np.array('{"rate_hz": "fast"}')},
                  "meta: 'rate_hz' must be a number above 0"),
    "meta lsb": ({"gx": GX, "meta": np.array('{"rate_hz": 1, "columns": {"gx": {"unit": "deg/s", "lsb": 0}}}')},
                 "column 'gx': the size of one LSB must be a number above 0"),
    "meta unit": ({"gx": GX, "meta": np.array('{"columns": {"gx": {"unit": 3}}}')},
                  "column 'gx' has the unknown unit '3'"),
}  # fmt: skip


@pytest.mark.parametrize(("arrays", "expected"), BAD_NPZ.values(), ids=BAD_NPZ)
def test_bad_npz(tmp_path: Path, arrays: dict[str, Any], expected: str) -> None:
    path = tmp_path / "log.npz"
    np.savez(path, **arrays)
    assert complaint(path).startswith(expected)


def test_damaged_npz(tmp_path: Path) -> None:
    good, path = tmp_path / "good.npz", tmp_path / "log.npz"
    save(good, {"gx": ("deg/s", np.random.default_rng(3).normal(size=5000))}, 10.0)
    whole = good.read_bytes()
    for cut in (4, 60, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert complaint(path).startswith("not a whole npz file: ")
    path.write_bytes(whole[:5000] + bytes(100) + whole[5100:])
    assert complaint(path).startswith("column 'gx[deg/s]': cannot be read: ")
    for junk in (b"PK", ROWS, bytes(range(256))):
        path.write_bytes(junk)
        assert complaint(path) == "not an npz file"
    path.write_bytes(b"")
    assert complaint(path) == "the file is empty"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("gx[deg/s].npy", b"not an array")
    assert complaint(path).startswith("column 'gx[deg/s]': cannot be read: the magic string is not correct")


def test_time_since_an_epoch_in_ns(tmp_path: Path) -> None:
    """1.7e18 ns is beyond the 2^53 that float64 counts exactly: the rate survives if the start is taken off first."""
    time = 1_700_000_000_000_000_123 + np.rint(np.arange(1000) * 1e9 / 819.2).astype(np.int64)
    np.savez(tmp_path / "log.npz", **{"t[ns]": time, "gx[deg/s]": np.zeros(1000)})
    assert load(tmp_path / "log.npz").rate_hz == pytest.approx(819.2, rel=1e-9)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_rate(tmp_path: Path, rate: float) -> None:
    with pytest.raises(UserError, match="the rate must be above 0 Hz"):
        load(written(tmp_path, ROWS), rate=rate)


def test_in_unit(tmp_path: Path) -> None:
    recording = load(written(tmp_path, ROWS))
    with pytest.raises(UserError, match=r"log\.csv: there is no column 'gy' \(there are gx, temp\)"):
        recording.in_unit("gy", "deg/s")
    with pytest.raises(UserError, match="column 'gx' is in deg/s, which cannot be converted to g"):
        recording.in_unit("gx", "g")


def test_save_says_what_it_cannot_write(tmp_path: Path) -> None:
    columns = {"gx": ("deg/s", np.zeros(2))}
    for name in ("absent/log.csv", "absent/log.csv.gz", "absent/log.npz"):
        with pytest.raises(UserError, match=r"cannot be written: there is no folder .*absent.; make it first"):
            save(tmp_path / name, columns, 1.0)
    with pytest.raises(UserError, match=r"ends in \.csv, \.csv\.gz or \.npz"):
        save(tmp_path / "log.txt", columns, 1.0)


def test_help_names_every_form_that_is_read() -> None:
    """The loaders, the complaint about another name and the help say one list."""
    from typer.testing import CliRunner

    from selfcal.cli import app

    for verb in ("identify", "diagnose", "replay", "compare", "demo"):
        shown = " ".join(CliRunner().invoke(app, [verb, "--help"]).output.split())
        for suffix in (*TEXT, *(one for form in FORMATS for one in form.suffixes), ".gz of text"):
            assert suffix in shown, (verb, suffix)
