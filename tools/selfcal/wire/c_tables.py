"""The C tables of a model, const, for the flash of the firmware."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from selfcal.base.errors import UserError, remark
from selfcal.base.output import whole
from selfcal.logs.recording import SIDE_CHANNELS
from selfcal.model.file import NOT_HANDLED, Model
from selfcal.model.forms import COLUMN_KINDS
from selfcal.model.laws import KINDS
from selfcal.model.tables import (
    AxisTable,
    Grid,
    HypothesisTable,
    PriorRow,
    RegressorTable,
    Tables,
    gate_table,
)
from selfcal.wire.frames import carries

#: SELFCAL_SAMPLE_MAX and SELFCAL_FIXED_LIMIT in selfcal_parts.h, SIGMA_BITS in bank_kernel_fixed.c.
SAMPLE_MAX, FIXED_LIMIT, FIXED_SIGMA_BITS = 2.0**40, 3 * 2**25, 20


#: Nodes of a grid at least, of a model that has none.
LEAST_GRID = 6


#: By core: how finely a report integrates, and the lines it describes a spectrum by (on a Cortex-M0 as many as its RAM
#: has room for: they do for 5000 bank samples); pushes between two steps of the nodes, of which a batch takes 4 sample
#: periods at 819.2 Hz and 48 MHz there.
CORES = {
    "host": {"REPORT_QUALITY": 2, "LINES": 36, "PUSH_EVERY": 1},
    "cortex-m4f": {"REPORT_QUALITY": 1, "LINES": 32, "PUSH_EVERY": 1},
    "cortex-m0": {"REPORT_QUALITY": 1, "LINES": 20, "PUSH_EVERY": 16},
}


#: Cores whose samples are processed in integers.
WITHOUT_FPU = ("cortex-m0",)


#: Bytes of the part's RAM that its image leaves for a model's nodes: 32 KB less 11 to 12 KB of the rest.
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
    of so many in place of all."""
    axes, p = axes or len(tables.axes), len(tables.regressors)
    regressors = 4 * (p + 1) * (p + 4) + axes * (8 * p + 24) if p else 0
    return tables.nodes * (56 + 20 * axes + regressors) + tables.term_nodes * (104 + 24 * p + 40 * axes)


def left_out(model: Model, tables: Tables, target: str) -> Iterator[str]:
    """What of the model comes to nothing."""
    if model.left_out:
        yield model.left_out
    if model.hidden_input is not None:
        yield f"{model.path}: `hidden_input` is left out: a bank is of one axis, whose law has the whole drift"
    measured = {name for name, one in model.simulate.get("axes", {}).items() if "hypothesis" in one}
    if measured and (others := [one.name for one in tables.axes if one.name not in measured]):
        yield f"{model.path}: wide priors, without a result in the file: {', '.join(others)}"
    if model.gate is not None and gate_table(model, tables) is None:
        yield f"{model.path}: `gate` is left out: a bank interval is one sample, and it wants two or more"
    if tables.handling.outlier_sd and tables.block == 1:
        yield f"{model.path}: `handle.outlier_sd` does nothing: a bank interval is one sample, and it wants two or more"
    if core_of(target) in WITHOUT_FPU and (tables.handling.steps or tables.handling.variance_changes):
        yield f"{model.path}: the images of {core_of(target)} find no steps and no variance changes: no room for it"


def assumption(tables: Tables) -> str:
    """What the tables take for granted of the samples that they are fed with."""
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
    for name, text in (
        ("selfcal_config.h", _config(model, tables, target)),
        ("selfcal_model.h", _header(model, tables, start, hold)),
        ("selfcal_model.c", _source(model, tables)),
    ):
        with whole(folder / name) as file:
            file.write_text(text, encoding="utf-8")


def check_forms(model: Model) -> None:
    """Raises UserError for a regressor of a form that no module makes."""
    for one in model.regressors:
        if not one.on_module:
            what = f"form: {one.form}" if one.form == "play" else f"input: {one.input}"
            raise UserError(
                f"{model.path}: regressor '{one.name}': no module makes `{what}`: leave the regressor out, or take "
                "`identify`, which does"
            )


def sizes(tables: Tables, target: str) -> dict[str, int]:
    """The library's sizes for these tables on a core, by their macros without SELFCAL_ (lib/selfcal.h)."""
    grids = [grid.nodes for h in tables.hypotheses for grid in (h.rho, h.alpha) if grid]
    grid = max(grids, default=LEAST_GRID)
    one = max(grid, *(h.nodes for h in tables.hypotheses))
    return {
        "AXES_MAX": len(tables.axes),
        "HYPOTHESES_MAX": len(tables.hypotheses),
        "GRID_MAX": grid,
        "ALPHA_MAX": max((h.alpha.nodes for h in tables.hypotheses if h.alpha), default=LEAST_GRID),
        "HYPOTHESIS_NODES_MAX": one,
        "NODES_MAX": max(one, tables.nodes),
        "REGRESSORS_MAX": max(1, len(tables.regressors)),
        "TERMS_MAX": 3 if tables.term_nodes else 1,
        "BATCH": 16,
        "PUSH_NODES": 1,
        "RETIRE_BLOCKS": 60,
        **CORES[core_of(target)],
    }


def core_of(target: str) -> str:
    """The core that a target of the model file is of: its name is the core's, or begins with it, as cortex-m0-small."""
    return next((core for core in CORES if target == core or target.startswith(f"{core}-")), "host")


def _config(model: Model, tables: Tables, target: str) -> str:
    defined = [f"{name} {size}" for name, size in sizes(tables, target).items()]
    defined += ["FIXED"] if core_of(target) in WITHOUT_FPU else []
    macros = "".join(f"#ifndef SELFCAL_{one.split()[0]}\n#define SELFCAL_{one}\n#endif\n" for one in defined)
    return f"""/* Made by `selfcal codegen` from the model '{remark(model.name)}' for {target}. Do not edit.
 * The compiler's command line may set any of these. lib/selfcal_tables.h explains each. */
#ifndef SELFCAL_CONFIG_H
#define SELFCAL_CONFIG_H

{macros}
#endif
"""


def _header(model: Model, tables: Tables, start: str, hold: bool) -> str:
    axes, hypotheses = len(tables.axes), len(tables.hypotheses)
    measured = f"\n * Priors of {remark(start)}, as `selfcal diagnose` measured them." if start else ""
    return f"""/* Made by `selfcal codegen` from the model '{remark(model.name)}'. Do not edit.{measured} */
#ifndef SELFCAL_MODEL_H
#define SELFCAL_MODEL_H

#include "selfcal.h"

#define SELFCAL_MODEL_ID 0x{tables.id:08X}UL
#define SELFCAL_MODEL_NODES {tables.nodes}U
#define SELFCAL_MODEL_AXES {axes}U
#define SELFCAL_MODEL_HYPOTHESES {hypotheses}U
#define SELFCAL_MODEL_REGRESSORS {len(tables.regressors)}U
/* 1: it handles steps of the bias, or changes of the noise (lib/changes.c). */
#define SELFCAL_MODEL_CHANGES {int(tables.handling.steps or tables.handling.variance_changes)}
/* Channels that the regressors take beside the readings: selfcal_model_channel_name, in these units{_units(tables)}. */
#define SELFCAL_MODEL_CHANNELS {len(tables.channels)}U
/* 1: each is one of port/sensors/sensor.h, in its unit; one is the supply. */
#define SELFCAL_MODEL_CHANNELS_READ {int(set(tables.channels) <= set(SIDE_CHANNELS.values()))}
#define SELFCAL_MODEL_SUPPLY_READ {int(SIDE_CHANNELS["supply"] in tables.channels)}
/* With SELFCAL_FIXED no record overflows (lib/bank_kernel_fixed.c). The coarsest step of each axis that readings within
 * its range can lead to, 2^exponent of the unit. Rounding moves a likelihood by 3e-3 nats at 10^5 bank samples where
 * sigma_v is 2^17 of these; by a tenth of that at rest, where a step is 2^-20 sigma_v. */
#define SELFCAL_MODEL_EXPONENTS {{{", ".join(str(coarsest_exponent(axis, tables.dt_s)) for axis in tables.axes)}}}
#define SELFCAL_MODEL_TERM_NODES {tables.term_nodes}U
/* What selfcal_init() wants. */
#define SELFCAL_MODEL_BYTES \
    (SELFCAL_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES) + \
     SELFCAL_REGRESSORS_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_REGRESSORS) + \
     SELFCAL_TERMS_SIZE(SELFCAL_MODEL_TERM_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_REGRESSORS))
/* 1: the model is judged (lib/adequacy.c), and steps and changes of the noise are found where it handles them. */
#ifndef SELFCAL_MODEL_JUDGED
#define SELFCAL_MODEL_JUDGED 1
#endif
/* 1: a report rests on a copy of its axis's sums, so that no sample overtakes it (lib/imu_hold.c). */
#define SELFCAL_MODEL_HELD {int(hold)}
#define SELFCAL_MODEL_HELD_BYTES \
    (SELFCAL_MODEL_HELD \
         ? SELFCAL_HELD_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_TERM_NODES, SELFCAL_MODEL_REGRESSORS) \
         : 0U)
/* Calls of selfcal_imu_work() in a bank interval that keep every report ahead of the samples; held, any number does. A
 * program that makes so many with every sample says #if !SELFCAL_MODEL_KEEPS_UP(calls), and #error. */
#define SELFCAL_MODEL_REPORT_STEPS \
    (SELFCAL_MODEL_HELD \
         ? 1U \
         : SELFCAL_REPORT_CALLS(SELFCAL_MODEL_NODES, SELFCAL_MODEL_HYPOTHESES, SELFCAL_MODEL_REGRESSORS))
#define SELFCAL_MODEL_KEEPS_UP(calls_a_sample) ((calls_a_sample) * {tables.block}U >= SELFCAL_MODEL_REPORT_STEPS)
/* What selfcal_imu_init() wants. */
#define SELFCAL_MODEL_IMU_BYTES \
    (SELFCAL_MODEL_BYTES + SELFCAL_MODEL_HELD_BYTES + \
     SELFCAL_PARTS_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_GATE, SELFCAL_MODEL_REGRESSORS, \
                        SELFCAL_MODEL_JUDGED, SELFCAL_MODEL_JUDGED && SELFCAL_MODEL_CHANGES))
/* Rate of the samples, Hz. */
#define SELFCAL_MODEL_RATE_HZ {_f(tables.rate_hz)}
/* The same in 1/1000 Hz, for the preprocessor: a program whose samples come at another rate must not compile. */
#define SELFCAL_MODEL_RATE_MILLIHZ {round(1000.0 * tables.rate_hz)}UL
/* 1: every axis is one of lib/selfcal.dbc, in the unit that it has there. The library alone takes any. */
#define SELFCAL_MODEL_UNITS_SENT {int(all(carries(axis.name, axis.unit) for axis in tables.axes))}
/* 1: selfcal_model_gate is there. */
#define SELFCAL_MODEL_GATE {int(gate_table(model, tables) is not None)}

extern const selfcal_model_t selfcal_model;
extern const selfcal_pipe_t selfcal_model_pipe;
extern const char *const selfcal_model_axis_name[SELFCAL_MODEL_AXES];
#if SELFCAL_MODEL_CHANNELS > 0
extern const char *const selfcal_model_channel_name[SELFCAL_MODEL_CHANNELS];
#endif
#if SELFCAL_MODEL_GATE
extern const selfcal_gate_config_t selfcal_model_gate;
#endif

#endif
"""


def coarsest_exponent(axis: AxisTable, dt_s: float) -> int:
    """Bound of `selfcal_scale_t.exponent`: lib/bank_kernel_fixed.c sets it by the first batch's noise, then by |y|.

    Bank samples less the first reach 2 range; so do differences, which pass for noise of 2 range / sqrt(2) within the
    prior's limits.
    """
    span = 2.0 * min(axis.range or SAMPLE_MAX, SAMPLE_MAX)
    least, most = (math.exp(limits[0]) / math.sqrt(dt_s) for limits in (axis.ln_min, axis.ln_max))
    sigma = max(least, min(most, span / math.sqrt(2.0)))
    return max(math.ceil(math.log2(span / FIXED_LIMIT)), math.floor(math.log2(sigma) + 1e-5) - FIXED_SIGMA_BITS)


def _units(tables: Tables) -> str:
    return "".join(f"; {name} [{unit}]" for name, unit in tables.channels)


def _source(model: Model, tables: Tables) -> str:
    sizes = sorted({grid.nodes for h in tables.hypotheses for grid in (h.rho, h.alpha) if grid})
    grids = {grid.nodes: grid for h in tables.hypotheses for grid in (h.rho, h.alpha) if grid}
    parts = [f"/* Made by `selfcal codegen` from the model '{remark(model.name)}'. Do not edit. */"]
    parts += ["#include <math.h>", "", '#include "selfcal_model.h"', ""]
    same = '#error "selfcal_model.h is of another run of codegen than this file"'
    parts += [f"#if SELFCAL_MODEL_ID != 0x{tables.id:08X}UL", same, "#endif", ""]
    parts += [_grid(grids[nodes]) for nodes in sizes]
    parts += ["static const selfcal_axis_t axes[] = {", *(_axis(axis) for axis in tables.axes), "};", ""]
    for h in tables.hypotheses:
        if h.priors:
            named = zip(h.priors, tables.axes, strict=True)
            rows = (f"    {_priors(priors)}, /* {axis.name} */" for priors, axis in named)
            parts += [f"static const selfcal_prior_t priors_of_{h.name}[] = {{", *rows, "};", ""]
    parts += [line for h in tables.hypotheses for line in _law(h)]
    hypotheses = (_hypothesis(h) for h in tables.hypotheses)
    parts += ["static const selfcal_hypothesis_t hypotheses[] = {", *hypotheses, "};", ""]
    parts += _regressors(tables)
    if tables.half_life_s:
        code = f"{{&selfcal_forgetting_code, {_f(tables.half_life_s)}}}"
        parts += [f"static const selfcal_forgetting_t forgetting = {code};", ""]
    handling = tables.handling
    if handling != NOT_HANDLED:
        given = ", ".join([_f(handling.outlier_sd), *(str(b).lower() for b in handling.as_tuple[1:])])
        parts += [f"static const selfcal_handling_t handling = {{{given}}};", ""]
    names = ", ".join(f'"{axis.name}"' for axis in tables.axes)
    channels = ", ".join(f'"{name}"' for name, _ in tables.channels)
    parts += [
        f"const char *const selfcal_model_axis_name[] = {{{names}}};",
        *([f"const char *const selfcal_model_channel_name[] = {{{channels}}};"] if channels else []),
        "",
        "const selfcal_model_t selfcal_model = {",
        f"    0x{tables.id:08X}U, /* id */",
        f"    {_f(tables.dt_s)}, /* dt_s */",
        f"    {tables.block}U, /* block */",
        "    SELFCAL_MODEL_AXES, SELFCAL_MODEL_HYPOTHESES, SELFCAL_MODEL_NODES, axes, hypotheses,",
        f"    {'&regressors' if tables.regressors else 'NULL'},",
        f"    {'&forgetting' if tables.half_life_s else 'NULL'},",
        f"    {'&selfcal_states_code' if tables.term_nodes else 'NULL'},",
        f"    {'&handling' if handling != NOT_HANDLED else 'NULL'},",
        "};",
        "",
    ]
    return "\n".join([*parts, *_gate(model, tables), *_pipe(model, tables)])


def _f(value: float) -> str:
    """A literal that reads back as the float32 nearest to `value`, which the package's builds take."""
    text = f"{value:.9g}"
    if np.float32(text) != np.float32(value):  # rounded twice
        text = f"{np.float32(value):.9g}"
    return f"{text}{'' if any(c in text for c in '.en') else '.0'}F"


def _grid(grid: Grid) -> str:
    rows = ",\n".join("    " + ", ".join(_f(value) for value in row) for row in grid.fit.tolist())
    name = f"fit_{grid.nodes}"
    return (
        f"static const selfcal_real_t {name}[{grid.nodes * grid.nodes}] = {{\n{rows},\n}};\n"
        f"static const selfcal_grid_t grid_{grid.nodes} = {{{grid.nodes}U, {name}}};\n"
    )


def _priors(priors: Iterable[PriorRow]) -> str:
    flag = ("false", "true")
    return ", ".join(f"{{{_f(lo)}, {_f(hi)}, SELFCAL_{law.name}, {flag[known]}}}" for lo, hi, law, known in priors)


def _axis(axis: AxisTable) -> str:
    priors = _priors((*limits, False) for limits in zip(axis.ln_min, axis.ln_max, axis.law, strict=True))
    readout = f"{_f(axis.bias_sd)}, {_f(axis.range)}, {axis.stuck_limit}U"
    return f"    {{{{{priors}}}, {readout}}}, /* {axis.name}, {axis.unit} */"


def _regressors(tables: Tables) -> list[str]:
    if not tables.regressors:
        return []
    references = ", ".join(_f(column.reference) for column in tables.regressors)

    def by_axis(name: str, values: Callable[[RegressorTable], tuple[float, ...]]) -> list[str]:
        rows = (", ".join(_f(values(column)[at]) for column in tables.regressors) for at in range(len(tables.axes)))
        lines = (f"    {row}, /* {axis.name} */" for row, axis in zip(rows, tables.axes, strict=True))
        return [f"static const float {name}[] = {{", *lines, "};"]

    means = any(column.coefficient_mean for column in tables.regressors)
    return [
        "/* " + ", ".join(f"{column.name} [{column.unit}]" for column in tables.regressors) + " */",
        f"static const float reference[] = {{{references}}};",
        *by_axis("coefficient_sd", lambda column: column.coefficient_sd),
        *(by_axis("coefficient_mean", lambda column: column.coefficient_mean) if means else ()),
        "static const selfcal_source_t source[] = {",
        *(f"    {_column_source(tables, column)}, /* {column.name} */" for column in tables.regressors),
        "};",
        *by_axis("ln_odds", lambda column: column.ln_odds),
        "static const selfcal_regressors_t regressors = {",
        f"    &selfcal_regressors_code, {len(tables.regressors)}U, reference, coefficient_sd, source, ln_odds,",
        f"    {'coefficient_mean' if means else 'NULL'},",
        "};",
        "",
    ]


def _column_source(tables: Tables, column: RegressorTable) -> str:
    kind, channel, number, second = tables.source_of(column)
    return f"{{SELFCAL_COLUMN_{COLUMN_KINDS[kind]}, {channel}U, {_f(number)}, {_f(second)}}}"


def _gate(model: Model, tables: Tables) -> list[str]:
    gate = gate_table(model, tables)
    if gate is None:
        return []
    sigma = ", ".join("INFINITY" if math.isinf(value) else _f(value) for value in gate.sigma)
    kinds = ", ".join("true" if rate else "false" for rate in gate.is_rate)
    numbers = f"{gate.window}U, {_f(gate.false_alarm)}, {gate.hold}U, {gate.settle}U, {gate.memory}U"
    return [
        "const selfcal_gate_config_t selfcal_model_gate = {",
        f"    SELFCAL_MODEL_AXES, {numbers},",
        f"    {{{sigma}}}, {{{kinds}}},",
        "};",
        "",
    ]


def _pipe(model: Model, tables: Tables) -> list[str]:
    gate = "&selfcal_model_gate, &selfcal_gate_code" if gate_table(model, tables) is not None else "NULL, NULL"
    return [
        "const selfcal_pipe_t selfcal_model_pipe = {",
        f"    &selfcal_model, SELFCAL_MODEL_RATE_HZ, {gate},",
        f"    {'&selfcal_columns_code' if tables.regressors else 'NULL'},",
        "    SELFCAL_MODEL_JUDGED ? &selfcal_judging_code : NULL,",
        "    SELFCAL_MODEL_JUDGED && SELFCAL_MODEL_CHANGES ? &selfcal_changes_code : NULL,",
        "    SELFCAL_MODEL_HELD ? &selfcal_holding_code : NULL,",
        "};",
        "",
    ]


def _law(hypothesis: HypothesisTable) -> list[str]:
    terms, coloured = hypothesis.law.as_tuple
    flag = ("false", "true")
    rows = [
        f"    {{SELFCAL_{KINDS[kind].upper()}, {_f(deviation)}, {_f(bandwidth)}, {flag[stated]}, {flag[by_ratio]}}},"
        for kind, deviation, bandwidth, stated, by_ratio in terms
    ]
    head = f"static const selfcal_law_t law_{hypothesis.name} = {{{len(terms)}U, {flag[coloured]}, {{"
    return [head, *rows, "}};", ""] if rows else [f"{head}{{SELFCAL_WALK, 0.0F, 0.0F, false, false}}}}}};", ""]


def _hypothesis(hypothesis: HypothesisTable) -> str:
    rho, alpha = (f"&grid_{grid.nodes}" if grid else "NULL" for grid in (hypothesis.rho, hypothesis.alpha))
    prior = f", .prior = priors_of_{hypothesis.name}" if hypothesis.priors else ""
    chance = _f(hypothesis.ln_probability)
    law = f"&law_{hypothesis.name}"
    return f"    {{.law = {law}, .ln_probability = {chance}, .rho = {rho}, .alpha = {alpha}{prior}}},"
