"""An advice is typed as it is printed, and the answer is right.

Truth: N and the bias that each log was drawn with. The tolerance is 4.5 sd of the answer's own posterior, a chance of
7e-6, and for the bias also that of the white noise over the record.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import logs
import numpy as np
import pytest
from advice import advised
from numpy.typing import NDArray

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.logs.recording import load, save
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.replay import replay

from conftest import SHARED_CASES, case_records, run, shared_case

Floats = NDArray[np.float64]

RATE_HZ, ROWS = 20.0, 9000
#: Of gyros deg/s, of accelerometers m/s^2.
N, BIAS = 0.05, 0.4


@pytest.fixture(autouse=True)
def quick(forked: None) -> None:
    """No new Python for each file."""


def white(seed: int, rows: int = ROWS, rate_hz: float = RATE_HZ) -> Floats:
    return BIAS + N * math.sqrt(rate_hz) * np.random.default_rng([548, seed]).standard_normal(rows)


def table(folder: Path, **columns: Floats) -> Path:
    """A text with these headings."""
    cells = [np.char.mod("%.9g", values) for values in columns.values()]
    rows = "\n".join(map(",".join, zip(*cells, strict=True)))
    heading = ",".join(columns)
    (folder / "log.csv").write_text(f"{heading}\n{rows}\n", encoding="utf-8")
    return folder / "log.csv"


def headed(headings: str, *columns: Floats) -> Callable[[Path], Path]:
    """What writes a text of these columns."""
    return lambda folder: table(folder, **dict(zip(headings.split(","), columns, strict=True)))


TIME = np.arange(ROWS) / RATE_HZ


def filtered(folder: Path) -> Path:
    """The part puts out the mean of 4 s: white below its corner."""
    rate_hz, mean = 25.0, 100
    rows = 40 * ROWS // 4
    noise = white(11, rows + mean - 1, rate_hz)
    save(folder / "log.npz", {"gx": ("deg/s", np.convolve(noise, np.full(mean, 1.0 / mean), "valid"))}, rate_hz)
    return folder / "log.npz"


def walking(folder: Path) -> Path:
    """A twelfth of N, and a walk that moves 3.4 of that in a second: an average of 1 s hides the white noise."""
    walk = 3.4 * N / 12.0 / math.sqrt(RATE_HZ) * np.random.default_rng(9).standard_normal(ROWS).cumsum()
    save(folder / "log.npz", {"gx": ("deg/s", white(12) / 12.0 + walk)}, RATE_HZ)
    return folder / "log.npz"


def lossy(folder: Path) -> Path:
    """Seven readings of eight are lost, at random: no average of 1 s is whole."""
    kept = np.random.default_rng(8).random(ROWS) < 0.12
    return headed("t[s],gx[deg/s]", TIME[kept], white(23)[kept])(folder)


def with_gravity(folder: Path) -> Path:
    """Three axes in g under a heading of m/s^2."""
    ay, az = white(18) - BIAS + 0.6 * units.STANDARD_GRAVITY, white(19) - BIAS + 0.8 * units.STANDARD_GRAVITY
    values = [one / units.STANDARD_GRAVITY for one in (white(17), ay, az)]
    return headed("t[s],ax[m/s^2],ay[m/s^2],az[m/s^2]", TIME, *values)(folder)


def two_imus(folder: Path) -> Path:
    record = logs.Drawn(rate=RATE_HZ, seconds=ROWS / RATE_HZ)
    gyro = np.radians(np.column_stack([white(k) for k in (13, 14, 15)]))
    return logs.write_ros1(record, folder, {"/a/imu": (gyro, record.accel), "/b/imu": (3.0 * gyro, record.accel)})


@dataclass(frozen=True)
class Case:
    """A log, the options that it is first read with, what the reader of the advice knows, the part of the advice that
    is typed (all of it), the axis that is asked for, its N and its bias."""

    log: Callable[[Path], Path]
    given: tuple[str, ...] = ()
    known: Mapping[str, str] = field(default_factory=dict)
    chosen: Callable[[list[str]], list[str]] = list
    axis: str = "gx"
    N: float = N
    bias: float | None = BIAS


CASES = {
    "an unknown rate": Case(headed("t[s],gx[blip/s]", TIME, white(1) / 7.5), known={"SIZE": "7.5"}),
    "an unknown acceleration": Case(
        headed("t[s],ay[smoot/s^2]", TIME, white(2) / 1.702), (), {"SIZE": "1.702"}, axis="ay"
    ),
    "an unknown time": Case(headed("t[jiffy],gx[deg/s]", TIME / 0.01, white(3)), known={"SIZE": "0.01"}),
    "no unit": Case(headed("t[s],gx", TIME, white(4))),
    "no units": Case(headed("t,Gyro X,Gyro Y", TIME, white(5), white(6))),
    "counts": Case(headed("t[s],gx[LSB]", TIME, np.rint(white(7) / 0.002)), known={"SIZE": "0.002"}),
    "no heading": Case(
        headed("t[s],Kreisel 1", TIME, np.radians(white(8))), (), {"NAME": "Kreisel 1", "UNIT": "rad/s"}
    ),
    "no time": Case(headed("gx[deg/s]", white(9)), known={"HZ": f"{RATE_HZ:g}"}),
    "another rate": Case(
        headed("t[s],gx[deg/s]", 3.0 * TIME, white(10)), ("--rate", f"{RATE_HZ:g}"), {}, lambda typed: typed[-1:]
    ),
    "a filter in the part": Case(filtered),
    "a fast walk": Case(walking, N=N / 12.0, bias=None),
    "lost readings": Case(lossy),
    "gravity": Case(with_gravity, axis="ax"),
    "two sensors": Case(two_imus, chosen=lambda typed: typed[:2]),
}


def answer(log: Path, *options: str) -> tuple[str, dict[str, object]]:
    """What the command says, and the JSON of the axes; {} without an answer."""
    done = run("identify", log, *options, "--no-suspicion", "--json", "-")
    assert done.returncode in (0, 2), done.stderr
    return done.stderr, json.loads(done.stdout)["axes"] if done.returncode == 0 else {}


@pytest.mark.parametrize("name", CASES)
def test_the_answer_after_the_advice_is_right(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    log = case.log(tmp_path)
    said, first = answer(log, *case.given)
    assert not first or not first[case.axis]["adequate"]  # type: ignore[index]
    typed = case.chosen(advised(said, case.known))
    assert typed, said
    said, axes = answer(log, *case.given, *typed)
    assert axes, said
    axis: dict = axes[case.axis]  # type: ignore[assignment, type-arg]
    law = max(axis["hypotheses"], key=axis["hypotheses"].get)
    found, bias = axis["parameters"][law]["N"], axis["bias_now"]
    unit = "deg/s" if case.axis[0] == "g" else "m/s^2"
    size = units.factor(bias["unit"], unit)
    assert abs(found["median"] * size - case.N) < 4.5 * found["sd"] * size, (typed, axis["checks"])
    if case.bias is not None:
        off = math.hypot(bias["sd"] * size, N * math.sqrt(RATE_HZ / ROWS))
        assert abs(bias["mean"] * size - case.bias) < 4.5 * off
    assert axis["adequate"], axis["checks"]


def test_swapped_words_have_no_advice_of_a_rate(tmp_path: Path) -> None:
    """The readings that happen to lie within the range are none of a sensor: no rate shows one."""
    log = shared_case("Q48_wordswap.py", tmp_path, "5")
    said, axes = answer(log)
    assert not axes
    assert "89 % of the readings are beyond the range" in said
    assert advised(said) == []
    assert not answer(log, "--decimate", "50")[1]


@pytest.mark.parametrize(("share", "limit"), [(0.6, math.inf), (0.95, math.inf), (0.8, 0.5)])
def test_most_readings_beyond_the_range(share: float, limit: float, tmp_path: Path) -> None:
    """The same of any damage: here a byte in the place of the sign's. It is a share of all readings, also where the
    others are clipped, and so few of them are left."""
    values = np.minimum(white(21), limit)
    values[np.random.default_rng(3).random(ROWS) < share] *= 4096.0
    log = headed("t[s],gx[deg/s]", TIME, values)(tmp_path)
    said, axes = answer(log)
    assert not axes
    line = f"{100.0 * float(np.mean(np.abs(values) > 300.0)):.0f} % of the readings are beyond the range of 300 deg/s"
    assert line in said
    assert advised(said) == []
    for verb in (diagnose, replay):  # of the same record the same line
        with pytest.raises(UserError, match=line):
            verb(log, axes=["gx"])


def test_an_unknown_unit_of_the_temperature(tmp_path: Path) -> None:
    """The column is left out, with a line. With what the line says to type it is read."""
    log = headed("t[s],gx[deg/s],temp[digitF]", TIME, white(22), 5.0 * TIME)(tmp_path)
    said, _ = answer(log)
    typed = advised(said, {"SIZE": "0.004"})
    assert typed == ["--scale", "temp=0.004[degC]"]
    said, axes = answer(log, *typed)
    assert axes and "left out" not in said


@pytest.mark.parametrize(("unit", "size_s"), [("min", 60.0), ("hours", 3600.0), ("d", 86_400.0), ("cs", 0.01)])
def test_time_in_any_unit(unit: str, size_s: float, tmp_path: Path) -> None:
    """Stamps of nine digits: the rate to 1e-6."""
    recording = load(headed(f"t[{unit}],gx[deg/s]", TIME / size_s, white(24))(tmp_path))
    assert recording.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)
    assert recording.lost == 0


def test_the_zoo_of_units(tmp_path: Path) -> None:
    """38 units of the shared case: read, N of the differences to 5 % (4.5 sd of 6000), the bias to 4.5 sd."""
    script = SHARED_CASES / "Q33_units.py"
    if not script.exists():
        pytest.skip(f"CASES ABSENT: {script} (see tests/README.md)")
    subprocess.run([sys.executable, script, "8"], cwd=tmp_path, check=True, timeout=120)
    found = sorted(tmp_path.glob("U*.csv"))
    assert len(found) == 38
    for path in found:
        recording = load(path)
        ((name, column),) = recording.columns.items()
        si, white_n, bias = ("deg/s", 0.04, 0.3) if name == "gx" else ("m/s^2", 0.003, 0.1)
        values = recording.in_unit(name, si)
        heading = path.read_text(encoding="utf-8").splitlines()[0]
        assert np.diff(values).std() / math.sqrt(2.0 * 10.0) == pytest.approx(white_n, rel=0.05), (heading, column.unit)
        assert abs(values.mean() - bias) < 4.5 * white_n * math.sqrt(10.0 / 6000.0), (heading, column.unit)


@pytest.mark.parametrize("seed", range(case_records(2, 40)))
def test_a_filter_is_seen_through_by_the_advice(seed: int, tmp_path: Path) -> None:
    """Q26 with other numbers: N within 4.5 sd, and 5 % for what is left of the filter."""
    window, rate_hz = ((2.5, 40.0), (6.0, 10.0), (3.0, 20.0), (9.0, 5.0))[seed % 4]
    mean = round(window * rate_hz)
    values = np.convolve(
        white(100 + seed, round(7200 * rate_hz) + mean - 1, rate_hz), np.full(mean, 1.0 / mean), "valid"
    )
    save(tmp_path / "log.npz", {"gx": ("deg/s", values)}, rate_hz)
    typed = advised(answer(tmp_path / "log.npz")[0])
    assert typed[0] == "--decimate"
    assert float(typed[1]) < 0.25
    axis: dict = answer(tmp_path / "log.npz", *typed)[1]["gx"]  # type: ignore[assignment, type-arg]
    law = max(axis["hypotheses"], key=axis["hypotheses"].get)
    found = axis["parameters"][law]["N"]
    assert abs(found["median"] - N) < 4.5 * found["sd"] + 0.05 * N
