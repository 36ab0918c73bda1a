"""LabVIEW's TDMS by nptdms: a table for each group and length of its channels.

Units are those of the channels (`unit_string`). Without a channel of times a waveform's own increment is the clock.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, short
from selfcal.logs.loaders.damage import Damaged
from selfcal.logs.loaders.headings import TIMES
from selfcal.logs.loaders.table import Hints, Table, bound_numbers, heading, left_out, of_groups

#: What comes before a segment's content: its sign, kind and version, the length of what follows, and of the metadata.
_LEAD = "4sIIQQ"


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a file. Raises UserError and what nptdms raises."""
    from nptdms import TdmsFile

    damaged = _cut(path)
    tables: dict[tuple[str, int], dict[str, NDArray[Any]]] = {}
    clocks: dict[tuple[str, int], NDArray[Any]] = {}
    unscaled: dict[str, str] = {}
    numbers = 0
    with path.open("rb") as stream, TdmsFile.open(stream) as file:  # of a path it would read its _index too
        for group in file.groups():
            for channel in group.channels():
                numbers += len(channel)
                bound_numbers(path, numbers)
                if unknown := _unknown_scale(channel.properties, group.properties, file.properties):
                    unscaled[channel.name] = unknown
                    continue
                values = np.asarray(channel[:])
                unit = str(channel.properties.get("unit_string", ""))
                name = channel.name
                if values.dtype.kind == "M":
                    name, unit, values = "t", "ns", values.astype("M8[ns]").astype(np.int64)
                elif values.dtype.kind not in "iuf" or values.ndim != 1:
                    continue
                key = (group.name, values.size)
                tables.setdefault(key, {})[heading(name, "" if "[" in name else unit)] = values
                step = channel.properties.get("wf_increment")
                if isinstance(step, float) and step > 0.0:
                    begin = float(channel.properties.get("wf_start_offset", 0.0))
                    clocks[key] = begin + step * np.arange(values.size)
    notes = left_out(list(unscaled), f"a scale, '{short(next(iter(unscaled.values()), ''))}', that is not known")
    if notes and not tables:
        raise UserError(f"{path}: {notes[0]}")
    for key, columns in tables.items():
        if key in clocks and not any(name.split("[")[0].lower() in ("t", *TIMES) for name in columns):
            columns["t[s]"] = clocks[key]
    return of_groups(tables, notes=notes, damaged=damaged)


def _unknown_scale(*stated: Mapping[str, Any]) -> str:
    """The type of the scale of raw readings that nptdms leaves out, as it does not know it; or nothing. `stated`:
    properties, of which the first with a scale count."""
    from nptdms.scaling import get_scaling

    for properties in stated:
        types = [str(value) for name, value in properties.items() if name.endswith("_Scale_Type")]
        if types and properties.get("NI_Scaling_Status") != "scaled":
            return ", ".join(types) if get_scaling(properties, {}, {}) is None else ""
    return ""


def _cut(path: Path) -> Damaged:
    """What the last segment states that is not there: nptdms reads what there is. Source: NI's description of TDMS."""
    begin, size, lead = 0, path.stat().st_size, struct.calcsize(f"={_LEAD}")
    with path.open("rb") as stream:
        while begin < size:
            stream.seek(begin)
            head = stream.read(lead)
            if len(head) < lead or head[:4] != b"TDSm":
                return Damaged(size - begin, 1)
            length = struct.unpack(f"{'>' if head[4] & 0x40 else '<'}{_LEAD}", head)[3]
            if length == np.iinfo(np.uint64).max:  # the writer did not come to its end
                return Damaged()
            begin += lead + length
    return Damaged(begin - size, 1, begin) if begin > size else Damaged()
