"""What a finding of `diagnose` means in metres: the GPS/INS filter of navigation.py flies with the recorded errors.

The bank learns noise and coefficients from the first half of the recording, as a module does: by the model with every
finding, and by the model without an event. FLIGHTS begin in the second half, each after a rest. The errors of their
readings are the recorded errors, less their level and less the columns that the model knows. Motion, GPS and the errors
at the start are simulated. An axis that was not judged has white noise: that of its kind, else the data sheet's.

With a second recording the bank learns from the whole first recording. Flights are in the second half of the second. A
size that belongs to a single recording is learned from the first half of the second, and an event is left to the noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy import stats

from selfcal.bank.blocks import blocks_of
from selfcal.bank.library import Bank
from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.diagnosis import words
from selfcal.diagnosis.carried import BankTerm, term_of, why_stays, with_terms
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.record import Record
from selfcal.logs.recording import Recording, as_float, bridged
from selfcal.model.file import Model
from selfcal.model.regressors import columns_of, mask_of, offered
from selfcal.model.simulated_parts import AXES, SHEET_N
from selfcal.model.tables import make_tables
from selfcal.readings.readings import look
from selfcal.studies.navigate import bank_noise
from selfcal.studies.navigation import (
    GPS_S,
    LONGEST_OUTAGE_S,
    OUTAGE_S,
    RATE_HZ,
    REST_S,
    SCALE,
    FilterNoise,
    Filters,
    Part,
    nees,
)

#: Outages after which the position is judged, s; the sentence states OUTAGE_S.
OUTAGES_S = (10, OUTAGE_S, LONGEST_OUTAGE_S)
#: Flights, evenly spread; coordinates of a position.
FLIGHTS, COORDINATES = 50, 3
#: Assumptions behind the numbers.
ASSUMES = (
    f"The filter flies figures of eight: {GPS_S} s with GPS of 3 m a second, then none. Motion, GPS and the errors at "
    "the start are simulated, the errors of the readings are recorded: no vibration, and the temperature of the bench."
)
CANCELS = (
    "A constant bias cancels, to a tenth: before take-off the filter puts it into the bias or the tilt, and errors of "
    "these act against each other. The later change of a bias counts."
)


@dataclass(frozen=True)
class KnownAxis:
    """What a filter knows of an axis: its noise in the units of AXES, and the errors of its readings [s], means of 1 s
    in the same unit."""

    noise: Mapping[str, float]
    errors: Array


def add_outages(
    document: dict[str, Any],
    model: Model,
    tree: Mapping[str, Any],
    record: Record,
    diagnosed: Mapping[str, Diagnosed],
    recording: Recording,
    second: Recording | None,
) -> None:
    """Put `navigation` into each material finding of the document, or None and `navigation_reason`; and into the
    document what they have in common, None without a flight. `tree`: the extended model file's."""
    flown = recording if second is None else second
    names = [name for name in AXES if name in diagnosed and name in flown.columns]
    extended = {regressor.name: regressor for regressor in Model.of_tree(tree, model.path).regressors}
    terms: dict[str, list[tuple[str, BankTerm]]] = {name: [] for name in names}
    reasons: dict[str, str] = {}
    for name in names:
        for finding, entry in zip(diagnosed[name].by_gain, document["axes"][name]["findings"], strict=True):
            term = term_of(diagnosed[name], finding, extended)
            if isinstance(term, str):
                reasons[entry["of"]] = term
            else:
                terms[name].append((entry["of"], term))

    @cache
    def known(name: str, without: str) -> KnownAxis:
        own = [term for of, term in terms[name] if of != without]
        return _known(model, record, diagnosed, name, own, recording, second)

    document["navigation"] = None
    for entry in document["findings"]:
        if not entry["material"]:
            continue
        event = entry["id"]
        acts = [name for name in names if any(of == event for of, _ in terms[name])]
        entry["navigation"] = None
        try:
            if not acts:
                raise UserError(reasons.get(event, f"nothing of it is in the bank's model of {', '.join(AXES)}"))
            whole = {name: known(name, "") for name in names}
            _check(whole)
            before, after = map(flights, ({**whole, **{name: known(name, event) for name in acts}}, whole))
        except UserError as error:
            entry["navigation_reason"] = str(error)
            continue
        entry["navigation"] = {
            "outage_s": {horizon: {"before": before[horizon], "after": after[horizon]} for horizon in before},
            "words": words_of(*(side[f"{OUTAGE_S}"] for side in (before, after))),
        }
        rest = "" if len(names) == len(AXES) else ", white noise on the other axes"
        time = "held-out time" if second is None else "the second recording"
        document["navigation"] = {
            "axes": names,
            "flights": FLIGHTS,
            "nees_expected": COORDINATES,
            "words": f"{FLIGHTS} flights over {time} with the errors of {', '.join(names)}{rest}. {ASSUMES} {CANCELS}",
        }


def _known(
    model: Model,
    record: Record,
    diagnosed: Mapping[str, Diagnosed],
    name: str,
    terms: Sequence[BankTerm],
    recording: Recording,
    second: Recording | None,
) -> KnownAxis:
    """Noise and errors of an axis by a model with these terms."""
    own = with_terms(model, record, diagnosed, name, terms, [column for term in terms for column in term.columns])
    stays = {column.name for term in terms if why_stays(term.finding) for column in term.columns}
    anew = {column.name for term in terms if term.anew for column in term.columns} - stays
    values, columns, readings = _readings(own, name, recording)
    half = values.size // 2
    noise, c = _learned(own, name, readings, values, columns, half if second is None else values.size)
    if second is not None:
        places = [regressor.name for regressor in offered(own, name) for _ in regressor.columns]
        kept = np.array([place not in stays | anew for place in places], bool)
        values, columns, readings = _readings(own, name, second)
        values = values - columns[:, kept] @ c[kept]
        fresh = replace(own, regressors=tuple(regressor for regressor in own.regressors if regressor.name in anew))
        columns = columns[:, [place in anew for place in places]]
        c = _learned(fresh, name, readings, values, columns, values.size // 2)[1] if anew else np.zeros(0)
    group = replace(own.group_of(name), range=0.0, stuck_limit=0)
    rate_hz = readings.rate_hz
    seconds = blocks_of(values - columns @ c, readings.missing_before, max(1, round(rate_hz)), group)
    factor = units.factor(group.unit, AXES[name])
    errors = np.concatenate([np.full(round(seconds.begin / rate_hz), np.nan), seconds.mean])
    return KnownAxis(
        {key: value if key == "alpha" else value * factor for key, value in noise.items()}, bridged(errors) * factor
    )


def _readings(own: Model, name: str, recording: Recording) -> tuple[Array, Array, Recording]:
    """Readings [n] of an axis less their median, the columns [n, p] about their references, and the recording."""
    seen = look(recording.along(name), name, own.group_of(name))
    if seen.recording.rate_hz < 1.0:
        raise UserError("flights need readings at 1 Hz or faster")
    regressors = offered(own, name)
    about = np.array(
        [
            regressor.reference if regressor.kind == "column" else 0.0
            for regressor in regressors
            for _ in regressor.columns
        ]
    )
    columns = columns_of(regressors, seen.recording) - about
    return seen.working - float(np.nanmedian(seen.working)), columns, seen.recording


def _learned(
    own: Model, name: str, recording: Recording, values: Array, columns: Array, upto: int
) -> tuple[Mapping[str, float], Array]:
    """Noise of an axis and its coefficients [p], by the bank after the first `upto` readings."""
    regressors = offered(own, name)
    tables = make_tables(replace(own, regressors=regressors), recording.rate_hz, (name,), bank_rate_hz=1.0)
    bank = Bank(tables)
    rows = as_float(columns + [column.reference for column in tables.regressors])[:upto] if regressors else None
    bank.push(as_float(values)[:upto, None], recording.missing_before[:upto], rows)
    noise, now = bank_noise(bank, 0, mask_of(regressors, regressors))
    return noise, np.array([mean for mean, _ in now.coefficients[now.best]])


def flights(known: Mapping[str, KnownAxis]) -> dict[str, dict[str, Any]]:
    """By outage, s: rms error of the position, m, mean of its NEES and the 95 % band of it, in FLIGHTS of the second
    half. Raises UserError of errors that are too short."""
    seconds = min(axis.errors.size for axis in known.values())
    first, last = seconds // 2, seconds - GPS_S - LONGEST_OUTAGE_S
    if last < first:
        raise UserError(f"flights need a recording of {2 * (GPS_S + LONGEST_OUTAGE_S)} s or more")
    white = _white(seconds)
    own, noise = [], []
    for name, unit in AXES.items():
        alike = [axis.noise["N"] ** 2 for other, axis in known.items() if AXES[other] == unit]
        N = math.sqrt(sum(alike) / len(alike)) if alike else SHEET_N[unit]
        axis = known.get(name, KnownAxis({"N": N}, N * white[name]))
        own.append(axis.errors[:seconds])
        noise.append(axis.noise)
    errors = np.stack(own, axis=1) * SCALE
    starts = np.linspace(first, last, FLIGHTS).astype(int)
    flown = np.arange(GPS_S + LONGEST_OUTAGE_S)
    rest = np.arange(-min(REST_S, first), 0)
    part = Part.of_errors(errors[starts[:, None] + rest], np.repeat(errors[starts[:, None] + flown], RATE_HZ, axis=1))
    filters = Filters(FilterNoise.of([noise] * FLIGHTS), part)
    filters.rest()
    position = slice(0, COORDINATES)
    by_outage: dict[str, dict[str, Any]] = {}
    for outage, (off, covariance) in zip(OUTAGES_S, filters.fly(OUTAGES_S), strict=True):
        squares = nees(off[:, position], covariance[:, position, position])
        apart = max(1, (seconds - first) // (GPS_S + outage))  # flights that share no reading
        band = stats.chi2.ppf([0.025, 0.975], COORDINATES * apart) / apart
        by_outage[f"{outage}"] = {
            "position_m": math.sqrt(float(np.mean(np.sum(off[:, position] ** 2, axis=1)))),
            "nees": float(squares.mean()),
            "nees_band_95": band.tolist(),
        }
    return by_outage


def _white(seconds: int) -> dict[str, Array]:
    """White noise [s] of each of AXES, the same at every call."""
    random = np.random.default_rng(0)
    return {name: random.standard_normal(seconds) for name in AXES}


def _check(known: Mapping[str, KnownAxis]) -> None:
    """Raise UserError where flights with white noise alone, as the axes have it, are not as exact as they state: then
    the filter's own approximations show, not the axes."""
    white = _white(max(axis.errors.size for axis in known.values()))
    ideal = {
        name: KnownAxis({"N": axis.noise["N"]}, axis.noise["N"] * white[name][: axis.errors.size])
        for name, axis in known.items()
    }
    side = flights(ideal)[f"{OUTAGE_S}"]
    if side["nees"] > side["nees_band_95"][1]:
        raise UserError("its noise is below what the GPS and the filter of these flights resolve")


def words_of(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """What a finding means after OUTAGE_S, in a sentence."""
    without, with_it = (f"{words.ratio(side['position_m'])} m" for side in (before, after))
    sure = [_sure(side) for side in (before, after)]
    if (without, sure[0]) == (with_it, sure[1]):
        return f"With or without it {without} after {OUTAGE_S} s without GPS and {sure[0]}."
    return f"Without it {without} after {OUTAGE_S} s without GPS and {sure[0]}; with it {with_it} and {sure[1]}."


def _sure(side: Mapping[str, Any]) -> str:
    """How the stated sd of the position compares with its error."""
    low, high = side["nees_band_95"]
    times = math.sqrt(side["nees"] / COORDINATES)
    if low <= side["nees"] <= high:
        return "as sure as it may be"
    return f"{times:.2g} times as sure as it may be" if times > 1.0 else f"{1.0 / times:.2g} times too cautious"
