"""`selfcal plan`: how long must a part be recorded, and at what rate, until what is wanted of it is known?

An ensemble answers: parts as the model file's `simulate` entry states them, what it leaves open drawn from the priors.
Each is recorded for longer and longer, by readings at the bank's rate, and identified. The length is where SHARE of the
records have what is wanted. The Fisher information of the spectrum says how that length changes with the rate.

A wish of a regressor's coefficient asks for a swing of its channel in a record of that length. The channel follows a
cosine of half a cycle (one sweep) or more. The column that it makes, of variance V over n readings, says n V / S of the
coefficient, with S the spectrum at its frequency: that gives the swing, and the ensemble corrects it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from selfcal.adequacy.allan import allan_terms, information_of
from selfcal.adequacy.drawn import has_nodes, simulate_bank_samples
from selfcal.adequacy.summary import MOST_TIMES
from selfcal.bank.axis_result import HALF_90
from selfcal.base import units
from selfcal.base.errors import UserError, short
from selfcal.base.grid import Array, bisected
from selfcal.base.output import print_lines
from selfcal.base.units import duration_words
from selfcal.batch.spread import Row, spread
from selfcal.diagnosis.separate import SHARE
from selfcal.diagnosis.simulate import truth_of
from selfcal.model.file import Model, Regressor
from selfcal.model.forms import made
from selfcal.model.laws import PLACES, Law
from selfcal.model.regressors import channels_of, column_sources, offered
from selfcal.model.tables import make_tables

SCHEMA = "selfcal.plan/1"
#: Bank samples of the shortest record, and of the longest.
LENGTH_LEAST, LENGTH_MOST = 64, 200_000
#: Ratio of the rates of banks that a line compares, and largest ratio of the lengths that is worth a line: a slower
#: bank may lengthen the record by the inverse.
RATE_RATIO, WORTH = 10.0, 0.8
#: Largest ratio of two lengths, or of a bias' interval at half the length to the whole, that counts as 1.
LENGTHS_ALIKE = 1.1
#: Forms whose column is in proportion to the channel.
LINEAR = ("static", "lag", "rate")
_NUMBER = r"(\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_LAW = re.compile(rf"law decided {_NUMBER} ?%")
_SHARE, _VALUE = re.compile(rf"(\w+) within {_NUMBER} ?%"), re.compile(rf"(\w+) within {_NUMBER} (\S+)")


@dataclass(frozen=True)
class Wish:
    """What is wanted: a metric of at most `most`. Of the law (`parameter` ""): 1 - P of the true law. Of a parameter,
    or a regressor's coefficient: half its 90 % interval, over its median if `unit` is ""."""

    text: str
    parameter: str
    most: float
    unit: str = ""

    @staticmethod
    def of(text: str, like: str, regressors: Mapping[str, tuple[str, float]] = MappingProxyType({})) -> Wish:
        """A text such as `K within 20 %`, of an axis that reads in `like`. `regressors`: unit and size of the
        coefficients that may be wanted. Raises UserError."""
        plain = " ".join(text.split())
        if match := _LAW.fullmatch(plain):
            share = float(match[1]) / 100.0
            if not 0.5 <= share < 1.0:
                raise UserError(f"--want '{short(text)}': a law is decided by 50 % or more, and by less than 100 %")
            return Wish(plain, "", 1.0 - share)
        match = _SHARE.fullmatch(plain) or _VALUE.fullmatch(plain)
        if match is None or match[1] not in ("bias", *PLACES, *regressors):
            also = "".join(f", '{name} within 10 %'" for name in regressors)
            raise UserError(
                f"--want '{short(text)}': takes 'K within 20 %', 'bias within 0.001 {like}'{also} or 'law decided 95 %'"
            )
        if not 0.0 < float(match[2]) < math.inf:
            raise UserError(f"--want '{short(text)}': must be within more than 0")
        if match.re is _SHARE:
            if match[1] == "bias":
                raise UserError(f"--want '{short(text)}': a bias may be 0: state a unit, as 'bias within 0.001 {like}'")
            unit, size = regressors.get(match[1], ("", 1.0))
            return Wish(plain, match[1], float(match[2]) / 100.0 * size, unit)
        unit = units.plain(match[3])
        own = regressors[match[1]][0] if match[1] in regressors else units.parameter_unit(match[1], like)
        if not units.known(unit) or unit == units.LSB or not units.same_kind(unit, own):
            raise UserError(f"--want '{short(text)}': takes a unit as {own}, or %")
        return Wish(plain, match[1], float(match[2]) * units.factor(unit, own), unit)


def refusal(model: Model, axis: str, regressor: Regressor) -> str:
    """Why the coefficient of a regressor cannot be planned: plan swings a channel, in proportion to which the column
    moves. Empty if it can."""
    if regressor not in offered(model, axis):
        return f"{axis} has no regressor {regressor.name}"
    if regressor.kind not in ("column", "rate"):
        return (
            f"{regressor.name} is of kind {regressor.kind}, and has no channel that could be swung: leave this wish out"
        )
    if regressor.input == "value" and regressor.form in LINEAR:
        return ""
    what = f"form: {regressor.form}" if regressor.input == "value" else f"input: {regressor.input}"
    return f"{regressor.name} has `{what}`, which is not in proportion to {regressor.column}: leave this wish out"


def column_of(regressor: Regressor, channel: Array, rate_hz: float) -> Array:
    """float64[n]: the column that a channel [n] at this rate makes. The window of a rate is of whole intervals."""
    if regressor.kind == "rate":
        regressor = replace(regressor, window_s=max(1, round(regressor.window_s * rate_hz)) / rate_hz)
    return made(column_sources(regressor, channels_of((regressor,))), 1.0 / rate_hz, channel[:, None])[:, 0]


def bracket(lacks: Callable[[int], bool], least: int) -> tuple[int, int | None]:
    """The bank samples of the longest record tried that lacks something, 0 for none, and of a shortest record that has
    it. The latter is longer by LENGTHS_ALIKE at most, None beyond LENGTH_MOST."""
    low, high = 0, least
    while lacks(high):
        low, high = high, 2 * high
        if high > LENGTH_MOST:
            return low, None
    while low and high > LENGTHS_ALIKE * low:
        middle = int(math.sqrt(low * high))
        low, high = (middle, high) if lacks(middle) else (low, middle)
    return low, high


class PlannedRecords:
    """The records at each length that was asked for: metrics [records, wishes], NaN where a wish is not of the law."""

    def __init__(
        self, model: Model, axis: str, wishes: Sequence[Wish], seeds: Sequence[int], scheduler: str | None
    ) -> None:
        self.model, self.axis, self.wishes, self.seeds, self.scheduler = model, axis, wishes, seeds, scheduler
        self.at: dict[int, Array] = {}
        self.typical: dict[str, tuple[Law, dict[str, float]]] = {}

    def metrics(self, samples: int) -> Array:
        """Metrics of records of `samples` bank samples."""
        if samples not in self.at:
            rows = spread(
                partial(rows_of, self.model, self.axis, tuple(self.wishes), samples),
                self.seeds,
                scheduler=self.scheduler,
            )
            self.at[samples] = np.array([row["metrics"] for row in rows], np.float64)
            by_law: dict[str, list[dict[str, float]]] = {}
            for row in rows:
                by_law.setdefault(row["law"], []).append(row["truth"])
            self.typical = {
                law: (
                    self.model.laws[law],
                    {key: float(np.exp(np.mean(np.log([truth[key] for truth in truths])))) for key in truths[0]},
                )
                for law, truths in by_law.items()
            }
        return self.at[samples]

    def reached(self, k: int, samples: int) -> float:
        """ln of the metric that SHARE of the records keep, over the wish's: 0 or less is reached."""
        metric = self.metrics(samples)[:, k]
        metric = metric[~np.isnan(metric)]
        if metric.size < 0.1 * len(self.seeds):
            raise UserError(
                f"--want '{self.wishes[k].text}': hardly a part of {self.model.path} has a law with "
                f"{self.wishes[k].parameter} on {self.axis}: state `hypothesis` under simulate.axes.{self.axis}, "
                "of a recording in the file that `part` writes"
            )
        # An interval of no width has no logarithm.
        return math.log(max(float(np.quantile(metric, SHARE)), 1e-12) / self.wishes[k].most)

    def length(self, k: int) -> int | None:
        """Bank samples at which the wish is reached; None beyond LENGTH_MOST."""
        low, high = bracket(lambda samples: self.reached(k, samples) > 0.0, LENGTH_LEAST)
        if high is None or not low:
            return high
        above, below = self.reached(k, low), self.reached(k, high)
        share = above / (above - below) if above > below else 1.0
        return math.ceil(low * math.exp(share * math.log(high / low)))

    def curve(self, k: int) -> list[dict[str, float]]:
        """By length: what a tenth, half and nine tenths of the records keep."""
        rows = []
        for samples, metrics in sorted(self.at.items()):
            metric = metrics[~np.isnan(metrics[:, k]), k]
            q10, q50, q90 = np.quantile(metric, (0.1, 0.5, 0.9)).tolist()
            rows.append({"duration_s": samples / self.model.bank_rate_hz, "q10": q10, "q50": q50, "q90": q90})
        return rows


def cycling(
    model: Model, axis: str, wish: Wish, regressor: Regressor, samples: int, seeds: Sequence[int], scheduler: str | None
) -> list[dict[str, float]]:
    """The swing of the regressor's channel, from its lowest to its highest value, that SHARE of the records need."""
    bare, sweeps = replace(model, regressors=()), []
    parts = [part_of(bare, axis, seed) for seed in seeds]
    needed = (HALF_90 / wish.most) ** 2 - regressor.sd[model.group_of(axis).name] ** -2
    # A sweep is half a cycle.
    for cycles in (0.5, 1.0, 4.0):
        omega = np.array([2.0 * math.pi * cycles / samples])
        one_swing = column_of(regressor, swung(samples, cycles, 1.0), model.bank_rate_hz)
        power = [
            float(allan_terms(bare.laws[law], truth, 1.0 / model.bank_rate_hz).spectrum(omega)[0])
            for law, truth in parts
        ]
        swing = math.sqrt(float(np.quantile(power, SHARE)) * max(needed, 0.0) / (samples * float(one_swing.var())))
        if swing > 0.0:
            rows = spread(
                partial(coefficient_rows, replace(model, regressors=(regressor,)), axis, samples, cycles, swing),
                seeds,
                scheduler=scheduler,
            )
            # The information of a swing is as its square: each record's own swing by the swing that it had.
            own = [(HALF_90 / row["half"]) ** 2 - regressor.sd[model.group_of(axis).name] ** -2 for row in rows]
            swing *= math.sqrt(needed / float(np.quantile(own, 1.0 - SHARE)))
        sweeps.append({"cycles": cycles, "period_s": samples / model.bank_rate_hz / cycles, "swing": swing})
    return sweeps


def swung(samples: int, cycles: float, swing: float) -> Array:
    """`cycles` of a channel about 0 [n]."""
    return np.asarray(0.5 * swing * np.cos(2.0 * math.pi * cycles * (np.arange(samples) + 0.5) / samples))


def coefficient_rows(model: Model, axis: str, samples: int, cycles: float, swing: float, seed: int) -> list[Row]:
    """Half the 90 % interval of the coefficient of the model's only regressor, whose channel follows a cosine."""
    from selfcal.bank.library import Bank

    (regressor,), group = model.regressors, model.group_of(axis)
    law, truth = part_of(replace(model, regressors=()), axis, seed)
    y, _ = simulate_bank_samples(model.laws[law], truth, model.bank_rate_hz, samples, seed)
    about = regressor.offset
    column = column_of(regressor, swung(samples, cycles, swing) + about, model.bank_rate_hz)
    bank = Bank(make_tables(model, model.bank_rate_hz, (axis,)))
    bank.push((y + regressor.sd[group.name] * (column - about))[:, None], None, column.astype(np.float32)[:, None])
    return [{"half": HALF_90 * bank.report(0, 1).coefficients[law][0][1]}]


def part_of(model: Model, axis: str, seed: int) -> tuple[str, dict[str, float]]:
    """Law and truth of a part as the model's `simulate` entry states it, within what the grid of nodes has."""
    tables = make_tables(model, model.bank_rate_hz, (axis,))
    for again in range(1000):
        truth = dict(truth_of(model, seed + 7_000_003 * again)[axis])
        law, _ = truth.pop("hypothesis"), truth.pop("unit")
        if law not in model.laws:
            raise UserError(f"{model.path}: simulate.axes.{axis}: '{law}' is none of the model's hypotheses")
        if has_nodes(model.laws[law], truth, tables):
            return law, truth
    raise UserError(f"{model.path}: the grid has no node for the parts that it draws: more nodes, closer priors")


def rows_of(model: Model, axis: str, wishes: Sequence[Wish], samples: int, seed: int) -> list[Row]:
    """A record of the part: its law, truth, and the metric of each wish."""
    from selfcal.bank.library import Bank

    law, truth = part_of(model, axis, seed)
    y, _ = simulate_bank_samples(model.laws[law], truth, model.bank_rate_hz, samples, seed)
    bank = Bank(make_tables(model, model.bank_rate_hz, (axis,)))
    bank.push(y[:, None])
    result = bank.report(0)
    metrics = []
    for wish in wishes:
        if not wish.parameter:
            metrics.append(1.0 - result.probability[law])
        elif wish.parameter == "bias":
            metrics.append(HALF_90 * result.bias_sd)
        elif wish.parameter in result.parameters[law]:
            e = result.parameters[law][wish.parameter]
            half = 0.5 * (e.q95 - e.q05)
            metrics.append(half if wish.unit else half / e.median)
        else:
            metrics.append(math.nan)
    kept = {key: value for key, value in truth.items() if key in model.laws[law].parameters}
    return [{"law": law, "truth": kept, "metrics": metrics}]


def rates(
    model: Model,
    wishes: Sequence[Wish],
    lengths: Sequence[int | None],
    typical: Mapping[str, tuple[Law, Mapping[str, float]]],
) -> list[dict[str, Any]]:
    """The lengths at other rates of the bank, by the Fisher information of a typical part: only of wishes about a
    parameter."""
    rows = []
    own = model.bank_rate_hz
    for factor in (0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0):
        rate = own * factor
        if rate > model.sensor_rate_hz:
            break
        for wish, samples in zip(wishes, lengths, strict=True):
            law = next((entry for entry in typical.values() if wish.parameter in entry[0].parameters), None)
            if samples is None or law is None:
                continue
            duration_s = samples / own
            times = _times(partial(_half_interval, *law, wish.parameter), own, rate, duration_s)
            rows += [{"wish": wish.text, "rate_hz": rate, "duration_s": duration_s * times}] if times else []
    return rows


def _times(half: Callable[[float, float], float], own_hz: float, rate_hz: float, duration_s: float) -> float:
    """Length at another rate over this length for an equal interval, within MOST_TIMES; 0 without an interval."""
    target, far = half(own_hz, duration_s), math.log(MOST_TIMES)
    if target == math.inf:
        return 0.0
    return math.exp(bisected(lambda ln: half(rate_hz, duration_s * math.exp(ln)) <= target, -far, far)[1])


def _half_interval(law: Law, truth: Mapping[str, float], parameter: str, rate_hz: float, duration_s: float) -> float:
    """Half of the 90 % interval of ln of a parameter, by the Fisher information; infinite where the record has none."""
    n = duration_s * rate_hz
    if n < LENGTH_LEAST:
        return math.inf
    try:
        covariance = np.linalg.inv(information_of(law, truth, 1.0 / rate_hz, n))
    except np.linalg.LinAlgError:
        return math.inf
    variance = float(covariance[law.parameters.index(parameter), law.parameters.index(parameter)])
    return HALF_90 * math.sqrt(variance) if variance > 0.0 else math.inf


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """How long for each wish, in all, and what another rate would change."""
    print_lines(_lines(document), to_stderr=to_stderr)


def steady_level(curve: Sequence[Mapping[str, float]]) -> float | None:
    """What nine records of ten keep at the longest length, if half of that length has it too, but for LENGTHS_ALIKE."""
    longest = curve[-1]
    half = [point for point in curve if point["duration_s"] <= 0.5 * longest["duration_s"]]
    return longest["q90"] if half and half[-1]["q90"] < LENGTHS_ALIKE * longest["q90"] else None


def _swings(wish: Mapping[str, Any]) -> str:
    """How much to change the channel: once, or to and fro."""
    once, _, often = wish["cycling"]
    if once["swing"] == 0.0:
        return f"the prior has it: {wish['channel']} may stay as it is"
    said = f"in {duration_words(wish['duration_s'])} sweep {wish['channel']} once by {once['swing']:.2g} {wish['unit']}"
    every = duration_words(often["period_s"])
    return f"{said}, or cycle it {often['cycles']:g} times by {often['swing']:.2g} {wish['unit']}, {every} each"


def _lines(document: Mapping[str, Any]) -> list[str]:
    lines = [f"{document['axis']}: {document['records']} simulated parts, means at {document['rate_hz']:g} Hz"]
    for wish in document["wishes"]:
        there = wish["duration_s"]
        said = "no length that can be simulated suffices" if there is None else f"record {duration_words(there)}"
        lines.append(f"{wish['wish']}: {_swings(wish) if 'cycling' in wish else said}")
        if wish["wish"].startswith("bias") and (least := steady_level(wish["curve"])):
            lines.append(f"  nine of ten such parts know it within {least:.2g} at any length: longer does not help")
        for rate in document["rates"]:
            times = math.nan if there is None or rate["wish"] != wish["wish"] else rate["duration_s"] / there
            factor = rate["rate_hz"] / document["rate_hz"]
            if math.isclose(factor, RATE_RATIO) and times < WORTH:
                lines.append(f"  by means at {rate['rate_hz']:g} Hz: {duration_words(rate['duration_s'])}")
            if math.isclose(factor * RATE_RATIO, 1.0) and times < 1.0 / WORTH:
                lines.append(f"  means at {rate['rate_hz']:g} Hz suffice: {duration_words(rate['duration_s'])}")
    if document["duration_s"] is not None:
        lines.append(
            f"in all: record {duration_words(document['duration_s'])} at {document['rate_hz']:g} Hz or faster: "
            f"{100.0 * document['share']:g} % of such parts have it then"
        )
    return lines
