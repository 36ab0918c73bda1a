"""HDF5, and MATLAB's format 7.3, by h5py: a table for each group and length of its datasets.

A column has the dataset's attribute `unit` or `units`. Columns of a matrix NAME are NAME:1, NAME:2, ...; fields of a
compound dataset are columns. A text `meta` is JSON, as in an npz.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, short
from selfcal.base.limits import MOST_META_BYTES
from selfcal.logs.loaders.table import Hints, Table, check_numbers, of_groups, parse_meta

_UNITS = ("unit", "units", "Unit", "Units")


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a file. Raises UserError and what h5py raises."""
    import h5py

    tables: dict[tuple[str, int], dict[str, NDArray[Any]]] = {}
    meta = ""
    with h5py.File(path, "r") as file:
        datasets: list[tuple[str, Any]] = []
        file.visititems(lambda name, item: datasets.append((name, item)) if isinstance(item, h5py.Dataset) else None)
        numbers = 0
        for name, dataset in datasets:
            if dataset.external or dataset.is_virtual:
                raise UserError(f"{path}: dataset '{short(name)}' lies in other files: write it into this one")
            if name == "meta" and dataset.nbytes <= MOST_META_BYTES:
                meta = _text(dataset)
                continue
            if name.startswith("#refs#") or dataset.ndim not in (1, 2) or dataset.dtype.kind not in "iufV":
                continue
            numbers += dataset.size
            check_numbers(path, numbers)
            group, _slash, label = name.rpartition("/")
            for heading, column in _columns(label, dataset):
                tables.setdefault((group, column.size), {})[heading] = column
    whole = {key: columns for key, columns in tables.items() if key[1] > 1}
    return of_groups(whole, parse_meta(path, meta) if meta else {})


def _text(dataset: Any) -> str:
    """A text: of HDF5's own type, or MATLAB's, an array of characters."""
    value = dataset[()]
    if isinstance(value, np.ndarray) and value.dtype.kind in "iu":
        return "".join(map(chr, value.ravel().tolist()))
    first = value.ravel()[0] if isinstance(value, np.ndarray) else value
    return first.decode() if isinstance(first, bytes) else str(first)


def _columns(label: str, dataset: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Headings and columns of a dataset."""
    stated = next((dataset.attrs[key] for key in _UNITS if key in dataset.attrs), None)
    stated = stated.decode() if isinstance(stated, bytes) else stated
    unit = f"[{stated}]" if isinstance(stated, str) else ""
    values = dataset[()]
    if values.dtype.names is not None:
        for name in values.dtype.names:
            if values.dtype[name].kind in "iuf" and values[name].ndim == 1:
                yield name, values[name]
        return
    if values.ndim == 1 or 1 in values.shape:
        yield f"{label}{unit}", values.ravel()
        return
    across = values if values.shape[0] < values.shape[1] else values.T  # MATLAB's matrices lie transposed
    for column in range(min(across.shape[0], 64)):
        yield f"{label}:{column + 1}{unit}", across[column]
