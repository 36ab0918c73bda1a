"""Recordings as files that `load` reads back."""

from __future__ import annotations

import gzip
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, cell
from selfcal.base.output import together, whole
from selfcal.logs.loaders import WRITTEN
from selfcal.logs.loaders.table import meta_place

#: Lines that are written at once; signs that separate columns, and so are none of a heading.
_LINES, _SIGNS = 10_000, re.compile(r'[,;\t"]')


def save(
    path: Path | str,
    columns: Mapping[str, tuple[str, NDArray[np.float64]]],
    rate_hz: float,
    meta: Mapping[str, Any] | None = None,
    t: NDArray[np.float64] | None = None,
    lsb: Mapping[str, float] | None = None,
    *,
    exact: bool = False,
) -> None:
    """Write a recording that `load` reads back; the suffix (.csv, .csv.gz, .npz) chooses the form.

    `columns`: name -> (unit, float[n]); a unit "" is none. `t` float[n], s: time stamps; None is an even grid from 0.
    `meta`: JSON values, kept in the npz or beside the CSV file as LOG.meta.json. `lsb`: name -> size of one LSB in the
    column's unit: npz stores such a column as whole numbers of it. CSV values carry 9 digits, with `exact` as many as a
    float64 takes; an empty cell is NaN then. Raises UserError for an unwritable file.
    """
    path = Path(path)
    described: dict[str, Any] = {**(meta or {}), "rate_hz": float(rate_hz)}
    if path.suffix.lower() == ".npz":
        _save_npz(path, columns, described, t, lsb or {})
        return
    if not path.name.lower().endswith((".csv", ".csv.gz")):
        raise UserError(f"{path}: a written recording's name ends in {WRITTEN}")
    n = len(next(iter(columns.values()))[1])
    stamps = np.arange(n) / rate_hz if t is None else t
    values = np.column_stack([stamps, *(values for _, values in columns.values())])
    names = ",".join(["t[s]", *(_SIGNS.sub("_", cell(_heading(name, unit))) for name, (unit, _) in columns.items())])
    with together(path, meta_place(path)) as (table, beside):
        if exact:
            _save_exact(table, names, values)
        else:
            np.savetxt(table, values, fmt=["%.12g"] + ["%.9g"] * len(columns), delimiter=",", header=names, comments="")
        if meta is None:
            beside.unlink()
        else:
            beside.write_text(json.dumps({**described, "rows": len(values)}, indent=1) + "\n", encoding="utf-8")


def _heading(name: str, unit: str) -> str:
    return f"{name}[{unit}]" if unit else name


def _save_exact(place: Path, header: str, values: NDArray[np.float64]) -> None:
    """Write values [rows, columns] as CSV by their shortest texts that are read back to the bit."""
    opened = gzip.open if place.suffix == ".gz" else open
    with opened(place, "wt", encoding="utf-8") as file:
        file.write(f"{header}\n")
        for begin in range(0, len(values), _LINES):
            lines = values[begin : begin + _LINES].tolist()
            file.writelines(
                ",".join("" if math.isnan(cell) else repr(cell).removesuffix(".0") for cell in line) + "\n"
                for line in lines
            )


def _save_npz(
    path: Path,
    columns: Mapping[str, tuple[str, NDArray[np.float64]]],
    described: dict[str, Any],
    t: NDArray[np.float64] | None,
    lsb: Mapping[str, float],
) -> None:
    """Write the columns, whole numbers of an LSB where `lsb` has its size, and `described` as the member `meta`."""
    arrays: dict[str, NDArray[Any]] = {} if t is None else {"t[s]": np.asarray(t, np.float64)}
    described["columns"] = {}
    for name, (unit, values) in columns.items():
        if name in lsb:
            counts = np.rint(np.asarray(values, np.float64) / lsb[name])
            arrays[name] = counts.astype(np.int16 if np.abs(counts).max(initial=0) <= 32767 else np.int32)
            described["columns"][name] = {"unit": unit, "lsb": float(lsb[name])}
        else:
            arrays[_heading(name, unit)] = np.asarray(values, np.float64)
    with whole(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(json.dumps(described)), **arrays)
