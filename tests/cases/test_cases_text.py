"""Logs as people have them: text forms, clocks, missing cells, and the unit of gravity.

A truth is the number that a record is written with. The limit of N is 4 sd of a white noise from m means, 1/sqrt(2 m)
each, unless a test says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.logs.recording import Recording, load, save
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

from conftest import case_records, shared_case

#: Every log that a test here opens, `convert` writes without loss.
pytestmark = pytest.mark.usefixtures("reads_back")

Floats = NDArray[np.float64]


def white(n: int, sd: float, seed: int, level: float = 0.0) -> Floats:
    return level + sd * np.random.default_rng(seed).standard_normal(n)


def text_of(
    path: Path,
    header: str,
    columns: Sequence[NDArray[Any]],
    form: str,
    separator: str = ",",
) -> Path:
    rows = separator.join([form] * len(columns)) if "%" in form and form.count("%") == 1 else form
    with path.open("w", encoding="utf-8") as file:
        file.write(header + "\n")
        file.writelines(rows % row + "\n" for row in zip(*columns, strict=True))
    return path


def noise_of(log: Path | Sequence[Path], axis: str, **options: Any) -> tuple[float, int, dict[str, Any]]:
    """N of the likeliest law, the number of means, and the axis' document."""
    document = identify(log, axes=[axis], **options)
    found = document["axes"][axis]
    law = max(found["hypotheses"], key=lambda name: found["hypotheses"][name])
    return (
        found["parameters"][law]["N"]["median"],
        int(document["recording"]["duration_s"]),
        found,
    )


def assert_noise(log: Path | Sequence[Path], axis: str, truth: float, **options: Any) -> dict[str, Any]:
    n, means, found = noise_of(log, axis, **options)
    assert n / truth == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * means)), n
    return found


# ------------------------------------------------------------------------------------------------------ shared cases

#: Case: axis, truth of N in the recording's unit, rate of the axis, units of all axes, words that its notes have.
CASES: dict[str, tuple[str, float, float, set[str], str]] = {
    "P01_euroc.py": ("gx", 1.745e-4, 200.0, {"rad/s", "m/s^2"}, ""),
    "P10_micros.py": ("gx", 0.04, 100.0, {"deg/s"}, "wraps 1 time"),
    "P55_ulog2csv.py": ("gz", 1.745e-4, 250.0, {"rad/s", "m/s^2"}, ""),
    "P98_nan_rows.py": ("gx", 0.04, 100.0, {"deg/s"}, "gx 25"),
    "P99_usb_stamps.py": ("gx", 0.009, 5 / 0.05035, {"deg/s"}, ""),
}


@pytest.mark.parametrize("name", CASES)
def test_a_shared_case_is_read_with_its_numbers(tmp_path: Path, name: str) -> None:
    axis, truth, rate, units, words = CASES[name]
    log = shared_case(name, tmp_path)
    recording = load(log)
    assert {column.unit for column in recording.columns.values()} == units
    assert recording.rate_hz == pytest.approx(rate, rel=1e-4)
    assert any(words in text for text in recording.notes) or not words
    found = assert_noise(log, axis, truth)
    assert found["samples_kept_out"]["missing"] == (25 if name.startswith("P98") else 0)


def test_the_small_form_of_euroc(tmp_path: Path) -> None:
    recording = load(shared_case("P01_small.csv", tmp_path))
    assert (recording.rate_hz, recording.samples) == (pytest.approx(5.0, rel=1e-6), 45)
    assert {name: column.unit for name, column in recording.columns.items()} == {
        "gx": "rad/s",
        "ax": "m/s^2",
    }


def test_two_rates_in_one_table(tmp_path: Path) -> None:
    """P97: each axis at its own rate; the diagnosis looks at the common one, or at that of the axis asked for."""
    log = shared_case("P97_multirate.py", tmp_path)
    recording = load(log)
    assert recording.rate_hz == recording.along("gx").rate_hz == pytest.approx(200.0)
    assert (recording.along("az").rate_hz, recording.along("az").samples) == (
        pytest.approx(50.0),
        30_000,
    )
    assert_noise(log, "gx", 0.5 / math.sqrt(200.0))
    found = assert_noise(log, "az", 0.02 / math.sqrt(50.0))
    assert found["rate_hz"] == pytest.approx(50.0) and found["samples_kept_out"]["missing"] == 0
    verdicts = {name: axis["verdict"] for name, axis in diagnose(log, decimate=2.0)["axes"].items()}
    assert verdicts == {"gx": "adequate", "az": "adequate"}


def test_readings_in_g_under_a_heading_of_acceleration(tmp_path: Path) -> None:
    log = shared_case("P27_g_as_ms2.py", tmp_path)
    with pytest.raises(
        UserError,
        match=r"at rest their norm is 1\.00, so the unit is g: give --unit ax=g",
    ) as caught:
        load(log)
    assert "\n" not in str(caught.value)
    assert_noise(log, "ax", 5e-4, units=dict.fromkeys(("ax", "ay", "az"), "g"))


# ------------------------------------------------------------------------------------------------------------- clocks


@pytest.mark.parametrize(("unit", "tick", "rate", "wraps"), [("us", 1e-6, 7.0, 1), ("ms", 1e-3, 0.05, 1),
                                                             ("us", 1e-6, 2.0, 3), ("s", 1e-6, 5.0, 1)])  # fmt: skip
@pytest.mark.parametrize("form", ["csv", "npz"])
def test_a_counter_of_32_bits_wraps(tmp_path: Path, unit: str, tick: float, rate: float, wraps: int, form: str) -> None:
    """The counter starts so that it wraps where it is said; a sample lost at the wrap is counted."""
    span = 2**32
    n = int(span * tick * (wraps - 0.25) * rate)
    step = 1.0 / (rate * tick)
    late = np.random.default_rng(4).integers(0, max(2, int(0.05 * step)), n)
    ticks = (span // 2 + np.rint(np.arange(n) * step).astype(np.int64) + late) % span
    keep = np.ones(n, bool)
    keep[int(np.argmax(np.diff(ticks) < 0)) + 1] = False
    stamps = ticks[keep] * (1e-6 if unit == "s" else 1)
    gyro = white(n, 0.1, 3)[keep]
    if form == "csv":
        log = text_of(tmp_path / "log.csv", f"t[{unit}],gx[deg/s]", (stamps, gyro), "%.6f,%.5f")
    else:
        log = tmp_path / "log.npz"
        counter = stamps if unit == "s" else stamps.astype(np.uint32)
        np.savez(log, **{f"t[{unit}]": counter, "gx[deg/s]": gyro})  # type: ignore[arg-type]
    recording = load(log)
    assert recording.rate_hz == pytest.approx(rate, rel=1e-5)
    assert int(recording.missing_before.sum()) == 1
    assert recording.notes == (
        f"column 't' wraps {wraps} time{'s' if wraps > 1 else ''} like a 32-bit counter: undone",
    )


@pytest.mark.parametrize("back", [1.0, 500.0, 4100.0, 2.0**32 * 1e-6 + 50.0])
def test_another_step_back_is_refused(tmp_path: Path, back: float) -> None:
    """A clock that was set, and a counter that would have wrapped by another number of ticks."""
    time = 6000.0 + np.arange(3000) / 10.0
    time[1000:] -= back
    log = text_of(tmp_path / "log.csv", "t[s],gx[deg/s]", (time, white(3000, 0.1, 1)), "%.4f,%.5f")
    with pytest.raises(UserError, match="line 1002: column 't': time runs backwards"):
        load(log)


def bursts(rate: float, size: int, late_s: float, n: int, seed: int) -> Floats:
    """Stamps of samples that are sent in packets of `size`, each late by an exponential time of mean `late_s`, and
    stamped 0.5 to 1.5 % of the packet's interval apart."""
    random = np.random.default_rng(seed)
    at = np.arange(n)
    packet = (at // size + 1) * size / rate + random.exponential(late_s, n // size + 1)[at // size]
    return np.maximum.accumulate(
        np.sort(packet + at % size * random.uniform(0.005, 0.015, n) * size / rate) + 1e-6 * at
    )


@pytest.mark.parametrize(
    ("rate", "size", "late_s"),
    [(99.32, 5, 0.004), (1125.0, 32, 0.002), (52.0, 10, 0.03)],
)
@pytest.mark.parametrize("stated", [False, True])
def test_stamps_in_bursts_have_a_steady_count(
    tmp_path: Path, rate: float, size: int, late_s: float, stated: bool
) -> None:
    """The rate to the lateness over the record; a second that is lost is counted, to the lateness of a packet."""
    n = 20_000
    time = bursts(rate, size, late_s, n, 5)
    lost = round(rate * 2.0)
    time = np.delete(time, np.arange(8000, 8000 + lost))
    log = text_of(
        tmp_path / "log.csv",
        "t[s],gx[deg/s]",
        (time, white(time.size, 0.09, 4, 4.5)),
        "%.7f,%.5f",
    )
    recording = load(log, rate=rate if stated else None)
    assert recording.rate_hz == pytest.approx(rate, rel=20.0 * late_s / (n / rate))
    assert int(recording.missing_before.sum()) == pytest.approx(lost, abs=2 + 2 * size + 5.0 * late_s * rate)


def test_stamps_of_no_steady_count_are_no_bursts(tmp_path: Path) -> None:
    """A sensor that sends 20 samples at a time, by no clock: the count wanders, and no rate is made up of it."""
    random = np.random.default_rng(2)
    packet = np.cumsum(random.exponential(0.2, 1000))
    time = (packet[:, None] + 1e-4 * np.arange(20)).ravel()
    log = text_of(
        tmp_path / "log.csv",
        "t[s],gx[deg/s]",
        (np.sort(time), white(20_000, 0.1, 1)),
        "%.7f,%.5f",
    )
    try:
        assert load(log).missing_before.sum() > 0
    except UserError as error:
        assert "column 't'" in str(error)


def test_dates_and_times(tmp_path: Path) -> None:
    """ISO 8601 with a zone, without one, with a blank; a summer's day and the night to another month."""
    start = np.datetime64("2024-05-31T23:59:58.500")
    n = 400
    for mark, zone in (("T", "Z"), (" ", ""), ("T", "+02:00"), ("T", "")):
        stamps = [str(start + np.timedelta64(k * 40 + k * 7 % 5, "ms")).replace("T", mark) + zone for k in range(n)]
        log = text_of(
            tmp_path / "log.csv",
            "timestamp,gx[deg/s]",
            (np.array(stamps), white(n, 0.1, 1)),
            "%s,%.4f",
        )
        assert load(log).rate_hz == pytest.approx(25.0, rel=2e-4)  # 2 ms in 16 s
    log.write_text(log.read_text().replace(stamps[7], "yesterday"))
    with pytest.raises(UserError, match="line 9: column 't': 'yesterday' is no date like the first"):
        load(log)
    assert load(log, skip_bad=True).missing_before.sum() == 1


@pytest.mark.parametrize(
    "cell",
    ["31.12.2024 {}", "12/31/2024 {}", "2024/12/31 {}", "{}", "{}.250", "12/31/2024 {} PM", "31.12.24", "1-2-2024 {}"],
)
def test_times_of_other_forms(cell: str, tmp_path: Path) -> None:
    """A time of day counts, whatever the date beside it is. A date alone gets the way out: a unit would not mend it,
    and the message does not ask for one. A name that is no time's is named."""
    times = [f"10:{k // 60:02d}:{k % 60:02d}" for k in range(120)]
    for heading in ("t", "t[s]", "time", "timestamp"):
        log = tmp_path / "log.csv"
        rows = [f"{cell.format(time)},{k % 7}.5\n" for k, time in enumerate(times)]
        log.write_text(f"{heading},gx[deg/s]\n" + "".join(rows), encoding="utf-8")
        if "{}" in cell:
            assert load(log).rate_hz == pytest.approx(1.0)
        else:
            with pytest.raises(UserError) as caught:
                load(log)
            assert f"column 't' begins with '{cell}': write dates as 2024-12-31 10:" in str(caught.value)
            assert "--unit" not in str(caught.value)
        assert load(log, rate=5.0, no_time=True).samples == 120
    rows = [f"2024-12-31 {time},{k % 7}.5\n" for k, time in enumerate(times)]
    log.write_text("when,gx[deg/s]\n" + "".join(rows), encoding="utf-8")
    with pytest.raises(UserError, match="--column t=when"):
        load(log)
    assert load(log, columns={"t": "when"}).rate_hz == pytest.approx(1.0)


def test_no_time_takes_the_stated_rate(tmp_path: Path) -> None:
    n = 500
    stamps = np.random.default_rng(1).uniform(0.0, 1.0, n)
    log = text_of(tmp_path / "log.csv", "t[s],gx[deg/s]", (stamps, white(n, 0.1, 1)), "%.4f")
    with pytest.raises(UserError, match="time runs backwards"):
        load(log, rate=20.0)
    with pytest.raises(UserError, match="give --rate HZ"):
        load(log, no_time=True)
    assert load(log, rate=20.0, no_time=True).duration_s == n / 20.0


# ------------------------------------------------------------------------------------------------------ missing cells


@pytest.mark.parametrize("cell", ["", "nan", "NaN", " ", "NA", "null", '""'])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_cells_without_a_number_are_missing_for_their_axis_alone(tmp_path: Path, cell: str, separator: str) -> None:
    """Two axes of 20 Hz; 40 cells of gx are empty. ay is as without them. A mean
    of 20 samples without one moves by 1/20 of its sd, 40 of 300 means: N by 0.5 %, 1 sd."""
    n, rate = 6000, 20.0
    gone = np.sort(np.random.default_rng(8).choice(n, 40, replace=False))
    gx = np.array([f"{value:.5f}" for value in white(n, 0.2, 6)], object)
    ay = white(n, 0.03, 7)
    whole = text_of(tmp_path / "whole.csv", separator.join(("t[s]", "gx[deg/s]", "ay[m/s^2]")),
                    (np.arange(n) / rate, gx, ay), separator.join(("%.3f", "%s", "%.5f")))  # fmt: skip
    gx[gone] = cell
    log = text_of(tmp_path / "log.csv", separator.join(("t[s]", "gx[deg/s]", "ay[m/s^2]")),
                  (np.arange(n) / rate, gx, ay), separator.join(("%.3f", "%s", "%.5f")))  # fmt: skip
    recording = load(log)
    assert recording.notes == (f"of {n} rows cells without a number, taken as missing samples: gx 40",)
    assert recording.rate_hz == pytest.approx(rate) and recording.missing_before.sum() == 0
    own = recording.along("gx")
    assert own.samples == n - 40 and own.missing_before.sum() == 40
    if (cell, separator) != ("", ","):
        return  # the table is the same
    before, after = (identify(one)["axes"] for one in (whole, log))
    assert after["gx"]["samples_kept_out"]["missing"] == 40
    for axes in (before, after):
        assert axes["ay"]["checks"].pop("channel")["passed"]  # it is of the readings of gx too
    assert after["ay"] == before["ay"]
    for law, value in before["gx"]["parameters"].items():
        median = after["gx"]["parameters"][law]["N"]["median"]
        assert median == pytest.approx(value["N"]["median"], rel=4.0 * math.sqrt(40 / n / 300))


def test_the_engines_agree_about_an_axis_with_missing_cells(tmp_path: Path) -> None:
    """The library and the textbook bank lay the same blocks, however the axis begins."""
    n, rate = 3000, 10.0
    gx = white(n, 0.1, 1)
    gx[:7] = gx[100:131] = math.nan
    log = text_of(tmp_path / "log.csv", "t[s],gx[deg/s],gy[deg/s]",
                  (np.arange(n) / rate, gx, white(n, 0.1, 2)), "%.3f,%.5f,%.5f")  # fmt: skip
    one, other = (identify(log, axes=["gx"], engine=engine)["axes"]["gx"] for engine in ("library", "reference"))
    for law, probability in one["hypotheses"].items():
        assert probability == pytest.approx(other["hypotheses"][law], abs=0.01)
    assert one["samples_kept_out"] == other["samples_kept_out"] and one["samples_kept_out"]["missing"] == 38


@pytest.mark.parametrize(("every", "phase", "lost"), [(2, 1, 0.0), (10, 3, 0.02), (7, 0, 0.0)])
def test_a_regular_pattern_of_empty_cells_is_a_slower_axis(tmp_path: Path, every: int, phase: int, lost: float) -> None:
    """`lost`: share of the slower axis' samples that the logger lost; each is one missing sample of its own."""
    n, rate = 24_000, 80.0
    there = np.arange(n) % every == phase
    there &= np.random.default_rng(3).random(n) >= lost
    sd = 0.02
    ax = np.array([f"{value:.5f}" for value in white(n, sd, 5)], object)
    ax[~there] = ""
    log = text_of(tmp_path / "log.csv", "t[ms],gy[deg/s],ax[m/s^2]", (np.arange(n) * 1000 / rate, white(n, 0.3, 4), ax),
                  "%.4f,%.5f,%s")  # fmt: skip
    recording = load(log)
    own = recording.along("ax")
    assert own.rate_hz == pytest.approx(rate / every, rel=1e-6)
    assert own.samples == there.sum()
    first, last = np.flatnonzero(there)[[0, -1]]
    assert own.missing_before.sum() == (last - first) // every + 1 - there.sum()
    assert recording.clock_of("ax").start_s == pytest.approx(first / rate, abs=1e-6)
    assert_noise(log, "ax", sd / math.sqrt(rate / every))
    assert_noise(log, "gy", 0.3 / math.sqrt(rate))


@pytest.mark.parametrize("heading", ["board [degC]", "NTC (°C)", "case[K]"])
def test_the_only_column_in_degrees_is_the_temperature(heading: str, tmp_path: Path) -> None:
    """By any name, where no column is named a temperature."""
    n = 500
    columns = (np.arange(n) / 50.0, white(n, 0.1, 1), 290.0 + 0.01 * np.arange(n))
    for headings, read in ((heading, True), (f"{heading},{heading.replace('[', 'B[').replace('(', 'B(')}", False)):
        values = (*columns[:2], *[columns[2]] * (1 + headings.count(",")))
        log = text_of(tmp_path / "log.csv", f"t[s],gx[deg/s],{headings}", values, ",".join(["%.5f"] * len(values)))
        recording = load(log)
        assert ("temp" in recording.columns) == read
        if read:
            offset = 273.15 if "K" in heading else 0.0
            assert recording.in_unit("temp", "degC") == pytest.approx(columns[2] - offset, abs=1e-4)


def test_a_slow_temperature_is_bridged(tmp_path: Path) -> None:
    """A column that explains is drawn by straight lines between its samples: a ramp is a ramp again."""
    n = 2000
    temperature = np.array(
        [f"{20 + 0.01 * k:.4f}" if k % 50 == 0 or k == n - 1 else "" for k in range(n)],
        object,
    )
    log = text_of(tmp_path / "log.csv", "t[s],gx[deg/s],temp[degC]",
                  (np.arange(n) / 50.0, white(n, 0.1, 1), temperature), "%.3f,%.5f,%s")  # fmt: skip
    recording = load(log)
    assert recording.samples == n
    assert recording.in_unit("temp", "degC") == pytest.approx(20.0 + 0.01 * np.arange(n), abs=1e-6)


def test_a_dead_column_is_left_out_by_name(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s],gy[deg/s]\n" + "".join(f"{k / 10},{0.1 * (-1) ** k},\n" for k in range(50)))
    recording = load(log)
    assert list(recording.columns) == ["gx"]
    assert recording.notes == ("column 'gy' holds no number and is left out",)


def test_axes_of_several_rates_are_not_replayed_together(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s],az[g]\n"
                   + "".join(f"{k / 10},{k % 7},{k % 5 if k % 2 else ''}\n" for k in range(300)))  # fmt: skip
    with pytest.raises(
        UserError,
        match=r"several sampling rates \(gx 10 Hz, az 5 Hz\): choose those of one",
    ):
        load(log).along("gx", "az")


# --------------------------------------------------------------------------------------------------------- text forms

N_ROWS = 60
GYRO = white(N_ROWS, 0.1, 9)
ROWS = "".join(f"{k / 10:.1f},{value:.5f}\n" for k, value in enumerate(GYRO))
#: Lines before the header, and the header, of a log whose rows are ROWS.
HEADERS = {
    "slashes": "// a sensor\n// t,gx\nt[s],gx[deg/s]\n",
    "percent": "% made by hand\nt[s],gx[deg/s]\n",
    "hash, and the header in it": "# a log\n#t[s],gx[deg/s]\n",
    "keys and values": "device,A7\nrate,10\ngx,0.05\nstart,2024-01-01\nt[s],gx[deg/s]\n",
    "keys with colons": "device: A7\nserial: gx 17\nrange: 2000\n\nt[s],gx[deg/s]\n",
    "a table of units": "gx,deg/s\ngy,deg/s\nt[s],gx[deg/s]\n",
    "a title": "A log of gx at rest\n====\nt[s] , gx [deg s^-1]\n",
    "time by its name": "Time [s],gx (deg/s)\n",
    "power without a sign": "timestamp[s],gx[deg s-1]\n",
}


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS)
def test_lines_before_the_header(tmp_path: Path, header: str) -> None:
    log = tmp_path / "log.csv"
    log.write_text(header + ROWS)
    recording = load(log)
    assert recording.rate_hz == pytest.approx(10.0)
    assert recording.columns["gx"].unit == "deg/s"
    assert recording.columns["gx"].values == pytest.approx(GYRO, abs=1e-5)


@pytest.mark.parametrize("name", ["log.log", "log.txt", "log.log.gz"])
@pytest.mark.parametrize(
    ("header", "separator"),
    [("t[s] gx[deg/s]", "  "), ("t [s]   gx [rad s^-1]", " \t ".strip("\t")), ("t[s]\tgx[deg/s]", "\t"),
     ("t[s];gx[deg/s]", ";"), ("t[s]; gx[deg/s]", "; ")],
)  # fmt: skip
def test_separators_and_suffixes(tmp_path: Path, name: str, header: str, separator: str) -> None:
    import gzip

    log = tmp_path / name
    data = (header + "\n" + ROWS.replace(",", separator)).encode()
    log.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    assert load(log).columns["gx"].values == pytest.approx(GYRO, abs=1e-5)


def test_a_column_that_nobody_asked_for_stops_nothing(tmp_path: Path) -> None:
    """Texts, no unit, an unknown one, no name, twice the same name, a known unit with a word in it."""
    log = tmp_path / "log.csv"
    extra = "note,mag,age[parsec],,flag,flag,aux[V],gyro[0]"
    rows = "".join(f"{line},start,1,2,3,4,5,{'on' if k == 40 else 1.5},7\n" for k, line in enumerate(ROWS.split()))
    log.write_text(f"t[s],gx[deg/s],temp,{extra}\n" + rows.replace(",start", ",21,start"))
    recording = load(log)
    assert list(recording.columns) == ["gx"]
    assert recording.columns["gx"].values == pytest.approx(GYRO, abs=1e-5)
    advice = "write temp[degC], or give --unit temp=degC, or the unit that it is in"
    assert recording.notes == (f"column 'temp' has no unit and is left out: {advice}",)
    with pytest.raises(UserError, match="line 2: column 'note': 'start' is not a number"):
        load(log, units={"note": "V"})
    with pytest.raises(UserError, match="column 'gx': infinite"):
        log.write_text(log.read_text().replace(f"{GYRO[20]:.5f}", "inf"))
        load(log)


@pytest.mark.parametrize(
    "bad",
    ["1.0,x", "1.0", "# pause", "", "1.0,2,3", "\x1b[31m", '1.0,"2'],
)
def test_bad_lines_are_skipped_and_counted(tmp_path: Path, bad: str) -> None:
    lines = ROWS.split()
    lines[10], lines[33] = bad, bad
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s]\n" + "\n".join(lines) + "\n")
    with pytest.raises(UserError, match="line 12: "):
        load(log)
    recording = load(log, skip_bad=True)
    assert recording.notes == ("2 lines are no rows and were skipped",)
    assert int(recording.missing_before.sum()) == 2
    lines[50] = "5.0,inf"
    log.write_text("t[s],gx[deg/s]\n" + "\n".join(lines) + "\n")
    with pytest.raises(UserError, match="line 52: column 'gx': infinite"):
        load(log, skip_bad=True)


def rows_of(n: int, dt: float, seed: int) -> list[str]:
    return [f"{k * dt:.6f},{value:.5f}" for k, value in enumerate(white(n, 0.1, seed))]


@pytest.mark.parametrize("bad", [b"\0\0\0\0", b"\0\1garb,age", b"\xff\xfe,0.2", b"3.0,0\0002", b"12.3,1.2e5.3"])
@pytest.mark.parametrize("stamped", [True, False])
def test_a_skipped_line_is_a_missing_sample(bad: bytes, stamped: bool, tmp_path: Path) -> None:
    """Bytes that are no text too, by stamps and by places alike. Truth: the grid that the rows were written on. A
    single skipped row of many must not stretch it. Without --skip-bad the line is named."""
    rate, n = 25.0, 7000
    rows = [row if stamped else row.split(",")[1] for row in rows_of(n, 1.0 / rate, 3)]
    spoilt = bad if stamped else bad.split(b",")[-1]
    if not stamped and spoilt == b"0.2":
        spoilt = b"\xff" + spoilt
    places = (0, 1234, 1235, 5000, n - 2)
    for count in (1, 5):
        lines = [row.encode() for row in rows]
        for place in places[-count:]:
            lines[place] = spoilt
        log = tmp_path / "log.csv"
        log.write_bytes((b"t[s],gx[deg/s]\n" if stamped else b"gx[deg/s]\n") + b"\n".join(lines) + b"\n")
        with pytest.raises(UserError, match=rf"line {places[-count] + 2}: "):
            load(log, None if stamped else rate)
        recording = load(log, None if stamped else rate, skip_bad=True)
        assert recording.rate_hz == pytest.approx(rate, rel=1e-9)
        inside = [place for place in places[-count:] if place]
        assert int(recording.missing_before.sum()) == len(inside)
        first = min(set(range(n)) - set(places[-count:]))
        at = recording.clock.place + first
        assert set(range(first, n)) - set(at.tolist()) == set(inside)
        text = "1 line is no row and was skipped" if count == 1 else "5 lines are no rows and were skipped"
        assert recording.notes == (text,)


@pytest.mark.parametrize(("rate", "stamps"), [(10.0, "%.6f"), (128.0, "%.6f"), (819.2, "%.4f"), (50.0, "%.5f")])
def test_damaged_stamps_are_named_and_skipped(rate: float, stamps: str, tmp_path: Path) -> None:
    """A digit too many or another one. The message names this line, and not the next one; --skip-bad skips it. Truth:
    the grid that the rows were written on."""
    n = 4000
    texts = [stamps % (k / rate) for k in range(n)]
    values = white(n, 0.1, 4)
    log = tmp_path / "log.csv"

    def write(damaged: dict[int, str]) -> None:
        cells = [damaged.get(k, text) for k, text in enumerate(texts)]
        rows = (f"{cell},{value:.5f}" for cell, value in zip(cells, values, strict=True))
        log.write_text("t[s],gx[deg/s]\n" + "\n".join(rows) + "\n")

    write({})
    clean = load(log, skip_bad=True)
    assert not clean.missing_before.any()
    damaged = {700: "9" + texts[700], 1500: "0.01", 1501: "0.01", 2222: "1e3", 3000: "-" + texts[3000]}
    for count in (1, len(damaged)):
        some = dict(list(damaged.items())[:count])
        write(some)
        with pytest.raises(UserError, match="line 702: column 't': the time stamp is later than the next one"):
            load(log)
        recording = load(log, skip_bad=True)
        assert recording.rate_hz == pytest.approx(clean.rate_hz, rel=1e-6)
        were = "5 lines were" if count > 1 else "1 line was"
        assert recording.notes == (f"{were} skipped for a damaged time stamp", *clean.notes)
        assert recording.samples == n - count
        assert int(recording.missing_before.sum()) == count


def test_other_faults_of_time_are_no_damaged_digits(tmp_path: Path) -> None:
    """A clock that begins anew, two sensors' stamps in turn: refused with --skip-bad as without, and nothing is taken
    out. A block of rows written twice is refused, and left out with --skip-bad, which the message names."""
    log = tmp_path / "log.csv"
    rows = rows_of(600, 0.04, 5)
    anew = rows + rows_of(600, 0.04, 6)
    twice = rows[:300] + rows[280:]
    in_turn = [row for k, one in enumerate(rows) for row in (one, f"{5000.0 + 0.04 * k},0.1")]
    for made in (anew, twice, in_turn):
        log.write_text("t[s],gx[deg/s]\n" + "\n".join(made) + "\n")
        for skip_bad in (False, True):
            if made is twice and skip_bad:
                assert load(log, skip_bad=True).samples == 600
                continue
            with pytest.raises(UserError, match="column 't': time runs backwards") as caught:
                load(log, skip_bad=skip_bad)
            assert ("--skip-bad" in str(caught.value)) == (made is twice)
            assert "--no-time --rate HZ" in str(caught.value)
            assert load(log, 25.0, no_time=True).samples == len(made)


def test_a_file_of_other_lines_is_refused_all_the_same(tmp_path: Path) -> None:
    """Nothing is kept of lines that are skipped beyond their number, and that has an end."""
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s]\n0,1\n1,2\n" + "x\n" * 100_000)
    with pytest.raises(UserError, match=r"line \d+: \d+ lines so far are no rows of its columns"):
        load(log, skip_bad=True)


def test_more_rates_than_a_recording_has(tmp_path: Path) -> None:
    """Patterns of empty cells are bounded before their clocks are worked out."""
    names = [f"m{k}" for k in range(12)]
    rows = (",".join([str(row), *("1" if row % (k + 2) == 0 else "" for k in range(12))]) for row in range(600))
    log = tmp_path / "log.csv"
    log.write_text("t[s]," + ",".join(f"{name}[g]" for name in names) + "\n" + "\n".join(rows) + "\n")
    with pytest.raises(UserError, match="more than 8 patterns of empty cells"):
        load(log, sensors=names)


# --------------------------------------------------------------------------------------------------------- two files


def two_files(folder: Path, later_s: float, rates: tuple[float, float], epoch: float = 0.0) -> list[Path]:
    """A gyro's file, and an accelerometer's that begins later; 300 s each."""
    found = []
    for name, heading, rate, start, sd in (
        ("gyro.csv", "gx[deg/s]", rates[0], 0.0, 0.3),
        ("accel.csv", "az[m/s^2]", rates[1], later_s, 0.02),
    ):
        n = int(300 * rate)
        found.append(text_of(folder / name, f"t[s],{heading}",
                             (epoch + start + np.arange(n) / rate, white(n, sd, n)), "%.6f,%.5f"))  # fmt: skip
    return found


@pytest.mark.parametrize(
    ("later_s", "rates"),
    [(0.0, (100.0, 25.0)), (-3.2, (52.0, 104.0)), (0.004, (50.0, 50.0))],
)
def test_two_files_of_one_recording(tmp_path: Path, later_s: float, rates: tuple[float, float]) -> None:
    logs = two_files(tmp_path, later_s, rates, epoch=1.7e9)
    recording = load(logs)
    for name, rate in zip(("gx", "az"), rates, strict=True):
        assert recording.along(name).rate_hz == pytest.approx(rate, rel=1e-6)
    apart = recording.clock_of("az").start_s - recording.clock_of("gx").start_s
    assert apart == pytest.approx(later_s, abs=1e-5)
    assert_noise(logs, "gx", 0.3 / math.sqrt(rates[0]))
    assert_noise(logs, "az", 0.02 / math.sqrt(rates[1]))
    assert set(diagnose(logs, decimate=1.0)["axes"]) == {"gx", "az"}


def test_two_files_with_one_clock_are_one_table(tmp_path: Path) -> None:
    recording = load(two_files(tmp_path, 0.0, (50.0, 50.0)))
    assert all(column.clock is None for column in recording.columns.values())


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (
            lambda folder: [one := two_files(folder, 0.0, (10.0, 10.0))[0], one],
            "column 'gx' is in more than one",
        ),
        (lambda folder: two_files(folder, 1e6, (10.0, 10.0)), "do not overlap in time"),
    ],
)
def test_files_that_are_not_of_one_recording(tmp_path: Path, make: Callable[[Path], list[Path]], what: str) -> None:
    with pytest.raises(UserError, match=what):
        load(make(tmp_path))


# ------------------------------------------------------------------------------------------------------------- gravity


def tilted(norm: float, seed: int, noise: float, n: int = 2000) -> dict[str, Floats]:
    """Three accelerometers at rest in any attitude."""
    random = np.random.default_rng(seed)
    down = random.standard_normal(3)
    down *= norm / np.linalg.norm(down)
    return {
        name: level + noise * norm * random.standard_normal(n)
        for name, level in zip(("ax", "ay", "az"), down, strict=True)
    }


def gravity_log(folder: Path, unit: str, values: dict[str, Floats], rate: float = 20.0) -> Path:
    save(folder / "log.npz", {name: (unit, one) for name, one in values.items()}, rate)
    return folder / "log.npz"


IN_UNIT = {"g": 1.0, "mg": 1000.0, "m/s^2": 9.80665, "mm/s^2": 9806.65}


@pytest.mark.parametrize("heading", IN_UNIT)
@pytest.mark.parametrize("true", IN_UNIT)
def test_gravity_names_the_unit(tmp_path: Path, heading: str, true: str) -> None:
    """4 % off either way, as an uncalibrated part is."""
    for seed, off in ((1, 0.96), (2, 1.04)):
        log = gravity_log(tmp_path, heading, tilted(off * IN_UNIT[true], seed, 1e-3))
        if heading == true:
            assert load(log).notes == ()
            continue
        with pytest.raises(
            UserError,
            match=f"so the unit is {true.replace('^', '.')}: give --unit ax={true[:1]}",
        ):
            load(log)
        assert load(log, units=dict.fromkeys(("ax", "ay", "az"), true)).columns["ax"].unit == true
        assert load(log, units=dict.fromkeys(("ax", "ay", "az"), heading)).columns["ax"].unit == heading


def test_gravity_is_not_looked_for_in_motion_or_with_two_axes(tmp_path: Path) -> None:
    """Readings whose level moves by more than it is; and a part that has no third axis."""
    turning = tilted(1.0, 3, 1e-3)
    turn = np.linspace(0.0, 6.0, 2000)
    turning["ax"], turning["ay"] = np.cos(turn), np.sin(turn)
    assert load(gravity_log(tmp_path, "m/s^2", turning)).notes == ()
    two = {name: one for name, one in tilted(1.0, 4, 1e-3).items() if name != "ay"}
    assert load(gravity_log(tmp_path, "m/s^2", two)).notes == ()


def test_gravity_has_a_clean_twin(tmp_path: Path) -> None:
    """Sound parts of each unit, 6 % of scale or 60 mg of bias: none is refused."""
    for seed in range(case_records(20, 200)):
        random = np.random.default_rng([9, seed])
        unit = list(IN_UNIT)[seed % 4]
        values = tilted(
            IN_UNIT[unit] * random.uniform(0.94, 1.06),
            seed,
            10.0 ** random.uniform(-4.0, -2.0),
            400,
        )
        recording: Recording = load(gravity_log(tmp_path, unit, values))
        assert recording.notes == ()


# ----------------------------------------------------------------------------------------------- clean twins of clocks


def test_scattered_missing_cells_make_no_slower_axis(tmp_path: Path) -> None:
    """From 1 to 45 % of the cells of gx at random, single or in runs: the axis keeps the rate of the table."""
    for seed in range(case_records(20, 200)):
        random = np.random.default_rng([4, seed])
        n, rate = 2000, random.uniform(1.0, 400.0)
        gone = random.random(n) < random.uniform(0.01, 0.45)
        if seed % 2:
            start = random.integers(10, 1000)
            gone[:] = False
            gone[start : start + random.integers(2, 900)] = True
        gx = np.where(gone, np.nan, white(n, 0.1, seed))
        np.savez(tmp_path / "log.npz", **{"t[s]": np.arange(n) / rate, "gx[deg/s]": gx, "gy[deg/s]": white(n, 0.1, 1)})
        recording = load(tmp_path / "log.npz")
        own = recording.along("gx")
        assert recording.columns["gx"].clock is None
        assert own.rate_hz == pytest.approx(rate, rel=1e-6)
        assert own.samples + own.missing_before.sum() == n - np.argmax(~gone[::-1])


def test_sound_stamps_are_neither_bursts_nor_wraps(tmp_path: Path) -> None:
    """Jitter up to 20 % of the interval and samples lost at random up to 5 %: the losses are counted to 1 % of the
    samples, and the rate is right to their share."""
    for seed in range(case_records(20, 200)):
        random = np.random.default_rng([5, seed])
        n, rate = 4000, random.uniform(1.0, 400.0)
        kept = np.flatnonzero(random.random(n) >= random.uniform(0.0, 0.05))
        time = (kept + random.uniform(0.0, 0.2) * random.standard_normal(kept.size).clip(-1.5, 1.5)) / rate
        np.savez(tmp_path / "log.npz", **{"t[s]": time, "gx[deg/s]": white(kept.size, 0.1, seed)})
        recording = load(tmp_path / "log.npz")
        lost = kept[-1] - kept[0] + 1 - kept.size
        assert int(recording.missing_before.sum()) == pytest.approx(lost, abs=0.01 * n)
        assert recording.rate_hz == pytest.approx(rate, rel=0.011)
        assert recording.notes == ()


def test_the_fast_axis_beside_a_slower_one_can_be_taken_along_twice(tmp_path: Path) -> None:
    """`replay` does. A bridged column has the clock that it was bridged to."""
    random = np.random.default_rng(7)
    names = []
    for name, rate, unit in (("gx", 25.0, "deg/s"), ("az", 10.0, "m/s^2")):
        n = round(60.0 * rate)
        names.append(tmp_path / f"{name}.csv")
        rows = np.column_stack([np.arange(n) / rate, random.normal(size=n)])
        np.savetxt(names[-1], rows, "%.9g", ",", header=f"t[s],{name}[{unit}]", comments="")
    once = load(names).along("gx")
    assert {one.values.size for one in once.columns.values()} == {1500}
    assert {one.values.size for one in once.along("gx").columns.values()} == {1500}


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_log_cut_amid_its_last_line_loses_that_line_alone(separator: str, tmp_path: Path) -> None:
    """At each byte of it, with a word."""
    rows = [f"{0.05 * k:.2f}{separator}{0.01 * (k % 9):.4f}{separator}{-0.02 * (k % 7):.4f}" for k in range(60)]
    head = separator.join(("t[s]", "gx[deg/s]", "gy[deg/s]"))
    text = "\n".join([head, *rows]) + "\n"
    log = tmp_path / "log.csv"
    for left in range(len(rows[-1])):
        log.write_text(text[: len(text) - 1 - len(rows[-1]) + left], encoding="utf-8")
        assert load(log).samples == 59


def test_readings_far_beyond_the_range_ask_for_the_unit(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """40 000 deg/s are beyond a range of 300: one line, no warning of a library."""
    values = 4e4 + 0.1 * np.random.default_rng(3).standard_normal(900)
    rows = "\n".join(f"{0.1 * k:.1f},{value:.4f}" for k, value in enumerate(values))
    (tmp_path / "log.csv").write_text(f"t[s],gx[deg/s]\n{rows}\n", encoding="utf-8")
    with pytest.raises(UserError, match="beyond the range of 300 deg/s: is the unit right"):
        identify(tmp_path / "log.csv")
    assert "Warning" not in capfd.readouterr().err


def in_turn(path: Path, head: str, words: Sequence[str], levels: Sequence[float], turn: int, rows: int) -> Path:
    """Rows of sensors in turn, `turn` rows each at 40 Hz, a millisecond apart, told apart by a word."""
    random = np.random.default_rng(8)
    lines = [
        f"{(k * turn + j) / 40.0 + 0.001 * place:.3f},{word},{level + 0.01 * random.standard_normal():.5f}"
        for k in range(rows // turn)
        for place, (word, level) in enumerate(zip(words, levels, strict=True))
        for j in range(turn)
    ]
    path.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("heading", ["source", "what", "Sensor Name", "msg"])
@pytest.mark.parametrize("turn", [1, 12])
@pytest.mark.parametrize("words", [("Gyro_A", "Gyro_B"), ("imu.left", "imu.right", "imu.mid")])
def test_sensors_told_apart_by_a_word_are_never_mixed(
    heading: str, turn: int, words: Sequence[str], tmp_path: Path
) -> None:
    """Whatever the column's name. Each way that the line names reads that sensor's rows alone."""
    levels = [0.5 + 2.0 * k for k in range(len(words))]
    log = in_turn(tmp_path / "log.csv", f"t[s],{heading},gx[deg/s]", words, levels, turn, 1200)
    with pytest.raises(UserError, match="several sensors: give --source") as caught:
        load(log)
    for word, level in zip(words, levels, strict=True):
        source = f"{heading}:{word}"
        assert f"--source '{source}' (gx; 40 Hz" in str(caught.value)
        recording = load(log, sources=[source])
        assert (recording.samples, int(recording.missing_before.sum())) == (1200, 0)
        assert recording.rate_hz == pytest.approx(40.0, rel=1e-9)
        assert recording.columns["gx"].values == pytest.approx(level, abs=0.06)


def test_axes_of_a_long_form_are_named_by_the_user(tmp_path: Path) -> None:
    """Headings without a sensor's name or unit: one line leads on, and its ways read one sensor."""
    log = in_turn(tmp_path / "log.csv", "time,kind,value", ("gyr", "acc"), (0.2, 9.8), 1, 900)
    with pytest.raises(UserError, match=r"no sensor column .*--column gx=NAME, and --unit gx=UNIT"):
        load(log)
    options: dict[str, Any] = {"columns": {"gx": "value"}, "units": {"gx": "deg/s", "t": "s"}}
    with pytest.raises(UserError, match="--source 'kind:gyr'"):
        load(log, **options)
    recording = load(log, sources=["kind:gyr"], **options)
    assert recording.samples == 900 and recording.columns["gx"].values == pytest.approx(0.2, abs=0.06)


@pytest.mark.parametrize(
    "word",
    [
        lambda k, r: "warn" if r.random() < 0.3 else "ok",
        lambda k, r: "heat" if k // 150 % 2 else "cool",
        lambda k, r: "pps" if k % 25 == 0 else "none",
        lambda k, r: "start" if k == 0 else "run",
    ],
    ids=["at random", "for long", "seldom", "once"],
)
def test_a_state_in_words_is_no_sensor(word: Callable[[int, np.random.Generator], str], tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    rows = "\n".join(f"{k / 50:.2f},{word(k, random)},{random.standard_normal():.4f}" for k in range(3000))
    (tmp_path / "log.csv").write_text(f"t[s],state,gx[deg/s]\n{rows}\n", encoding="utf-8")
    assert load(tmp_path / "log.csv").samples == 3000


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("t[s],gx[deg/s]", lambda t, g: f"{t:.3f},{g:.4f},"),
        ("t[s],gx[deg/s]", lambda t, g: f'"{t:,.3f}",{g:.4f}'),
        ("t[s];gx[deg/s]", lambda t, g: f"{t:.3f};{g:.4f};"),
        ("sec,nanosec,gx[deg/s]", lambda t, g: f"{1_650_000_000 + int(t)},{round(t % 1 * 1e9)},{g:.4f}"),
        ("stamp.secs,stamp.nsecs,gx[deg/s]", lambda t, g: f"{int(t)},{round(t % 1 * 1e9)},{g:.4f}"),
        ("time,gx[deg/s]", lambda t, g: f"20230228T23{int(t) // 60 % 60:02d}{t % 60:06.3f},{g:.4f}"),
    ],
    ids=[
        "a comma ends a row",
        "thousands in quotes",
        "a semicolon ends a row",
        "seconds and ns",
        "of ROS 1",
        "compact",
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_more_forms_of_text(head: str, row: Callable[[float, float], str], end: str, tmp_path: Path) -> None:
    """The numbers that were written, from 1400 s on: thousands appear, minutes change. Lines end as on any system."""
    values = np.round(white(4000, 0.3, 6), 4)
    rows = [row(1400.0 + k / 8.0, value) for k, value in enumerate(values.tolist())]
    log = tmp_path / "log.csv"
    log.write_bytes((end.join([head, *rows]) + end).encode())
    recording = load(log)
    assert recording.rate_hz == pytest.approx(8.0, rel=1e-9)
    assert np.array_equal(recording.columns["gx"].values, values)


def test_a_comma_in_quotes_may_be_a_decimal_sign(tmp_path: Path) -> None:
    """One comma and no point: refused, not guessed."""
    rows = "\n".join(f'"{k},250",{k % 7}' for k in range(100))
    (tmp_path / "log.csv").write_text(f"t[s],gx[deg/s]\n{rows}\n", encoding="utf-8")
    with pytest.raises(UserError, match="line 2: column 't': '0,250' is not a number"):
        load(tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("name", "arguments", "rate"),
    [
        ("Q10_duty.py", "2", 50.0),
        ("Q10_duty.py", "3 1 10 100 7200", 100.0),
        ("Q10_duty.py", "4 30 600 20 43200", 20.0),
        ("Q04_fifobatch.py", "5", 112.0),
        ("Q04_fifobatch.py", "6 96", 96.0),
        ("Q04_fifobatch.py", "7 101", 101.0),
        ("Q01_wrap24.py", "8", 100.0),
    ],
)
def test_a_shared_case_of_stamps_has_its_noise(name: str, arguments: str, rate: float, tmp_path: Path) -> None:
    """N 0.04 deg/s/sqrt(Hz) is within four sd of its posterior, as the likeliest law has it. None is lost awake."""
    log = shared_case(name, tmp_path, *arguments.split())
    recording = load(log)
    assert recording.rate_hz == pytest.approx(rate, rel=1e-4)
    assert bool(recording.missing_before.any()) == name.startswith("Q10")
    axis = identify(log, axes=["gx"], suspicion=False)["axes"]["gx"]
    law = max(axis["hypotheses"], key=lambda one: axis["hypotheses"][one])
    noise = axis["parameters"][law]["N"]
    assert abs(math.log(noise["median"] / 0.04)) < 4.0 * math.log(noise["q95"] / noise["q05"]) / 3.29
