"""`diagnose --navigate`: the flights by their physics, the words by their numbers, the sentence on a part with a truth.

Truth: the double integral of a bias along the attitude of the flight, g times a tilt, chi-squared, and the simulator's
parameters.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml
from outage_truth import COEFFICIENT, N, part, stated

from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.diagnosis import words
from selfcal.diagnosis.carried import BankTerm, with_terms
from selfcal.diagnosis.finding import Finding
from selfcal.likelihood.state import Look
from selfcal.model.file import DEFAULT, Model
from selfcal.model.regressors import offered
from selfcal.model.simulated_parts import AXES, SHEET_N
from selfcal.model.tables import make_tables
from selfcal.studies.navigation import (
    GPS_S,
    LONGEST_OUTAGE_S,
    RATE_HZ,
    FilterNoise,
    Filters,
    Part,
    flight,
)
from selfcal.studies.outage import COORDINATES, OUTAGES_S, KnownAxis, flights, words_of
from selfcal.verbs.diagnose import diagnose, show
from selfcal.verbs.simulate import simulate

STEPS = (GPS_S + LONGEST_OUTAGE_S) * RATE_HZ
SHEET = [{"N": SHEET_N[unit]} for unit in AXES.values()]


def off(rest: Array, errors: Array, tilt: float = 0.0) -> list[Array]:
    """Errors of the position [3] after each outage, of a flight with these errors of the readings and another tilt."""
    own = Part.of_errors(rest[None], errors[None])
    own = replace(own, start_attitude=own.start_attitude + np.array([tilt, 0.0, 0.0]))
    filters = Filters(FilterNoise.of([SHEET]), own)
    filters.rest()
    return [judged[0][0, :3] for judged in filters.fly(OUTAGES_S)]


REST, NONE = np.zeros((600, 6)), np.zeros((STEPS, 6))


def test_a_bias_that_begins_without_gps_is_integrated_twice() -> None:
    """0.03 m/s^2 up, from the moment on in which GPS is lost: the strapdown sums along the true attitude. The filter's
    attitude is off by up to a degree, 2 %."""
    jump = NONE.copy()
    jump[GPS_S * RATE_HZ :, 5] = 0.03
    more = [two - one for one, two in zip(off(REST, NONE), off(REST, jump), strict=True)]
    dt = 1.0 / RATE_HZ
    acceleration = flight().attitude[GPS_S * RATE_HZ : -1] @ [0.0, 0.0, 0.03]
    velocity = np.cumsum(acceleration, axis=0) * dt
    moved = np.cumsum(velocity * dt - acceleration * dt**2 / 2.0, axis=0)
    for outage, found in zip(OUTAGES_S, more, strict=True):
        expected = -moved[outage * RATE_HZ - 1]
        assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


def test_a_constant_bias_and_a_tilt_of_the_start_cancel() -> None:
    """Uncancelled a bias b makes b t^2 / 2, a tilt g times it. A tenth at most is left after a minute, as the document
    says: turns with GPS part the two a little."""
    bias, tilt = 0.06, math.radians(0.2)
    plain = off(REST, NONE)[1]
    offset = np.array([0.0, 0.0, 0.0, bias, -bias, 0.0])
    cases = (
        (off(REST + offset, NONE + offset), bias),
        (off(REST, NONE, tilt), STANDARD_GRAVITY * tilt),
    )
    for found, size in cases:
        alone = size * OUTAGES_S[1] ** 2 / 2.0
        assert np.linalg.norm(found[1] - plain) < 0.1 * alone


@pytest.mark.parametrize("share", (1.0, 0.5))
def test_how_sure_the_filter_is(share: float) -> None:
    """White noise of the data sheet on all axes, of which the filter is told a share: its stated sd is that share of
    the error after 300 s, where GPS no longer counts. Flights that share no reading: 16 in 6000 s, whose mean of
    chi-squared of 3 has an sd of 20 %, a ratio of sd half of it."""
    random = np.random.default_rng(5)
    told = {
        name: KnownAxis({"N": share * SHEET_N[unit]}, SHEET_N[unit] * random.standard_normal(12000))
        for name, unit in AXES.items()
    }
    side = flights(told)[f"{OUTAGES_S[-1]}"]
    assert math.sqrt(side["nees"] / COORDINATES) == pytest.approx(1.0 / share, rel=0.3)
    low, high = side["nees_band_95"]
    assert (low < side["nees"] < high) == (share == 1.0)


def test_the_words() -> None:
    """4 times the expected square is twice as sure; a quarter of it twice too cautious."""
    band = {"nees_band_95": [2.0, 4.2]}
    before, after = (
        {"position_m": 61.7, "nees": 12.0, **band},
        {"position_m": 18.3, "nees": 3.1, **band},
    )
    assert words_of(before, after) == (
        "Without it 62 m after 60 s without GPS and 2 times as sure as it may be; with it 18 m and as sure as it may "
        "be."
    )
    assert "18 m and 2 times too cautious" in words_of(before, {**after, "nees": 0.75})
    assert words_of(after, after) == "With or without it 18 m after 60 s without GPS and as sure as it may be."


def test_a_change_of_the_noise_beside_a_column() -> None:
    """A bank with columns refuses to handle changes of the noise: the model with both findings goes without."""
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["regressors"] = [{"name": "warm", "kind": "turn_on", "tau_s": 50.0, "sd": {"gyro": 1.0}, "probability": 0.5}]
    look, none = Look("variance_change", 20.0, 15.0, {}, {}, when=(500.0, 500.0)), cast(Any, None)
    term = BankTerm(Finding(look, 1, none, none), (), (), False)
    assert with_terms(Model.load(), none, {}, "gx", [term], []).handling.variance_changes
    own = with_terms(Model.load(), none, {}, "gx", [term], Model.of_tree(tree, DEFAULT).regressors)
    Bank(make_tables(replace(own, regressors=offered(own, "gx")), 1.0, ("gx",)))


def test_errors_that_are_too_short() -> None:
    with pytest.raises(UserError, match="flights need a recording of 1200 s or more"):
        flights({"gx": KnownAxis({"N": N}, np.zeros(1190))})


def test_the_sentence_comes_true(tmp_path: Path) -> None:
    """A part with a temperature on gx. The filter by the first record is as far off on the second one as the filter
    that is told the truth, within 10 %: both fly with the same errors. The sentence is of other errors: three
    flights of 600 s share no reading, and the two horizontal errors lead. Their rms has an sd of 1 / sqrt(2 * 3 * 2);
    60 % is two of it. Without the finding both are worse."""
    known = stated("temperature", 70, tmp_path)
    assert known is not None
    for outage in map(str, OUTAGES_S):
        truth, on, held_out = (known[key][outage] for key in ("truth", "on", "held_out"))
        assert on["after"]["position_m"] == pytest.approx(truth["position_m"], rel=0.1)
        assert held_out["after"]["position_m"] == pytest.approx(truth["position_m"], rel=0.6)
        for sides in (on, held_out):
            assert sides["before"]["position_m"] > sides["after"]["position_m"]


def test_the_document_and_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = part(tmp_path)
    log, page, out = (tmp_path / name for name in ("log.npz", "page.html", "out.json"))
    simulate(own, log, 8, [f"temperature:axis=gx,coefficient={2 * COEFFICIENT}"])
    document = diagnose(log, model=own, navigate=True, report=page, json=out)
    capsys.readouterr()
    (finding,) = document.findings
    assert finding.navigation is not None and document.navigation is not None
    assert json.loads(out.read_text())["navigation"]["axes"] == ["gx"]
    assert show(document, {}) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for line in words.navigation(document):
        assert line in printed and line in " ".join(page.read_text().split())
    assert "Position without GPS" in page.read_text()
