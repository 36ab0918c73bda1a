"""Readings in memory: every verb takes them as it takes a file, and its answer is readable without one.

Truth: the answer of the same readings from a file, which other tests check; pandas' own frames.

`.venv/bin/python tests/tools/test_arrays.py` writes the outputs in the notebook anew.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import pydoc
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import selfcal
from selfcal import Recording, UserError
from selfcal.base.errors import in_python
from selfcal.show.identification import show
from selfcal.show.results import Identification, Picture

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests" / room) for room in ("", "cases", "tools")]  # where this is run as a program

from test_cases_priors import at_rest  # noqa: E402
from test_docs import assert_alike  # noqa: E402

RATE_HZ = 8.0
NOTEBOOK = ROOT / "tools" / "docs" / "first_hour.ipynb"


def readings(columns: int) -> NDArray[np.float64]:
    """Ten minutes [n, columns] of walks."""
    return np.stack([at_rest(40 + k, 0.011, 7e-4, RATE_HZ, 600.0, 0.3 * k) for k in range(columns)], axis=1)


def answer(log: Any, **options: Any) -> dict[str, Any]:
    return dict(selfcal.identify(log, axes=["gy"], suspicion=False, **options)["axes"]["gy"])


def test_each_form_of_the_same_readings_is_the_file(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    y = readings(3)
    t = np.arange(len(y)) / RATE_HZ
    named = {f"g{axis}[deg/s]": column for axis, column in zip("xyz", y.T, strict=True)}
    np.savez(tmp_path / "log.npz", **{"t[s]": t, **named})  # type: ignore[arg-type]
    expected = answer(tmp_path / "log.npz")
    plain = {name[:2]: column for name, column in named.items()}
    dates = pandas.date_range("2026-03-01", periods=len(y), freq="125ms", tz="Europe/Vienna")
    recording = Recording.from_arrays(y, RATE_HZ, "deg/s", name="bench 3")
    forms: list[tuple[Any, dict[str, Any]]] = [
        (y, {"rate_hz": RATE_HZ, "units": "deg/s"}),
        (named, {"rate_hz": RATE_HZ}),
        ({"t": t, **plain}, {"units": {"t": "s", "gyro": "deg/s"}}),
        ({"gyro": y}, {"rate_hz": RATE_HZ, "units": {"gyro": "deg/s"}}),
        ({"gyro[deg/s]": y.astype(np.float64), "clock": t}, {"columns": {"t": "clock"}, "units": {"t": "s"}}),
        (pandas.DataFrame(plain, index=dates), {"units": "deg/s"}),
        (pandas.DataFrame({"t[s]": t, **named, "note": "x"}), {}),
        (recording, {}),
        (y.tolist(), {"rate_hz": "8", "units": "deg/s"}),
        (pandas.DataFrame({"time": dates, **named}), {}),
    ]
    for log, options in forms:
        assert answer(log, **options) == expected
    series = pandas.Series(plain["gy"], index=dates, name="gy[deg/s]")
    assert answer(series) == answer({"gy[deg/s]": plain["gy"]}, rate_hz=RATE_HZ)
    accel = selfcal.identify(readings(6), rate_hz=RATE_HZ, units={"gyro": "deg/s", "accel": "mg"})
    assert accel.axes["az"].bias_now.unit == "mg"
    assert selfcal.identify(recording, axes=["gx"]).recording.path == "bench 3"
    assert "bench 3: 4800 rows at 8 Hz, 600 s: gx[deg/s], gy[deg/s], gz[deg/s]" in repr(recording)


def test_other_verbs_take_them(tmp_path: Path) -> None:
    """`diagnose` writes the model of the recording, `part` and `plan` make a part, `convert` a file."""
    first, second = (
        Recording.from_arrays(at_rest(seed, 0.02, 1e-4, 4.0, 500.0), 4.0, "deg/s", name=f"day {seed}")
        for seed in (3, 4)
    )
    found = selfcal.diagnose(first, write_model=tmp_path / "own.yaml")
    assert found.axes["gx"].verdict == "adequate"
    assert selfcal.part(first, tmp_path / "part.yaml").sensor_rate_hz == 4.0
    assert selfcal.plan(first, want=["N within 20 %"], records=8)["duration_s"] > 0.0
    assert selfcal.compare([first, second]).recordings == ["day 3", "day 4"]
    selfcal.convert(first, tmp_path / "log.csv")
    assert np.array_equal(selfcal.load(tmp_path / "log.csv").columns["gx"].values, first.columns["gx"].values)


@pytest.mark.parametrize(
    ("data", "options", "said"),
    [
        (np.ones((9, 3)), {"rate_hz": 2.0}, "no unit of gx, gy, gz: give units={'gx': 'deg/s'}"),
        (np.ones((9, 3)), {"units": "deg/s"}, "no time column: give rate_hz=100.0"),
        (np.ones((9, 2)), {"rate_hz": 2.0, "units": "deg/s"}, "takes 1, 3 or 6 columns"),
        (np.ones((3, 9)), {"rate_hz": 2.0, "units": "deg/s"}, "a row a sample"),
        ({"wind": np.ones((9, 3))}, {"rate_hz": 2.0}, "takes 'gyro' or 'accel' of three columns"),
        ({"gyro": np.ones((9, 3)), "gx": np.ones(9)}, {"rate_hz": 2.0, "units": "deg/s"}, "column 'gx' appears twice"),
        ({"gx": ["a"] * 9}, {"rate_hz": 2.0, "units": "deg/s"}, "holds no numbers"),
        ({"gx": np.ones(9)}, {"rate_hz": 2.0, "units": {"gx": "furlong"}}, "the unknown unit 'furlong'"),
        ({"gx": np.ones(9)}, {"rate_hz": 2.0, "units": {"gx": "deg/s", "gy": "deg/s"}}, "no column 'gy'"),
        ({"gx": np.ones(9), "gy": np.ones(8)}, {"rate_hz": 2.0, "units": "deg/s"}, "has 8 rows, 'gx' has 9"),
        ({}, {"rate_hz": 2.0}, "there are no columns"),
        ("a.csv", {"units": "deg/s"}, "by the names of its columns"),
        ([[1.0, 2.0, 3.0], [1.0]], {"rate_hz": 2.0, "units": "deg/s"}, "rows of different lengths"),
        ([], {"rate_hz": 2.0}, "no recording in an empty list"),
        (np.ones((9, 3)), {"rate_hz": "fast", "units": "deg/s"}, "must be a number of Hz, not 'fast'"),
        ({"gx": np.ones(9)}, {"rate_hz": 2.0, "units": {"gx": "deg/s"}, "columns": {"gy": "w"}}, "columns={'gy': 'w'}"),
    ],
)
def test_what_is_no_recording_is_one_line(data: Any, options: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        selfcal.identify(data, **options)
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("words", [["rear", "front"], [3, 8, 5]])
def test_rows_of_sensors_in_turn_are_told_apart(words: list[Any]) -> None:
    """A line lists them, by the keyword to give."""
    y = readings(1)[:1200, 0]
    count = len(words)
    t = np.repeat(np.arange(1200 // count) / RATE_HZ, count)
    data = {"t[s]": t, "imu": np.array(words * (1200 // count)), "gx[deg/s]": y}
    with pytest.raises(UserError, match=f"several sensors: give sources=.'imu:{words[0]}'. ") as caught:
        selfcal.load(data)
    assert "--" not in str(caught.value)
    one = selfcal.load(data, sources=f"imu:{words[1]}")
    assert np.array_equal(one.columns["gx"].values, y[1::count])


@pytest.mark.parametrize("heading", ["temperature[degC]", "Temp (K)", "imu_temp[degC]"])
def test_a_temperature_is_known_by_its_name_and_unit(heading: str) -> None:
    recording = selfcal.load(
        {"t[s]": np.arange(90.0), "gx[deg/s]": np.arange(90.0) % 7, heading: 300.0 + np.arange(90.0)}
    )
    assert recording.columns["temp"].values[4] == 304.0


def test_what_is_no_keyword_has_one_line() -> None:
    """A word that is nearly one, and a list where a name or a mapping stands."""
    readings = np.random.default_rng(0).standard_normal((800, 3))
    with pytest.raises(UserError, match="no keyword colums: columns"):
        selfcal.identify(readings, rate_hz=25.0, colums={"gx": "x"})
    with pytest.raises(UserError, match="one text for all axes, or by name"):
        selfcal.identify(readings, rate_hz=25.0, units=["rad/s", "g"])


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("give --unit wx=rad/s --unit wy=rad/s, or", "give units={'wx': 'rad/s', 'wy': 'rad/s'}, or"),
        ("--scale 'ax=SIZE[g]', SIZE the g", "scale={'ax': (SIZE, 'g')}, SIZE the g"),
        ("--skip-bad mends it; --no-time --rate HZ", "skip_bad=True mends it; no_time=True rate_hz=HZ"),
        ("choose with --axis", "choose with axes=[...]"),
        ("no -- option --of-ours", "no -- option --of-ours"),
    ],
)
def test_options_are_keywords_in_python(typed: str, meant: str) -> None:
    assert in_python(typed) == meant


def test_missing_and_masked_samples() -> None:
    """NaN in a row is a missing sample; so is what a mask hides."""
    y = readings(1)[:, 0]
    y[[70, 71, 900]] = np.nan
    masked = np.ma.masked_invalid(y)
    for form in (y, {"gx": masked}):
        assert selfcal.load(form, rate_hz=RATE_HZ, units="deg/s").lost == 3


# ------------------------------------------------------------------------------------------------------------ answers


def test_an_answer_reads_as_the_command_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its repr, in text and for a notebook; a frame of the numbers; the picture."""
    pytest.importorskip("pandas")
    log = {"gx[deg/s]": readings(1)[:, 0], "gy[deg/s]": np.zeros(4800)}
    found = selfcal.identify(log, rate_hz=RATE_HZ, suspicion=False)
    capsys.readouterr()
    show(found)
    assert repr(found).split() == capsys.readouterr().out.split()
    html = found._repr_html_()
    assert html.startswith("<pre") and "random_walk" in html and "<script" not in html
    frame = found.to_frame()
    own = frame[(frame.axis == "gx") & (frame.law == "random_walk") & (frame.parameter == "K")].iloc[0]
    posterior = found.axes["gx"].parameters["random_walk"]["K"]
    assert (own["median"], own["unit"]) == (posterior.median, posterior.unit)
    assert own["probability"] == found.axes["gx"].hypotheses["random_walk"]
    assert frame[frame.axis == "gy"].error.item() == found["axes"]["gy"]["error"]
    picture = found.plot()
    assert picture is not None and picture._repr_png_()[:4] == b"\x89PNG"
    found.plot(tmp_path / "allan.svg")
    assert (tmp_path / "allan.svg").stat().st_size > 20_000
    with pytest.raises(UserError, match="a plot is one of"):
        found.plot(tmp_path / "allan.doc")
    assert Identification(json.loads(json.dumps(found))) == found


def test_findings_in_a_frame() -> None:
    pytest.importorskip("pandas")
    y = at_rest(9, 0.01, 0.0, 2.0, 1500.0)
    y[1700:] += 0.5
    found = selfcal.diagnose({"gx[deg/s]": y, "gy[deg/s]": at_rest(10, 0.01, 0.0, 2.0, 1500.0)}, rate_hz=2.0)
    frame = found.to_frame()
    (row,) = frame[(frame.cause == "step") & (frame.key == "amplitude")].to_dict("records")
    assert row["axis"] == "gx" and abs(row["median"] - 0.5) < 0.01 and row["unit"] == "deg/s"
    assert frame[frame.axis == "gy"].verdict.item() == "adequate"
    assert "step" in repr(found) and "gx, °/s" in repr(found)


def test_help_begins_with_lines_that_run(tmp_path: Path) -> None:
    """As printed."""
    text = pydoc.plain(pydoc.render_doc(selfcal))
    lines = [line.strip() for line in text[text.index("import numpy") :].splitlines()]
    example = "\n".join(lines[: next(k for k, line in enumerate(lines) if line.startswith("`help("))])
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "constant" in done.stdout and "gx [deg/s]: adequate" in done.stdout
    assert (tmp_path / "allan.png").stat().st_size > 20_000


def test_signatures_have_types() -> None:
    """Not the options of the command line; each keyword of a log stands there."""
    for verb in selfcal.VERBS:
        (head, *_) = pydoc.plain(pydoc.render_doc(getattr(selfcal, verb))).split("\n\n")[1].splitlines()
        assert "Annotated" not in head and "option(" not in head and "Unpack" not in head, head
    said = io.StringIO()
    pydoc.Helper(output=said).help(selfcal.identify)
    assert "rate_hz: float | None = None" in pydoc.plain(said.getvalue())


# ----------------------------------------------------------------------------------------------------------- notebook


def run_notebook(cells: list[dict[str, Any]]) -> list[str]:
    """The text of each code cell's last expression, as a kernel shows it; run in this process and folder."""
    names: dict[str, Any] = {}
    shown = []
    for cell in cells:
        tree = ast.parse("".join(cell["source"]))
        last = tree.body[-1]
        tree.body[-1:] = [] if isinstance(last, ast.Expr) else [last]
        exec(compile(tree, "cell", "exec"), names)
        value = None
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
        shown.append("" if value is None or isinstance(value, Picture) else repr(value))
    return shown


def test_the_notebook_runs_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each cell's output is the shipped one: words exactly, numbers to 2 %. The effect that was put in is found."""
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    for cell, shown in zip(cells, run_notebook(cells), strict=True):
        assert_alike("".join(line for one in cell["outputs"] for line in one["data"]["text/plain"]), shown)


if __name__ == "__main__":
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    of_code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for number, (cell, text) in enumerate(zip(of_code, run_notebook(of_code), strict=True), 1):
            output = {"execution_count": number, "metadata": {}, "output_type": "execute_result"}
            cell["execution_count"] = number
            cell["outputs"] = [output | {"data": {"text/plain": text.splitlines(keepends=True)}}] if text else []
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
