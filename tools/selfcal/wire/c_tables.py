"""The C tables of a model, const, for the flash of the firmware."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from selfcal import _library32
from selfcal.base.code_template import of_code
from selfcal.base.errors import UserError, remark
from selfcal.base.output import whole
from selfcal.base.units import factor
from selfcal.logs.recording import SIDE_CHANNELS
from selfcal.model.file import NODES, NOT_HANDLED, Model
from selfcal.model.forms import COLUMN_KINDS, HOST_FORMS
from selfcal.model.laws import KIND_CODES, MOST_TERMS
from selfcal.model.tables import AxisTable, PriorRow, Tables, gate_table
from selfcal.wire.frames import AXES, carries

#: Sizes by core: fineness of report integrals; lines of a spectrum (a Cortex-M0 has RAM for 20, enough for 5000 bank
#: samples); pushes between two steps of the nodes (a batch takes 4 sample periods at 819.2 Hz and 48 MHz there).
CORES = {
    "host": {"REPORT_QUALITY": 2, "LINES": 36, "PUSH_EVERY": 1},
    "cortex-m4f": {"REPORT_QUALITY": 1, "LINES": 32, "PUSH_EVERY": 1},
    "cortex-m0": {"REPORT_QUALITY": 1, "LINES": 20, "PUSH_EVERY": 16},
}


#: Cores whose samples are processed in integers.
WITHOUT_FPU = ("cortex-m0",)


#: RAM for a model's nodes, bytes: 32 KB less 11 to 12 KB of the image.
ROOM = {"cortex-m0": 21_000}


def check_room(model: Model, tables: Tables, target: str, hold: bool = False) -> None:
    """Raise UserError for tables that the target has no RAM for. `hold`: with a copy of an axis for its report."""
    core, needed = core_of(target), bank_bytes(tables) + (bank_bytes(tables, 1) if hold else 0)
    if needed > ROOM.get(core, needed):
        counts = {"axes": len(tables.axes), "regressors": len(tables.regressors), "nodes": tables.nodes}
        said = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        small = "" if target == f"{core}-small" else f", or --target {core}-small"
        raise UserError(
            f"{model.path}: {said} take {needed / 1000:.1f} KB of RAM, of which the {core} has {ROOM[core] / 1000:.0f} "
            f"KB for them: leave out axes, regressors or nodes{small}"
        )


def bank_bytes(tables: Tables, axes: int = 0) -> int:
    """SELFCAL_MODEL_BYTES of the integer build for a core of 32 bits but for alignment (lib/selfcal_layout.h). `axes`:
    of this many in place of all."""
    axes, p = axes or len(tables.axes), len(tables.regressors)
    regressors = 4 * (p + 1) * (p + 4) + axes * (8 * p + 24) if p else 0
    return tables.nodes * (56 + 20 * axes + regressors) + tables.term_nodes * (104 + 24 * p + 40 * axes)


def unused(model: Model, tables: Tables, target: str) -> Iterator[str]:
    """Parts of the model that have no effect."""
    yield from model.left_out
    measured = {name for name, axis in model.simulate.get("axes", {}).items() if "hypothesis" in axis}
    if measured and (others := [axis.name for axis in tables.axes if axis.name not in measured]):
        yield f"{model.path}: wide priors, without a result in the file: {', '.join(others)}"
    if model.gate is not None and gate_table(model, tables) is None:
        yield f"{model.path}: `gate` is left out: a bank interval is one sample, and it wants two or more"
    if tables.handling.outlier_sd and tables.block == 1:
        yield f"{model.path}: `handle.outlier_sd` does nothing: a bank interval is one sample, and it wants two or more"
    if core_of(target) in WITHOUT_FPU and (tables.handling.steps or tables.handling.variance_changes):
        yield f"{model.path}: the images of {core_of(target)} find no steps and no variance changes: no room for it"


def assumption(tables: Tables) -> str:
    """The rate and the interval that the tables assume of their samples."""
    samples = "1 sample" if tables.block == 1 else f"{tables.block} samples"
    make = "makes" if tables.block == 1 else "make"
    return f"{samples} at {tables.rate_hz:.7g} Hz {make} a bank sample of {tables.dt_s:.7g} s"


def write_tables(model: Model, tables: Tables, folder: Path, target: str, start: str = "", hold: bool = False) -> None:
    """Write the files into `folder`, the sizes as for a core.

    `start`: where measured priors come from. `hold`: a report rests on a copy of its axis's sums. Raises UserError if
    it cannot be written, or if a regressor has a form that the library does not make."""
    check_forms(model)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot write the tables: {error.strerror}") from error
    templates = of_code(Path(__file__).parent / "templates")
    templates.filters |= {"remark": remark, "flag": lambda flag: str(flag).lower()}
    templates.filters["grid"] = lambda grid: f"&grid_{grid.nodes}" if grid else "NULL"
    for name in ("selfcal_config.h", "selfcal_model.h", "selfcal_model.c"):
        text = templates.get_template(f"{name}.jinja").render(_values(model, tables, target, start, hold))
        with whole(folder / name) as file:
            file.write_text(text, encoding="utf-8")


def check_forms(model: Model) -> None:
    """Raises UserError for a regressor of a form that no module makes."""
    for regressor in model.regressors:
        if not regressor.on_module:
            what = f"form: {regressor.form}" if regressor.form in HOST_FORMS else f"input: {regressor.input}"
            raise UserError(
                f"{model.path}: regressor '{regressor.name}': no module makes `{what}`: leave the regressor out, or "
                "take `identify`, which does"
            )


def sizes(tables: Tables, target: str) -> dict[str, int]:
    """The library's sizes for these tables on a core, by their macros without SELFCAL_ (lib/selfcal.h)."""
    grids = [grid.nodes for h in tables.hypotheses for grid in (h.rho, h.alpha) if grid]
    grid = max(grids, default=NODES[0])
    nodes = max(grid, *(h.nodes for h in tables.hypotheses))
    return {
        "AXES_MAX": len(tables.axes),
        "HYPOTHESES_MAX": len(tables.hypotheses),
        "GRID_MAX": grid,
        "ALPHA_MAX": max((h.alpha.nodes for h in tables.hypotheses if h.alpha), default=NODES[0]),
        "HYPOTHESIS_NODES_MAX": nodes,
        "NODES_MAX": max(nodes, tables.nodes),
        "REGRESSORS_MAX": max(1, len(tables.regressors)),
        "TERMS_MAX": MOST_TERMS if tables.term_nodes else 1,
        "BATCH": _library32.BATCH,
        "PUSH_NODES": 1,
        "RETIRE_BLOCKS": 60,
        **CORES[core_of(target)],
    }


def core_of(target: str) -> str:
    """The core that a target of the model file is of: its name is the core's, or begins with it, as cortex-m0-small."""
    return next((core for core in CORES if target == core or target.startswith(f"{core}-")), "host")


def _values(model: Model, tables: Tables, target: str, start: str, hold: bool) -> dict[str, Any]:
    """Values of the templates."""
    return {
        "model": model,
        "tables": tables,
        "target": target,
        "start": start,
        "hold": hold,
        "sizes": sizes(tables, target),
        "fixed": core_of(target) in WITHOUT_FPU,
        "model_id": f"{tables.id:08X}",
        "channels_read": set(tables.channels) <= set(SIDE_CHANNELS.values()),
        "supply_read": SIDE_CHANNELS["supply"] in tables.channels,
        "exponents": [coarsest_exponent(axis, tables.dt_s) for axis in tables.axes],
        "rate_millihz": round(1000.0 * tables.rate_hz),
        "sent": all(carries(axis.name, axis.unit) for axis in tables.axes),
        "gate": gate_table(model, tables),
        "tumbling": _tumbling(model, tables),
        "grids": {grid.nodes: grid for h in tables.hypotheses for grid in (h.rho, h.alpha) if grid},
        "handled": tables.handling != NOT_HANDLED,
        "means": any(column.coefficient_mean for column in tables.regressors),
        "limits": _limits,
        "KINDS": KIND_CODES,
        "COLUMN_KINDS": COLUMN_KINDS,
    }


def _tumbling(model: Model, tables: Tables) -> dict[str, Any] | None:
    """For lib/tumble.h: places of ax ay az gx gy gz, their units in m/s^2 and rad/s, N and K of each in these: the
    medians of the model's priors. None without all six axes and a gate."""
    places = {axis.name: place for place, axis in enumerate(tables.axes)}
    order = (*AXES[3:], *AXES[:3])
    if not set(order) <= set(places) or gate_table(model, tables) is None:
        return None
    groups = [model.group_of(axis) for axis in order]
    units = [factor(group.unit, unit) for group, unit in zip(groups, ("m/s^2",) * 3 + ("rad/s",) * 3, strict=True)]
    if len({*units[:3]}) > 1 or len({*units[3:]}) > 1:
        return None
    noise = [
        [size * group.priors[name].median if name in group.priors else 0.0 for name in ("N", "K")]
        for group, size in zip(groups, units, strict=True)
    ]
    return {"axes": [places[a] for a in order], "noise": noise, "accel_unit": units[0], "gyro_unit": units[3]}


def _limits(axis: AxisTable) -> list[PriorRow]:
    return [(low, high, law, False) for low, high, law in zip(axis.ln_min, axis.ln_max, axis.law, strict=True)]


def coarsest_exponent(axis: AxisTable, dt_s: float) -> int:
    """Bound of `selfcal_scale_t.exponent`: lib/bank_kernel_fixed.c sets it by the first batch's noise, then by |y|.

    Bank samples less the first reach 2 range; so do differences, which pass for noise of 2 range / sqrt(2) within the
    prior's limits.
    """
    span = 2.0 * min(axis.range or math.inf, _library32.SAMPLE_MAX)
    least, most = (math.exp(limits[0]) / math.sqrt(dt_s) for limits in (axis.ln_min, axis.ln_max))
    sigma = max(least, min(most, span / math.sqrt(2.0)))
    # SELFCAL_FIXED_LIMIT in selfcal_parts.h, and SIGMA_BITS in bank_kernel_fixed.c.
    return max(math.ceil(math.log2(span / (3 * 2**25))), math.floor(math.log2(sigma) + 1e-5) - 20)
