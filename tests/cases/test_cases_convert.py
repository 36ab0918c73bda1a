"""`convert` loses nothing: what it writes is read back as the same recording, and answers the same to the last digit.

Truth: the log itself, as `load` reads it. Equality is to the bit: there is no tolerance. The fixture `reads_back` asks
the same of every log that the tests of the readers open.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import logs
import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.logs.recording import Column, Recording, load, save
from selfcal.logs.timebase import Clock
from selfcal.logs.written import laid_out
from selfcal.verbs.convert import convert
from selfcal.verbs.identify import identify

from conftest import assert_alike, case_records, run, shared_case

Floats = NDArray[np.float64]
Random = np.random.Generator
ROWS, RATE_HZ = 4000, 40.0


@pytest.fixture(autouse=True)
def quick(forked: None) -> None:
    """No new Python for each file."""


def assert_same_answer(log: Path, again: Path) -> None:
    """The answers of `identify`, but for the file's name."""
    one, other = (identify(path, suspicion=False) for path in (log, again))
    assert other["axes"] == one["axes"]
    assert {**other["recording"], "path": ""} == {**one["recording"], "path": ""}


@pytest.mark.parametrize("name", logs.WRITERS)
def test_a_log_of_any_form_is_converted_without_loss(name: str, tmp_path: Path) -> None:
    """Every form of tools/pages/logs.md, by either form of a plain recording."""
    log = logs.WRITERS[name](logs.Drawn(seconds=12.0, seed=7), tmp_path)
    again = tmp_path / ("again.csv.gz" if len(name) % 2 else "again.npz")
    convert(log, again)
    assert_alike(load(log), load(again))
    assert_same_answer(log, again)


def stamps(random: Random, kind: str) -> Floats:
    """Stamps of ROWS samples, s."""
    t = np.arange(ROWS) / RATE_HZ
    match kind:
        case "pairs" | "sevens":
            size = 2 if kind == "pairs" else 7
            return np.arange(ROWS) // size * size / RATE_HZ
        case "coarse":
            return np.floor(t / 0.06) * 0.06
        case "lost":
            return np.sort(random.choice(t, round(0.7 * ROWS), replace=False))
        case "jitter":
            return np.sort(t + 1e-3 * random.standard_normal(ROWS))
        case "random":
            return np.cumsum(random.exponential(1.0 / RATE_HZ, ROWS))
        case "two rates":
            return np.cumsum(np.where(np.arange(ROWS) < 1700, 1.0, 2.0) / RATE_HZ)
    return t


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("kind", ["even", "pairs", "sevens", "coarse", "lost", "jitter", "random", "two rates"])
def test_stamps_of_any_kind(kind: str, suffix: str, tmp_path: Path) -> None:
    """Stamps that repeat, that are lost, on no grid: all samples are there, on the clock of the log."""
    random = np.random.default_rng([551, len(kind)])
    t = stamps(random, kind)
    save(tmp_path / "log.npz", {"gx": ("deg/s", 0.2 + 0.3 * random.standard_normal(t.size))}, RATE_HZ, t=17.3 + t)
    convert(tmp_path / "log.npz", tmp_path / f"again{suffix}")
    before, after = load(tmp_path / "log.npz"), load(tmp_path / f"again{suffix}")
    assert after.samples == t.size
    assert_alike(before, after)
    assert_same_answer(tmp_path / "log.npz", tmp_path / f"again{suffix}")


@pytest.mark.parametrize("repeats", ["2", "5", "10"])
def test_the_shared_case(repeats: str, tmp_path: Path) -> None:
    log = shared_case("Q55_repeated.py", tmp_path, "4", repeats)
    assert convert(log, tmp_path / "again.csv").samples == load(tmp_path / "again.csv").samples == 40_000
    assert_same_answer(log, tmp_path / "again.csv")


def drawn_clock(random: Random, rate_hz: float, start_s: float) -> Clock:
    """A clock of some hundred samples, with gaps and stamps of its own or without."""
    n = int(random.integers(2, 300))
    missing = np.where(random.random(n) < random.choice([0.0, 0.2]), random.integers(1, 9, n), 0)
    late = None if random.random() < 0.3 else np.sort(random.choice([0.0, 1e-9, 0.4]) / rate_hz * random.random(n))
    return Clock(rate_hz, missing, late, start_s)


def test_recordings_of_any_clocks_read_back(tmp_path: Path) -> None:
    """Drawn recordings of one to three clocks, whose stamps may meet, nearly meet, repeat, or be those of no grid."""
    random = np.random.default_rng(552)
    for number in range(case_records(60, 2000)):
        main = drawn_clock(random, float(random.choice([10.0, 99.3])), 0.0)
        columns: dict[str, Column] = {}
        for place, axes in enumerate(("gxgygz", "axay", "az")[: int(random.integers(1, 4))]):
            rate_hz = main.rate_hz * float(random.choice([1.0, 0.5, 0.317]))
            clock = None if place == 0 else drawn_clock(random, rate_hz, float(random.choice([0.0, 1e-7, -0.3, 0.7])))
            for name in (axes[k : k + 2] for k in range(0, len(axes), 2)):
                values = random.standard_normal((clock or main).missing_before.size)
                columns[name] = Column(name, "deg/s" if name[0] == "g" else "g", values, clock)
        columns["temp"] = Column("temp", "degC", random.standard_normal(main.missing_before.size))
        started = None if random.random() < 0.3 else 1.7e9 * float(random.random())
        one = Recording(
            Path("drawn"), main.rate_hz, columns, main.missing_before, {}, main.off_grid_s, started_s=started
        )
        laid = laid_out(one)
        assert (np.diff(laid.t) >= 0.0).all()
        path = tmp_path / f"drawn{('.npz', '.csv')[number % 2]}"
        save(path, laid.columns, one.rate_hz, laid.meta, laid.t, exact=True)
        assert_alike(one, load(path))


def test_what_was_stated_holds_in_the_written_file(tmp_path: Path) -> None:
    """Counts, a unit that the heading has wrong, and gravity by the user's word: the file needs no option."""
    random = np.random.default_rng(553)
    t = np.arange(900) / 30.0
    noise = 0.01 * random.standard_normal((4, t.size))
    columns = {"gx": ("LSB", np.rint(50.0 * noise[0])), "ax": ("m/s^2", noise[1]), "ay": ("m/s^2", noise[2])}
    save(tmp_path / "log.csv", {**columns, "az": ("m/s^2", 1.0 + noise[3])}, 30.0, t=t)
    given = {"scale": {"gx": (0.02, "deg/s")}, "units": {"ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2"}}
    convert(tmp_path / "log.csv", tmp_path / "again.csv", **given)  # type: ignore[arg-type]
    assert_alike(load(tmp_path / "log.csv", **given), load(tmp_path / "again.csv"))  # type: ignore[arg-type]


def test_the_meta_of_the_log_stays(tmp_path: Path) -> None:
    """What a simulated recording says of itself is not of the table: it is kept."""
    meta = {"simulated": True, "truth": {"gx": {"N": 0.02}}}
    save(tmp_path / "log.npz", {"gx": ("deg/s", np.random.default_rng(5).normal(size=99))}, 10.0, meta)
    convert(tmp_path / "log.npz", tmp_path / "again.csv")
    again = load(tmp_path / "again.csv").meta
    assert {key: again[key] for key in meta} == meta
    assert again["rows"] == 99


def test_the_command_and_the_log_itself(tmp_path: Path) -> None:
    log = logs.write_phyphox(logs.Drawn(seconds=8.0, seed=3), tmp_path)
    done = run("convert", log, "-o", tmp_path / "x.csv")
    assert done.returncode == 0, done.stderr
    assert "800 rows, 100 Hz, 8 s" in done.stdout
    with pytest.raises(UserError, match="is the log itself"):
        convert(log, log)


def two_clocks(folder: Path) -> Path:
    """The text of a log of two clocks."""
    convert(logs.write_phyphox(logs.Drawn(seconds=4.0, seed=3), folder), folder / "two.csv")
    return folder / "two.csv"


def test_without_its_meta_the_text_is_a_table_as_any(tmp_path: Path) -> None:
    """Another program's view: the same readings, on the clock that the stamps show. So with a rate that is stated."""
    path = two_clocks(tmp_path)
    known = load(path)
    stated = load(path, rate=99.99)
    assert stated.rate_hz == 99.99
    (tmp_path / "two.csv.meta.json").unlink()
    alone = load(path)
    for one in (alone, stated):
        assert list(one.columns) == list(known.columns)
        assert all(np.array_equal(one.columns[name].values, known.columns[name].values) for name in known.columns)
    assert alone.rate_hz == pytest.approx(known.rate_hz, rel=1e-9)


CHANGES: dict[str, Callable[[dict[str, object]], object]] = {
    "a rate": lambda clock: clock.update(rate_hz=0.0),
    "no number": lambda clock: clock.update(rate_hz="1e"),
    "no rate": lambda clock: clock.pop("rate_hz"),
    "a start": lambda clock: clock.update(start_s=float("inf")),
    "no columns": lambda clock: clock.update(columns=3),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_meta_is_one_line(change: str, tmp_path: Path) -> None:
    path = two_clocks(tmp_path)
    beside = tmp_path / "two.csv.meta.json"
    meta = json.loads(beside.read_text(encoding="utf-8"))
    CHANGES[change](meta["clocks"][1])
    beside.write_text(json.dumps(meta), encoding="utf-8")
    with pytest.raises(UserError, match=r"clock 2 does not fit the table.*convert the log again, or give --rate HZ"):
        load(path)
    assert load(path, rate=100.0).rate_hz == 100.0


def test_more_clocks_than_a_table_has_are_none(tmp_path: Path) -> None:
    """40 000 of them in a meta text: the stamps tell the clock, in no time."""
    path = two_clocks(tmp_path)
    beside = tmp_path / "two.csv.meta.json"
    meta = json.loads(beside.read_text(encoding="utf-8"))
    beside.write_text(json.dumps({**meta, "clocks": [3] * 40_000}, indent=None), encoding="utf-8")
    assert load(path).rate_hz == pytest.approx(100.0, rel=1e-6)


@pytest.mark.parametrize("cell", ["-1", "0.5", "7", "1e300"])
def test_places_that_do_not_rise_are_one_line(cell: str, tmp_path: Path) -> None:
    path = two_clocks(tmp_path)
    lines = path.read_text(encoding="utf-8").splitlines()
    place = lines[0].split(",").index("sample")
    cells = lines[3].split(",")
    cells[place] = cell
    lines[3] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(UserError, match="clock 1 does not fit the table"):
        load(path)
