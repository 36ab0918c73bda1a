"""No cell of a CSV that we write is a formula to a spreadsheet, whatever name or word from outside is in it.

Truth: how spreadsheets cut a text into cells, in a country that separates by commas and in one by semicolons: by
`csv.reader`, each line end of any form a row. A cell with one of the signs = + - @ at its beginning, a number apart, is
a formula. Wide forms of the signs count, and blanks before them do not.
"""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from selfcal.batch.unit_table import COLUMNS, write_csv
from selfcal.logs.recording import load
from selfcal.verbs.convert import convert

from conftest import run

#: Names that did harm in one program or another.
NAMES = (
    "-3+1+cmd|'/k dir'!B2",
    "=HYPERLINK(1)",
    "+7",
    "@SUM(1)",
    "\t=2",
    "\r=2",
    "\n-2",
    "a\r=cmd|x!C3",
    "b\r\n+cmd",
    "  =1",
    "c;=1+2",
    ";-2",
    "\uff1d1",
    "\uff0d5",
    'd";=1',
    "\u2028=1",
)


def formulas(text: str) -> list[str]:
    """The cells of a CSV that are formulas, in any of the ways to cut it."""
    cells: list[str] = []
    for separator in ",;":
        for line in re.split(r"[\r\n\u2028]", text):
            cells += [one for row in csv.reader([line], delimiter=separator) for one in row]
        cells += [one for row in csv.reader(io.StringIO(text, newline=""), delimiter=separator) for one in row]
    number = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?(,.*)?", re.DOTALL)  # with those after it where it is no separator
    return [one for one in cells if re.match(r"\s*[=+\-@\uff1d\uff0b\uff0d\uff20]", one) and not number.fullmatch(one)]


@pytest.mark.parametrize("name", NAMES)
def test_a_text_from_outside_is_a_text(name: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    for column in ("device", "recording", "station", "error"):
        write_csv(path, COLUMNS, iter([{column: name, "median": -0.25, "axis": "gx"}]))
        text = path.read_bytes().decode()
        assert formulas(text) == []
        assert len(text.splitlines()) == 2
        (row,) = csv.DictReader(io.StringIO(text, newline=""))
        assert row["median"] == "-0.25" and row[column].strip("' ;")


def test_a_batch(tmp_path: Path) -> None:
    """The command itself, over recordings of such names."""
    random = np.random.default_rng(4)
    for name in ("-2+3", "@SUM(1)", "a\r=cmd"):
        values = "".join(f"{value:.4f}\n" for value in random.normal(0.0, 0.1, 90))
        (tmp_path / f"{name}.csv").write_text("gx[deg/s]\n" + values, encoding="utf-8")
    logs = sorted(path.name for path in tmp_path.glob("*.csv"))
    done = run("fleet", "--rate", "2", "--workers", "1", "-o", "t.csv", "--", *logs, cwd=tmp_path)
    assert done.returncode in (0, 2), done.stderr
    text = (tmp_path / "t.csv").read_bytes().decode()
    assert formulas(text) == []
    names = {row["recording"] for row in csv.DictReader(io.StringIO(text, newline=""))}
    assert names == {"'-2+3.csv", "'@SUM(1).csv", r"a\r=cmd.csv"}


@pytest.mark.parametrize("name", [one for one in NAMES if one.isprintable() and "/" not in one])
def test_a_heading_of_a_converted_log(name: str, tmp_path: Path) -> None:
    """A column that is kept beside the axes has the name that a stranger gave it."""
    log, output = tmp_path / "log.h5", tmp_path / "log.csv"
    with h5py.File(log, "w") as file:
        for key, unit in (("t", "s"), ("gx", "deg/s"), (name, "V")):
            file.create_dataset(key, data=np.linspace(-1.0, 1.0, 20)).attrs["unit"] = unit
    convert(log, output)
    text = output.read_text(encoding="utf-8")
    assert formulas(text.splitlines()[0]) == [] and "[V]" in text.splitlines()[0]
    assert text.splitlines()[0].count(",") == text.splitlines()[1].count(",")
    assert load(output).columns["gx"].values == pytest.approx(np.linspace(-1.0, 1.0, 20))
