"""One verdict: its statistics as a family, the checks of `identify`, means and every sample; dead bands end in one.

Truth: the numbers that each record was drawn with, sample by sample.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from drifts import fitted, of_one
from scipy.stats import binom, kurtosistest, norm

from selfcal.adequacy.checks import against, kurtosis_at
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.diagnosis.axis_verdict import coherence, joined_looks, look_of
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import FEWEST, Record
from selfcal.diagnosis.statistics import Statistic, judged
from selfcal.likelihood.state import NET_LEAST, Look, State
from selfcal.model.file import LARGEST, SMALLEST, Model
from selfcal.readings.budget import CHECK_LIMIT, OF_MODULES, SHARES
from selfcal.show import pictures
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

from conftest import case_records

SAMPLES = 1500


def record_of(state: State, channels: dict[str, Array] | None = None) -> Record:
    return Record(1.0, {"gx": state}, channels or {}, {}, np.ones(state.y.size, bool))


def log_of(path: Path, y: Array, rate: float) -> Path:
    np.savez(path, allow_pickle=False, **{"t[s]": np.arange(y.size) / rate, "gx[deg/s]": y})
    return path


def test_the_family_is_no_surer_than_it_states() -> None:
    """Of records that the model made, no more than a share p has a probability below p."""
    random = np.random.default_rng(51)
    records = case_records(12, 300)
    p = np.array([judged(fitted(of_one(random, SAMPLES)), seed=k).p for k in range(records)])
    for level in (0.05, 0.2):
        count = int((p < level).sum())
        print(f"family: {count} of {records} below {level}")
        assert count <= binom.isf(1e-3, records, level)


def swinging(random: np.random.Generator, n: int, size: float, decay: float) -> Array:
    """[n]: an oscillation of 150 samples driven by noise, which forgets in `decay` of them."""
    keep = np.exp(-1.0 / decay + 2j * math.pi / 150.0)
    kick = size * math.sqrt(1.0 - abs(keep) ** 2)
    x, drift = 0j, np.zeros(n)
    for k in range(n):
        x = keep * x + kick * complex(*random.standard_normal(2))
        drift[k] = x.real
    return drift


def test_a_damped_oscillation_shows_in_slow_statistics() -> None:
    """A drift that swings is in the Allan deviation or in the slow correlation, and judged as a family stands out."""
    random = np.random.default_rng(52)
    n = 3600
    drift = swinging(random, n, 0.6, 400.0)
    found = judged(fitted(random.standard_normal(n) + drift), seed=1)
    assert found.p < 1e-3
    assert found.statistics[0].name.startswith(("allan", "innovation_lag", "innovation_means", "spectrum"))


@pytest.mark.parametrize("hidden", [False, True])
def test_the_coherence_with_a_channel_needs_no_form(hidden: bool) -> None:
    random = np.random.default_rng(53)
    n, count = 2 * SAMPLES, 0
    records = case_records(4, 100)
    for _ in range(records):
        supply = random.standard_normal(n)
        y = of_one(random, n)
        lagged, x = np.zeros(n), 0.0
        for k in range(n):  # a first-order lag of 20 samples
            x += (supply[k] - x) / 20.0
            lagged[k] = x
        y += (2.0 if hidden else 0.0) * lagged
        state = fitted(y)
        (found,) = coherence(state, record_of(state, {"supply": supply}))
        count += found.p < 5e-4
    assert count == records if hidden else count <= binom.isf(1e-3, records, 5e-4)


@pytest.mark.parametrize("n", [20, 100, 1000])
def test_the_limits_of_the_kurtosis_are_those_of_normal_numbers(n: int) -> None:
    """Truth: scipy's test of the kurtosis for single records, and the rank of 20 000 of them. The approximation leaves
    1.5 times the share of 3 standard deviations at most; a plain sqrt(24/n) leaves 3 times of it."""
    drawn = np.random.default_rng([55, n]).standard_normal((20_000, n))
    squared = (drawn - drawn.mean(axis=1)[:, None]) ** 2
    excess = (squared**2).mean(axis=1) / squared.mean(axis=1) ** 2 - 3.0
    for k in range(3):
        assert excess[k] == pytest.approx(kurtosis_at(float(kurtosistest(drawn[k]).statistic), n), abs=1e-9)
    beyond = int(((excess > kurtosis_at(3.0, n)) | (excess < kurtosis_at(-3.0, n))).sum())
    assert beyond <= binom.isf(1e-3, excess.size, 2.0 * 2.0 * norm.sf(3.0))


def test_both_budgets_are_kept() -> None:
    """Shares of axes whose readings are called wrong, and of modules that have a finding, by the tables."""
    assert round(sum(SHARES.values()), 9) <= 2e-3
    assert round(sum(OF_MODULES.values()), 9) <= 2e-2


def test_identify_and_diagnose_have_one_verdict(tmp_path: Path) -> None:
    """A record that `identify` does not call adequate is none for `diagnose`."""
    random = np.random.default_rng(54)
    records, doubted = case_records(2, 30), 0
    for _ in range(records):
        n = 3600
        drift = swinging(random, n, 0.3, 300.0)
        log = log_of(tmp_path / "swing.npz", 0.04 * (random.standard_normal(n) + drift), 1.0)
        if identify(log, suspicion=False)["axes"]["gx"]["adequate"] is False:
            doubted += 1
            axis = diagnose(log)["axes"]["gx"]
            assert axis["verdict"] == "inadequate"
            assert axis["findings"]
    assert doubted


def test_a_check_of_identify_is_a_finding() -> None:
    checks = {
        "innovation_mean": {"value": 0.1, "limit": 0.2, "passed": True},
        "allan_64s": {"value": 0.4, "limit": 0.2, "passed": False, "deviations": -5.1},
        "innovation_lag1": {"value": -0.3, "limit": 0.2, "passed": False},
    }
    assert list(against(checks)) == ["innovation_lag1", "allan_64s"]
    assert against(checks)["allan_64s"] == 5.1
    assert against(checks)["innovation_lag1"] == pytest.approx(1.5 * CHECK_LIMIT)


def result(random: np.random.Generator, look: Look | None, unfinished: str = "") -> Diagnosed:
    state = fitted(of_one(random, 400))
    findings = [] if look is None else [Finding(look, 1, state, state)]
    return Diagnosed(state, state, record_of(state), findings, unfinished=unfinished)


def test_neither_look_overrules_the_other() -> None:
    random = np.random.default_rng(55)
    sure = Look("ramp", 30.0, 30.0, {}, {"regressors": ()})
    weak = Look("ramp", NET_LEAST + 0.1, NET_LEAST + 0.1, {}, {"regressors": ()})
    none, found = result(random, None), result(random, sure)
    assert joined_looks(none, found, "stopped") is found
    assert joined_looks(found, none, "stopped") is found
    assert joined_looks(none, none, "stopped") is none
    # Two looks cost ln 2.
    assert joined_looks(none, result(random, weak), "stopped") is none
    assert joined_looks(result(random, weak), none, "stopped") is not none
    cut = result(random, None, "stopped")
    told = joined_looks(cut, found, "stopped")
    assert told is not None
    assert told.findings == found.findings
    assert told.unfinished == "every sample: stopped"
    assert joined_looks(cut, None, "stopped") is None


def test_the_allan_deviation_is_the_picture_of_its_statistic() -> None:
    state = fitted(of_one(np.random.default_rng(56), 400))
    for name, title in (
        ("allan_of_64_samples", "Allan deviation"),
        ("allan_64s", "Allan deviation"),
        ("innovation_lag5_of_16_samples", "Correlation of the residual innovations"),
    ):
        finding = Finding(look_of(Statistic(name, 1.0, 0.0, 0.0, 1e-9), 1e-9), 1, state, state)
        one = Diagnosed(state, state, record_of(state), [finding])
        _, ((figure,),) = pictures.figures(one, one.record, 1.0, "deg/s")
        assert figure.name == title


@pytest.mark.parametrize("kind", ["to zero", "less the band", "held"])
@pytest.mark.filterwarnings("error")
def test_a_dead_band_is_shown(kind: str, tmp_path: Path) -> None:
    """It is never adequate, and no number of the model file is out of its limits. Where hardly a reading moves, no law
    can be judged: the refusal says so."""
    random = np.random.default_rng([57, len(kind)])
    for _ in range(case_records(1, 12)):
        n = SAMPLES
        y = random.standard_normal(n) + 0.01 * random.standard_normal(n).cumsum()
        width = random.uniform(0.8, 3.0)
        if kind == "to zero":
            y[np.abs(y) < width] = 0.0
        elif kind == "less the band":
            y = np.sign(y) * np.maximum(np.abs(y) - width, 0.0)
        else:
            for k in range(1, n):
                if abs(y[k] - y[k - 1]) < width:
                    y[k] = y[k - 1]
        log = log_of(tmp_path / "dead.npz", 0.04 * y, 1.0)
        if kind == "held" and np.count_nonzero(np.diff(y)) < FEWEST:
            with pytest.raises(UserError, match="of its readings neither stick nor are clipped"):
                diagnose(log)
            continue
        axis = diagnose(log, write_model=tmp_path / "found.yaml")["axes"]["gx"]
        assert axis["verdict"] == "inadequate"
        Model.load(tmp_path / "found.yaml")
        (tmp_path / "found.yaml").unlink()


def test_a_model_file_takes_every_number_of_a_fit() -> None:
    assert digits(1e-40) == SMALLEST
    assert digits(-1e-40) == -SMALLEST
    assert digits(1e30) == LARGEST
    assert digits(0.0) == 0.0
    assert digits(-0.123456789) == -0.123457
