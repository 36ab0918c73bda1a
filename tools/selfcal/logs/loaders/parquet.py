"""Parquet by pyarrow: a table. A field's metadata `unit` or `units` is the column's unit; dates are stamps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base.errors import UserError
from selfcal.base.limits import MOST_COLUMNS
from selfcal.logs.loaders.table import Hints, Table, check_numbers, heading, of_arrays


def read(path: Path, _: Hints) -> list[Table]:
    """The table of a file. Raises UserError and what pyarrow raises."""
    from pyarrow import parquet, types

    with path.open("rb") as stream:  # a name may be a URI
        file = parquet.ParquetFile(stream, page_checksum_verification=True)
        schema = file.schema_arrow
        names = [
            field.name
            for field in schema
            if types.is_integer(field.type) or types.is_floating(field.type) or types.is_timestamp(field.type)
        ]
        if len(names) > MOST_COLUMNS:
            raise UserError(f"{path}: more than {MOST_COLUMNS} columns")
        check_numbers(path, file.metadata.num_rows * len(names))
        read_in = file.read(columns=names, use_threads=False)
    columns: dict[str, Any] = {}
    for name in names:
        field = schema.field(name)
        values = read_in.column(name).to_numpy()
        unit = next((text.decode() for key, text in (field.metadata or {}).items() if key in (b"unit", b"units")), "")
        if values.dtype.kind == "M":
            unit = np.datetime_data(values.dtype)[0]
            columns[f"{name if 't' in names else 't'}[{unit}]"] = values.astype(np.int64)
        else:
            columns[heading(name, "" if "[" in name else unit)] = values
    return [of_arrays("", columns)]
