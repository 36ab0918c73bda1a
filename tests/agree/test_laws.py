"""Laws that a model file states by their terms, models/terms.yaml: no code names them.

Truth: the textbook bank at equal nodes, which reads the terms for itself (host_sim/textbook_bank.cpp), dense nodes in
double for reports, and the closed covariance of the record for the textbook.
"""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import stats

from selfcal import _reference
from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.model.file import DEFAULT, Model
from selfcal.model.laws import NAMED

from agreement import (
    REPORT_LIMIT,
    assert_prediction_is_that_of_a_gap,
    compare,
    hold,
    push,
    report_differences,
    tables_of,
)
from conftest import run

MODEL = Model.load(DEFAULT.with_name("terms.yaml"))
GROUP = MODEL.group_of("gx")
OWN = [name for name in MODEL.hypotheses if name not in NAMED]


def a_record(law: str, n: int, seed: int) -> np.ndarray:
    """[n] bank samples of a law, its parameters from the prior, as float32 holds them."""
    truth = draw_parameters(GROUP, law, np.random.default_rng([n, seed]))
    y, _ = simulate_bank_samples(MODEL.laws[law], truth, 1.0, n, seed=seed)
    return y.astype(np.float32).astype(np.float64)


def covariance(law: str, parameters: dict[str, float], n: int) -> np.ndarray:
    """Of the record [n, n] at intervals of 1 s, without the bias: each term's, and the noise's, written out."""
    of = MODEL.laws[law]
    i = np.arange(1.0, n + 1.0)
    lag = np.abs(np.subtract.outer(i, i))
    drift, second = of.node(parameters)
    total = np.zeros((n, n))
    for term in of.terms:
        if term.kind == "walk":
            total += (term.deviation * drift) ** 2 * np.minimum.outer(i, i)
        else:
            rate = term.bandwidth if term.stated else term.bandwidth * second
            sigma = term.deviation * drift * (second if term.by_ratio else 1.0)
            total += (sigma / math.sqrt(rate) if of.has_walk else sigma) ** 2 * np.exp(-rate * lag)
    if of.coloured_noise:
        theta = (second - 1.0) / (second + 1.0)
        mixing = (np.eye(n, n + 1, 1) + theta * np.eye(n, n + 1)) / (1.0 + theta)
        return total + parameters["N"] ** 2 * mixing @ mixing.T
    return total + parameters["N"] ** 2 * np.eye(n)


@pytest.mark.parametrize("law", OWN)
def test_the_textbook_reads_the_terms(law: str) -> None:
    """ln p of a record against the normal density with the covariance of the law's definition: 1e-8, double rounding
    through 40 samples."""
    truth = draw_parameters(GROUP, law, np.random.default_rng([40, 3]))
    y = a_record(law, 40, 3)
    y -= y.mean()  # a bias of many P0 would cost digits
    drift, second = MODEL.laws[law].node(truth)
    node = (np.array([drift]), np.array([second]), np.array([truth["N"]]))
    ln_p, _, _ = _reference.run_filters(y, 1.0, 0.0, 1.0, [MODEL.laws[law].as_tuple], np.zeros(1, np.int32), *node)
    expected = stats.multivariate_normal(np.zeros(40), covariance(law, truth, 40) + 1.0).logpdf(y)
    assert ln_p[0] == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("n", [10, 300, 3000])
def test_parity_with_the_textbook_bank(n: int, gaps: bool) -> None:
    """All laws of the file in one bank, on a record of each: the tolerances of every law (agreement.py)."""
    made = tables_of(MODEL, "cortex-m0")
    records = [a_record(law, n, 7) for law in OWN]
    if gaps:
        for y in records:
            y[n // 3 : n // 3 + max(1, n // 10)] = np.nan
    every = 1 if n < 1000 else 3  # nodes: the textbook is slow
    found = [compare(y, made, None, builds=("double", "float", "fixed"), sigmas=5, every=every) for y in records]
    hold(f"n={n} gaps={gaps}", found)


@pytest.mark.parametrize("law", OWN)
def test_report_against_dense_nodes(law: str) -> None:
    """The model file's nodes against so many that theirs no longer counts: the design's tolerances of a report, for
    three records in four (one may lie where the drift hides the white noise: test_sums.py)."""
    made = tables_of(MODEL, only=law)
    records = [a_record(truth, n, seed) for truth in (law, "random_walk") for n in (100, 1000) for seed in range(2)]
    values = np.array([report_differences(y, made)[0] for y in records])
    worst = values.max(axis=0)
    print(f"\n{law}: worst d ln evidence {worst[0]:.3f}, mean {worst[1]:.3f} sd, sd {100 * worst[2]:.1f} %")
    assert (values <= REPORT_LIMIT).all(axis=1).mean() >= 0.75


@pytest.mark.parametrize("law", OWN)
def test_prediction_is_that_of_a_gap(law: str) -> None:
    """As in test_sums.py: the closed form of each term's decay against the filters through a gap."""
    made = tables_of(MODEL, only=law)
    y = a_record(law, 300, 5)
    assert_prediction_is_that_of_a_gap(made, y, None, [1, 10, 100, 3000])


def test_a_plain_law_stated_by_its_terms_is_the_named_one() -> None:
    """A Gauss-Markov term stated in the file takes the same filters: the same evidence, bit for bit."""
    y = a_record("gauss_markov", 500, 1)
    made = tables_of(MODEL, only="gauss_markov")
    found = []
    for name in ("gauss_markov", "mine"):
        bank = Bank(replace(made, hypotheses=(replace(made.hypotheses[0], name=name),)))
        push(bank, y)
        found.append(bank.report(0).log_evidence[name])
    assert found[0] == found[1]


def test_two_stated_times_of_one_law_are_told_apart() -> None:
    """A drift of 20 s over 2000 s: the hypothesis with that time has nearly all of the probability of the two."""
    y, _ = simulate_bank_samples(MODEL.laws["markov_20s"], {"N": 0.02, "sigma_m": 0.02}, 1.0, 2000, seed=4)
    bank = Bank(tables_of(MODEL))
    push(bank, y)
    found = bank.report(0).probability
    assert found["markov_20s"] > 100.0 * found["markov_350s"]


def test_the_tools_take_the_file(tmp_path: Path) -> None:
    """`simulate` draws a law of terms, `identify` names it, and the textbook engine agrees on its evidence."""
    model = tmp_path / "model.yaml"
    text = MODEL.path.read_text().replace(
        "axes: {}", "axes: {gx: {hypothesis: two_markov, N: 0.02, sigma_m: 0.05, alpha: 0.01}}"
    )
    model.write_text(text.replace("duration_s: 3600.0", "duration_s: 600.0").replace("[gx, gy, gz]", "[gx]"))
    log = tmp_path / "log.csv"
    assert run("simulate", model, "-o", log).returncode == 0
    answers = {}
    for engine in ("library", "reference"):
        out = run("identify", log, "--model", model, "--engine", engine, "--json", "-")
        assert out.returncode == 0, out.stderr
        answers[engine] = json.loads(out.stdout)["axes"]["gx"]
    assert set(answers["library"]["hypotheses"]) == set(MODEL.hypotheses)
    assert list(answers["library"]["parameters"]["markov_20s"]) == ["N", "sigma_m"]
    for law in ("two_markov", "markov_20s", "walk_two_markov"):
        difference = answers["library"]["log_evidence"][law] - answers["reference"]["log_evidence"][law]
        assert abs(difference) <= 0.05, law


#: Pieces of terms.yaml.
TWO = "terms: [markov, {kind: markov, bandwidth: 17.5}]"
SLOW = "[{kind: markov, correlation_time_s: 20.0}]"


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            TWO,
            "terms: [drift]",
            r"two_markov\.terms\[0\]: must be walk, markov",
        ),
        ("bandwidth: 17.5", "bandwidth: 1e4", r"terms\[1\]\.bandwidth: must be 0\.001 to 1000"),
        ("bandwidth: 17.5", "bandwidth: 2, correlation_time_s: 3", "not both"),
        ("bandwidth: 17.5", "deviation: ratio", "has more than one of"),
        (TWO, "terms: [walk, walk, walk, walk]", "3 are the most"),
        (
            SLOW,
            "[{kind: markov, correlation_time_s: 20.0, deviation: ratio}]",
            "a ratio needs",
        ),
        (
            SLOW,
            "[{kind: markov, correlation_time_s: 1e9}]",
            "must be from 0.145 to",
        ),
        ("  two_markov:  ", "  two markov:  ", "a name is of letters"),
        (
            "two_markov: [24, 20], walk",
            "two_markov: 24, walk",
            r"nodes\.host\.two_markov: must be \[rho nodes, alpha nodes\]",
        ),
        ("markov_20s: 24,", "markov_20s: [24, 20],", r"nodes\.host\.markov_20s: must be a number of rho nodes"),
    ],
)
def test_a_wrong_law_gets_one_clear_line(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    path = tmp_path / "model.yaml"
    text = MODEL.path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UserError, match=complaint):
        tables_of(Model.load(path))


#: Nodes of a law of two terms beside a random walk: what each target has room for.
SMALL = {"host": [24, 20], "cortex-m4f": [16, 12], "cortex-m0": [12, 8]}


@pytest.mark.parametrize("target", SMALL)
def test_a_module_runs_a_law_of_terms(tmp_path: Path, target: str) -> None:
    """Recording, model file, firmware: what its telemetry says of the law is what `identify` says on the same nodes,
    within the design's tolerances of a report (0.05 nat, 0.05 sd; a probability near 1 moves by less than 1e-3)."""
    tree = yaml.safe_load(MODEL.path.read_text())
    tree["groups"]["gyro"]["axes"] = ["gx"]
    tree["hypotheses"] = {"random_walk": 1, "two_markov": tree["hypotheses"]["two_markov"]}
    tree["nodes"] = {name: {"random_walk": 8, "two_markov": SMALL[target]} for name in ("host", target)}
    tree["simulate"] = {
        "rate_hz": 1.0,
        "duration_s": 600.0,
        "axes": {"gx": {"hypothesis": "two_markov", "N": 0.02, "sigma_m": 0.05, "alpha": 0.01, "bias": 0.3}},
    }
    model, log = tmp_path / "model.yaml", tmp_path / "log.csv"
    model.write_text(yaml.safe_dump(tree))
    assert run("simulate", model, "-o", log, "--seed", "3").returncode == 0
    answers = []
    for verb in (("identify",), ("replay", "--target", target)):
        out = run(*verb[:1], log, "--model", model, *verb[1:], "--json", "-")
        assert out.returncode == 0, out.stderr
        answers.append(json.loads(out.stdout)["axes"]["gx"])
    host, module = answers
    assert module["hypotheses"]["two_markov"] == pytest.approx(host["hypotheses"]["two_markov"], abs=1e-3)
    assert module["log_evidence"]["two_markov"] == pytest.approx(host["log_evidence"]["two_markov"], abs=0.05)
    for name, mine in module["parameters"]["two_markov"].items():
        theirs = host["parameters"]["two_markov"][name]
        assert mine["mean"] == pytest.approx(theirs["mean"], abs=0.05 * theirs["sd"]), name
