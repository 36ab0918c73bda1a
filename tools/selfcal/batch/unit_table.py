"""The table of a batch: a row for each parameter of the most probable law and each coefficient, as CSV or Parquet."""

from __future__ import annotations

import csv
import importlib.util
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from selfcal.bank.axis_result import bias_of, likeliest
from selfcal.base.errors import UserError, cell, install_line
from selfcal.base.output import whole
from selfcal.batch.batch_files import BatchSource, moment, stem

COLUMNS = (
    *("device", "recording", "recorded_at", "station", "lot", "sha256", "version", "axis", "parameter"),
    *("median", "q05", "q95", "parameter_unit", "law", "probability", "adequate", "causes", "material", "error"),
)
_NUMBERS = ("median", "q05", "q95", "probability")
SUFFIXES = (".csv", ".parquet")


class BatchUnit:
    """A recording of the batch with its answer: `record` (batch/unit_record.py), or `error`."""

    def __init__(self, source: BatchSource, record: Mapping[str, Any]) -> None:
        recording = record.get("recording", {})
        self.source, self.record = source, record
        self.device: str = source.device or recording.get("serial", "") or stem(source.path)
        dated: str = source.recorded_at or recording.get("recorded_at", "")
        self.moment = moment(dated)
        #: Invalid date of its metadata.
        self.undated = dated if self.moment is None else ""
        self.recorded_at = dated if self.moment is not None else ""
        self.error: str | None = record.get("error")
        self.axes: Mapping[str, Any] = record.get("axes", {})

    @property
    def place(self) -> tuple[str, float, str]:
        """Its place in the table."""
        return self.device, -math.inf if self.moment is None else self.moment.timestamp(), self.source.path

    @property
    def errors(self) -> dict[str, str]:
        """Why it has no result, by axis; "" stands for the whole recording."""
        if self.error is not None:
            return {"": self.error}
        return {name: axis["error"] for name, axis in self.axes.items() if "error" in axis}

    def causes(self, axis: str, key: str = "causes") -> list[str]:
        """The causes that `diagnose` finds on an axis; of the key `material` those that change a number."""
        causes: list[str] = self.record.get("diagnosis", {}).get(axis, {}).get(key, [])
        return causes

    def small(self, axis: str) -> set[str]:
        """Causes that change no number by as much as matters."""
        return set(self.causes(axis)) - {"unexplained", *self.causes(axis, "material")}


def unit_rows(unit: BatchUnit, version: str) -> Iterator[dict[str, Any]]:
    """The rows of a recording. A recording, or an axis, without a result is a row with its `error`."""
    source = unit.source
    head = dict(zip(COLUMNS, (unit.device, source.path, unit.recorded_at, source.station, source.lot), strict=False))
    head |= {"sha256": source.sha256, "version": version}
    if unit.error is not None:
        yield head | {"error": unit.error}
    for name, axis in unit.axes.items():
        if "error" in axis:
            yield head | {"axis": name, "error": axis["error"]}
            continue
        law = likeliest(axis["hypotheses"])
        extra = {"law": law, "probability": axis["hypotheses"][law], "adequate": axis["adequate"]}
        extra |= {key: ";".join(unit.causes(name, key)) for key in ("causes", "material")}
        unjudged = unit.record.get("diagnosis", {}).get(name, {}).get("error")
        extra |= {} if unjudged is None else {"error": f"not diagnosed: {unjudged}"}
        coefficients = {
            column: coefficient
            for of in axis.get("regressors", {}).values()
            for column, coefficient in of["coefficients"].items()
        }
        for parameter, estimate in {**axis["parameters"][law], **coefficients, "bias": bias_of(axis)}.items():
            numbers = {key: estimate[key] for key in ("median", "q05", "q95")}
            yield {**head, "axis": name, "parameter": parameter, **numbers, "parameter_unit": estimate["unit"], **extra}


def check_table(path: Path | str) -> None:
    """Raise UserError for a table that cannot be written by its name's ending."""
    if Path(path).suffix not in SUFFIXES:
        raise UserError(f"{path}: the table's name ends in {' or '.join(SUFFIXES)}")
    if Path(path).suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise UserError(f"{path}: Parquet needs pyarrow: {install_line('pyarrow')}, or write a .csv")


def write_table(path: Path | str, rows: Iterator[dict[str, Any]]) -> None:
    """Write the rows as the ending says."""
    if Path(path).suffix == ".csv":
        write_csv(path, COLUMNS, rows)
        return
    import pyarrow
    from pyarrow import parquet

    types = {name: pyarrow.float64() for name in _NUMBERS} | {"adequate": pyarrow.bool_()}
    kept = list(rows)
    columns = {
        name: pyarrow.array([_sound(row.get(name)) for row in kept], types.get(name, pyarrow.string()))
        for name in COLUMNS
    }
    with whole(path) as temporary:
        parquet.write_table(pyarrow.table(columns), temporary)


def write_csv(path: Path | str, columns: Sequence[str], rows: Iterator[dict[str, Any]]) -> None:
    """Write rows with these columns; a value that is absent or None is an empty cell."""
    with (
        whole(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as stream,
    ):
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            writer.writerow([_cell(row.get(name)) for name in columns])


def _sound(value: Any) -> Any:
    """A text without the lone surrogates of a file's name."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.9g}"
    return cell(value) if isinstance(value, str) else str(value)
