"""`selfcal response`: how an axis answers to a channel, and whether the record shows which of the two acts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.output import console_of, print_line, table_of
from selfcal.diagnosis import transfer
from selfcal.diagnosis.estimators import methods_beside
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.transfer import DRAWS, PROBABILITY, STRUCTURES, Draws, Drive, Empirical, Input, Trial
from selfcal.likelihood.state import ALIKE, NET_LEAST, FittedColumn, State
from selfcal.logs.recording import SIDE_CHANNELS, Recording, bridged
from selfcal.model.forms import POWER
from selfcal.model.regressors import coefficient_unit
from selfcal.readings.budget import FALSE_ALARM
from selfcal.readings.held import updates
from selfcal.readings.lattice import step_of

SCHEMA = "selfcal.response/1"
#: Samples that are looked at as they are; of more, means. More than the second number are refused: all columns of all
#: time constants are in memory together.
SAMPLES_MOST, REFUSED_FROM = 20_000, 300_000
#: Records that the answer makes. The next record is within the range of 20 records with 90 %.
RECORDS = 20
#: Rounds in which each of several inputs is searched with the others.
INPUT_ROUNDS = 2
#: Quantiles of an interval.
ENDS = tuple(0.5 + end * PROBABILITY / 2.0 for end in (-1.0, 0.0, 1.0))
#: How the readings of a held input were taken.
LINES = "straight lines between readings"
NO_INFLUENCE = "this record shows no influence of the input"
#: Words for the keys of an estimate.
WORDS = {
    "gain": "static gain",
    "rate": "rate coefficient",
    "direct": "gain of fast changes",
    "lag_s": "time constant",
    "lag_2_s": "second time constant",
    "pure_delay_s": "pure delay",
    "delay_s": "delay of slow changes",
    "period_s": "period",
    "damping": "damping ratio",
    "width": "width of the play",
    "square": "square coefficient",
    "cube": "cube coefficient",
}


def inputs_of(recording: Recording, record: Record, name: str) -> list[Input]:
    """The input about its median, as it may act. The reading of another axis acts itself. What a channel reads acts:
    behind its noise, and between its readings if held. The held readings may act themselves as well: a part that
    compensates by its own temperature."""
    if name in record.axes:
        acts = bridged(record.axes[name].y) + record.axes[name].level
        return [_about(Input(acts, acts, record.axes[name].unit))]
    if name not in record.channel_names.values():
        known = name in dict(SIDE_CHANNELS.values())
        reason = "does not change, or is a copy of an axis"
        reason = reason if known else "is neither temp, nor supply, nor an axis of the model"
        raise UserError(f"{recording.path}: column '{name}' {reason}: choose another --input")
    unit = recording.columns[name].unit
    values = units.converted(record.channel_of(name), dict(SIDE_CHANNELS.values())[name], unit)
    clock = recording.clock
    rows = updates(recording.columns[name].values, clock.place)
    read_at = clock.time_s if rows is None else clock.time_s[rows]
    held_s = float(read_at[-1] - read_at[0]) / max(1, read_at.size - 1)
    # Of means the rounding is less: readings within each scatter over the lattice.
    lattice = step_of(recording.columns[name].values)[0] if record.rate_hz == record.recorded_hz else 0.0
    if rows is None or held_s < 2.0 / record.rate_hz:
        return [_about(Input(transfer.quiet(values, lattice), values, unit))]
    # The middle of each cell of the grid.
    time = record.time_s + 0.5 * (1.0 / record.rate_hz - 1.0 / record.recorded_hz)
    time += float(recording.clock_of(next(iter(record.axes))).time_s[0])
    read = recording.columns[name].values[rows]
    lines = np.interp(time, read_at, transfer.quiet(read, lattice))
    held = Input(values, values, unit, held_s=held_s, taken="held readings")
    return [_about(Input(lines, lines, unit, held_s=held_s, taken=LINES)), _about(held)]


def _about(given: Input) -> Input:
    """The input about its median."""
    reference = float(np.median(given.values))
    return replace(given, values=given.values - reference, read=given.read - reference, reference=reference)


def answers_of(state: State, inputs: Mapping[str, Sequence[Input]]) -> dict[str, tuple[dict[str, Any], Input]]:
    """The answer to each input, with the columns that the others act by, and the input as it acts likeliest. The input
    that explains most alone comes first. Inputs that explain as much, and nothing over each other, go together: each is
    answered without the other, and neither is sure."""
    alone = {name: _best(state, each)[0] for name, each in inputs.items()} if len(inputs) > 1 else {}
    order = sorted(inputs, key=lambda name: -alone.get(name, 0.0))
    known: dict[str, Array] = {}
    more: dict[str, float] = {}

    def beside_others(name: str, apart: Sequence[str] = ()) -> State:
        columns = [(other, column) for other, block in known.items() if other not in (name, *apart) for column in block]
        added = [FittedColumn(f"{other}_{k}", "input", column, "1", {}) for k, (other, column) in enumerate(columns)]
        return state.refit(regressors=(*state.regressors, *added)) if added else state

    for _ in range(INPUT_ROUNDS if len(inputs) > 1 else 0):
        for name in order:
            more[name], columns = _best(beside_others(name), inputs[name])
            known[name] = columns if more[name] > 0.0 else columns[:0]

    def with_it(name: str) -> list[str]:
        """The other inputs that it goes together with."""
        both = [rival for rival in alone if rival != name and min(alone[rival], alone[name]) > NET_LEAST]
        apart = [rival for rival in both if min(more[rival], more[name]) > NET_LEAST]
        near = [abs(alone[rival] - alone[name]) < ALIKE or _copies(inputs[rival][0], inputs[name][0]) for rival in both]
        return [rival for rival, alike in zip(both, near, strict=True) if alike and rival not in apart]

    found = {}
    for name, each in inputs.items():
        other = with_it(name)
        said = [f"it goes together with {rival}: either explains the record alone" for rival in other]
        found[name] = answer_of(beside_others(name, other), each, said)
    return found


def _copies(given: Input, other: Input) -> bool:
    """Whether either input is the other times a factor, within the noise of its readings."""
    for a, b in ((given, other), (other, given)):
        x, y = a.values - a.values.mean(), b.read - b.read.mean()
        noise = float(y @ (b.read - b.values)) / y.size  # the curve follows a part of it
        if np.var(y - x * (x @ y) / max(float(x @ x), 1e-300)) <= 2.0 * noise:
            return True
    return False


def _best(state: State, inputs: Sequence[Input]) -> tuple[float, Array]:
    """The score and the columns of an input's best structure."""
    best = max(_found(state, inputs)[0], key=lambda answer: answer.score)
    return best.score, best.columns


def _found(state: State, inputs: Sequence[Input]) -> tuple[list[Trial], Input]:
    """Every structure of the input as it acts likeliest, and that input."""
    each = [[transfer.tried(state, Drive(u.values, state.dt), structure) for structure in STRUCTURES] for u in inputs]
    # Of two that explain a record alike, the first is meant.
    best = [max(answer.score for answer in tried) for tried in each]
    place = max(range(len(each)), key=lambda k: best[k] + ALIKE * (k == 0))
    return each[place], inputs[place]


def answer_of(state: State, inputs: Sequence[Input], against: Sequence[str] = ()) -> tuple[dict[str, Any], Input]:
    """Everything that is found of an axis and an input, as the document has it, and the input as it acts likeliest.
    `against`: what speaks against any answer."""
    dt = state.dt
    found, given = _found(state, inputs)
    drive = Drive(given.values, dt)
    unit = given.unit
    found = transfer.beside_two_terms(state, found)
    chosen = max(found, key=lambda answer: answer.score)
    net = transfer.worth(state, chosen)
    shown = chosen.score > 0.0 and net >= NET_LEAST
    weight = np.exp(np.array([answer.score for answer in found]) - max(0.0, chosen.score))
    weight /= weight.sum()
    poles = np.array([answer.structure.poles for answer in found])
    orders = {str(order): float(weight[poles == order].sum()) for order in sorted(set(poles.tolist()))}
    likely = sorted(orders, key=lambda order: -orders[order])
    within = likely[: 1 + int(np.searchsorted(np.cumsum([orders[order] for order in likely]), PROBABILITY))]
    rest = bridged(state.y)
    for regressor, c in zip(state.regressors, chosen.fit.c[1:], strict=False):
        rest = rest - c * regressor.values
    seen = transfer.empirical(given.values, rest, dt)
    entry: dict[str, Any] = {"influence": shown, "evidence_gain_nats": chosen.gain, "net_nats": net}
    if shown:
        acts_back = not any(units.same_kind(unit, side) for _, side in SIDE_CHANNELS.values())
        alike = [k for k in np.argsort(-weight) if weight[k] > 1.0 / 50.0]
        drawn = [transfer.posterior(state, drive, found[k]) for k in alike]
        pooled = Pooled(drawn, weight[alike])
        methods = _methods(state, drive, given.read, chosen, pooled, seen)
        held_out = transfer.held_out(state, chosen)
        misfits = [
            *against,
            *_misfits(transfer.left_over(state, drive, chosen), held_out * chosen.fit.n / 3.0, methods),
        ]
        verdict, reason = transfer.source(state, drive, chosen, drawn[0], misfits, acts_back=acts_back)
        entry |= {
            "structure": chosen.structure.name,
            "order": {"chosen": chosen.structure.poles, "within_90": sorted(map(int, within)), "probability": orders},
            "structures": {answer.structure.name: float(share) for answer, share in zip(found, weight, strict=True)},
            "source": {"verdict": verdict, "reason": reason},
            "held_out": {"nats_per_sample": held_out},
        }
        if misfits:
            entry |= _silent(state, given, methods)
        else:
            entry |= {
                "estimate": _estimate(pooled, state.unit, unit),
                "frequency_response": _band(pooled, state.y.size, dt),
            }
        entry |= methods
    else:
        least = state.least(given.values)
        entry |= {
            "source": {"verdict": "none", "reason": NO_INFLUENCE},
            "would_have_been_found": {"gain": least, "unit": coefficient_unit(state.unit, unit)},
        }
    return entry | {"empirical": _empirical(seen)}, given


@dataclass(frozen=True)
class Pooled:
    """Posteriors of the structures that a record leaves possible, the likeliest first, and the weight of each."""

    each: Sequence[Draws]
    weight: Array

    def of(self, value: Callable[[Draws], NDArray[Any]], key: str = "gain") -> NDArray[Any]:
        """Draws of a value, from each structure that has the key by its weight."""
        chosen = [k for k, answer in enumerate(self.each) if key in answer.structure.keys]
        share = self.weight[chosen] / self.weight[chosen].sum()
        return np.concatenate(
            [value(self.each[k])[: round(DRAWS * part)] for k, part in zip(chosen, share, strict=True)]
        )

    def answers(self, drive: Drive, count: int) -> Array:
        """[count, n]: what the input makes by draws of all the structures."""
        made = []
        places = np.random.default_rng(2).choice(len(self.each), count, p=self.weight / self.weight.sum())
        for k, place in enumerate(places):
            answer = self.each[place]
            made.append(
                answer.c[k] @ drive.columns(answer.structure, tuple(answer.shape[k]))[: len(answer.structure.keys)]
            )
        return np.array(made)


def _misfits(left_over: float, held_out: float, methods: Mapping[str, Any]) -> list[str]:
    """What contradicts the structure, in words. Where it holds, each is so by chance in FALSE_ALARM of records."""
    said = []
    if left_over > -math.log(FALSE_ALARM):
        said.append("the residuals still go with the input")
    if held_out < math.log(FALSE_ALARM):
        said.append("by the part before, the last third is predicted worse with the input than without")
    for name, method in methods.get("methods", {}).items():
        if not method["agrees"]:
            key = next(key for key in ("gain", "delay_s") if not method["within"][key])
            low, high = method["if_answer_holds"][key]
            what = {"gain": "a static gain", "delay_s": "a delay"}[key]
            said.append(f"{name} finds {what} of {method[key]:.3g}, where {low:.3g} to {high:.3g} was due")
    spectra = methods.get("spectra")
    if spectra and spectra["hold_answer"] < binom.ppf(FALSE_ALARM, spectra["bands"], PROBABILITY):
        said.append(f"{spectra['hold_answer']} of {spectra['bands']} coherent bands hold the answer")
    return said


def _silent(state: State, given: Input, methods: Mapping[str, Any]) -> dict[str, Any]:
    """The range of the other methods in the place of an interval, and the record that would show a structure."""
    entry: dict[str, Any] = {}
    late_s = 0.0
    if found := methods.get("methods"):
        gains = [answer["gain"] for answer in found.values()]
        late_s = max(abs(answer["delay_s"]) for answer in found.values())
        entry["range"] = {"gain": [min(gains), max(gains)], "unit": coefficient_unit(state.unit, given.unit)}
    span = state.y.size * state.dt
    # From times that show a delay to those that show a static gain.
    short_s = min(max(0.5 * late_s, 4.0 * state.dt), span / 50.0)
    words = f"switch the input between two levels after random times of {short_s:.2g} to {span / 10.0:.2g} s"
    return entry | {"record_next": f"{words}, for {2.0 * span:.2g} s; nothing else may change meanwhile"}


def _estimate(pooled: Pooled, output: str, unit: str) -> dict[str, Any]:
    """Posterior of each number of the likeliest structure; gain and delay are of all that may be."""
    drawn = pooled.each[0]
    structure = drawn.structure
    values = dict(zip(structure.keys, drawn.c.T, strict=True)) | dict(zip(structure.shape, drawn.shape.T, strict=True))
    values.pop("window_s", None)
    if "gain" in values and structure.linear:
        values["gain"] = pooled.of(lambda answer: answer.c[:, answer.structure.keys.index("gain")])
        if structure.shape:
            values["delay_s"] = pooled.of(lambda answer: answer.delay_s)
    if structure.name == "delay":
        del values["pure_delay_s"]
    elif structure.name == "lag":
        del values["delay_s"]
    named = {"rate": coefficient_unit(output, f"{unit}/s"), "damping": "1", "width": unit}
    named |= {key: coefficient_unit(output, units.power(unit, exponent)) for key, exponent in POWER.items()}
    return {
        key: {
            "mean": float(draws.mean()),
            "sd": float(draws.std()),
            **dict(zip(("q05", "median", "q95"), np.quantile(draws, ENDS).tolist(), strict=True)),
            "unit": "s" if key.endswith("_s") else named.get(key, coefficient_unit(output, unit)),
        }
        for key, draws in values.items()
    }


def _methods(state: State, drive: Drive, read: Array, chosen: Trial, pooled: Pooled, seen: Empirical) -> dict[str, Any]:
    """Estimates of other methods, for an answer that is linear and has a static gain, and the step of their means."""
    if "gain" not in chosen.structure.keys or not chosen.structure.linear:
        return {}
    late_s = abs(float(np.median(pooled.each[0].delay_s)))
    finest = max(state.dt, late_s / 3.0)
    # Other methods take 150 means at least.
    steps = max(1, min(round(finest / state.dt), state.y.size // 150))
    own = len(chosen.structure.keys)
    parts = chosen.fit.c[-len(chosen.columns) :, None] * chosen.columns
    answers = np.vstack([parts[:own].sum(axis=0), *pooled.answers(drive, RECORDS - 1)])
    found = methods_beside(state, chosen.fit, drive.u, read, answers, parts[own:].sum(axis=0), steps)
    step_s = steps * state.dt
    clear = seen.coherence > seen.chance
    # Its own errors are in the answer's ratio too.
    off = np.abs(seen.ratio - transfer.empirical(drive.u, parts.sum(axis=0), state.dt).ratio)[clear]
    return {
        "methods_step_s": step_s,
        "spectra": {"bands": off.size, "hold_answer": int(np.count_nonzero(off <= seen.within[clear]))},
        "methods": {
            name: {
                "order": answer.estimate.order,
                "evidence_nats": {str(order): nats for order, nats in answer.estimate.evidence.items()},
                "gain": answer.estimate.gain,
                "delay_s": answer.estimate.delay * step_s,
                "if_answer_holds": {
                    "gain": [float(answer.least[0]), float(answer.most[0])],
                    "delay_s": [float(answer.least[1] * step_s), float(answer.most[1] * step_s)],
                },
                "within": dict(zip(("gain", "delay_s"), answer.within, strict=True)),
                "agrees": all(answer.within),
            }
            for name, answer in found.items()
        },
    }


def _band(pooled: Pooled, n: int, dt: float) -> dict[str, list[float]]:
    """Gain and phase over frequency with their 90 % bands, point by point."""
    frequency = np.geomspace(1.0 / (n * dt), 0.5 / dt, 60)
    G = pooled.of(lambda answer: answer.at(frequency), pooled.each[0].structure.keys[0])
    gain = np.quantile(np.abs(G), ENDS, axis=0)
    middle = G.mean(axis=0)
    turn = np.quantile(np.angle(G / middle), ENDS, axis=0)
    phase = np.degrees(np.unwrap(np.angle(middle)) + turn)
    named = {"gain_q05": gain[0], "gain": gain[1], "gain_q95": gain[2]}
    named |= {"phase_deg_q05": phase[0], "phase_deg": phase[1], "phase_deg_q95": phase[2]}
    return {"frequency_hz": frequency.tolist(), **{key: values.tolist() for key, values in named.items()}}


def _empirical(found: Empirical) -> dict[str, list[float]]:
    """The ratio of spectra. Its phase is known nowhere that the band holds 0."""
    size = np.abs(found.ratio)
    turn = np.degrees(np.where(found.within < size, np.arcsin(np.minimum(found.within / size, 1.0)), math.pi))
    phase = np.degrees(np.angle(found.ratio))
    named = {
        "frequency_hz": found.frequency_hz,
        "gain": size,
        "gain_q05": np.maximum(size - found.within, 0.0),
        "gain_q95": size + found.within,
        "phase_deg": phase,
        "phase_deg_q05": phase - turn,
        "phase_deg_q95": phase + turn,
        "coherence": found.coherence,
        "coherence_by_chance": found.chance,
    }
    return {key: values.tolist() for key, values in named.items()}


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """The answer in a few lines, and the table of its numbers."""
    console = console_of(to_stderr=to_stderr)
    line = partial(print_line, console)
    source, axis = document["source"], document["output"]["axis"]
    given = document["input"]
    line(f"{given['column']} -> {axis}, means of {1.0 / document['judged_at_hz']:g} s")
    if "held_s" in given:
        line(f"{given['column']} is read every {given['held_s']:.4g} s: taken as {given['taken']}")
    if not document["influence"]:
        least = document["would_have_been_found"]
        line(str(source["reason"]))
        if math.isfinite(least["gain"]):
            line(f"a static gain of {least['gain']:.2g} {least['unit']} would have been found")
        return
    order = document["order"]
    others = ", ".join(map(str, order["within_90"]))
    if "estimate" in document:
        line(f"influence: {document['structure']}, order {order['chosen']} (90 %: {others})")
    else:
        line(f"influence: no structure holds, the nearest is {document['structure']}")
    line(f"evidence {document['evidence_gain_nats']:.1f} nats, {document['net_nats']:.1f} net of the search")
    if "estimate" in document:
        table = table_of(("", "median", "5 %", "95 %", "unit"))
        for key, entry in document["estimate"].items():
            table.add_row(WORDS[key], *(f"{entry[at]:.4g}" for at in ("median", "q05", "q95")), entry["unit"])
        console.print(table)
    if set(document.get("estimate", ())) & set(POWER):
        line(f"gain at {given['reference']:.4g} {given['unit']}, from which the powers count")
    if given.get("taken") == LINES:
        line(f"a delay of less than {document['delay_resolution_s']:.4g} s is not resolved")
    line(f"source: {source['verdict']}: {source['reason']}")
    if "range" in document:
        low, high = document["range"]["gain"]
        line(f"the other methods' static gains: {low:.3g} to {high:.3g} {document['range']['unit']}")
    if "record_next" in document:
        line(f"record next: {document['record_next']}")
    gain = document["held_out"]["nats_per_sample"]
    line(f"the last third, predicted by the part before: {gain:+.2g} nats a sample better with the input than without")
    if "methods" not in document:
        return
    line("")
    line(f"other methods, means of {document['methods_step_s']:g} s; in brackets 90 % if the answer holds")
    table = table_of(("", "order", "static gain", "delay, s", "agrees"))
    for name, entry in document["methods"].items():
        cells = []
        for key in ("gain", "delay_s"):
            low, high = entry["if_answer_holds"][key]
            cells.append(f"{entry[key]:.3g} ({low:.3g} to {high:.3g})")
        table.add_row(name, str(entry["order"]), *cells, "yes" if entry["agrees"] else "no")
    console.print(table)
    spectra = document["spectra"]
    if spectra["bands"]:
        line(f"ratio of spectra: {spectra['hold_answer']} of {spectra['bands']} coherent bands hold the answer")
    else:
        line("ratio of spectra: no band is coherent beyond chance")
