"""The batch as priors: log-normal in library and reference, the model file that `fleet` writes, and its worth.

Truth: scipy's truncated normal, the textbook bank, and the parameters that the units were drawn with.
"""

from __future__ import annotations

import math
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import integrate, stats
from test_docs import assert_alike

from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank.axis_result import HALF_90
from selfcal.bank.library import Bank
from selfcal.bank.reference import reference_axis
from selfcal.base.errors import UserError
from selfcal.logs.recording import save
from selfcal.model.file import DEFAULT, Model, Prior
from selfcal.model.tables import make_tables
from selfcal.verbs.fleet import fleet
from selfcal.verbs.identify import identify

from conftest import COMMAND, ROOT, case_records, worst_difference

MODEL = Model.load()
GROUP = MODEL.group_of("gx")


def with_priors(**priors: Prior) -> Model:
    """The default model with other priors of gx."""
    groups = tuple(replace(one, own_priors={"gx": priors}) if one is MODEL.groups[0] else one for one in MODEL.groups)
    return replace(MODEL, groups=groups)


def test_a_log_normal_prior_is_what_it_says() -> None:
    """Density, quantiles and limits by scipy's truncated normal."""
    prior = Prior.log_normal(2e-3, 0.3)
    of = stats.truncnorm(-4.0, 4.0, loc=math.log(2e-3), scale=0.3)
    x = np.linspace(math.log(prior.min), math.log(prior.max), 41)[1:-1]
    assert prior.ln_density(x) == pytest.approx(of.logpdf(x), abs=1e-9)
    assert [math.log(prior.at(u)) for u in (1e-6, 0.05, 0.5, 0.9)] == pytest.approx(of.ppf([1e-6, 0.05, 0.5, 0.9]))
    for other in (Prior("uniform", 0.2, 0.7), Prior("log_uniform", 0.2, 0.7), prior):
        low, high = math.log(other.min), math.log(other.max)
        total = integrate.quad(lambda x, other=other: math.exp(other.ln_density(np.array([x]))[0]), low, high)[0]
        assert total == pytest.approx(1.0, abs=1e-8)


#: Priors from narrow to wide beside what a short record says, of the walk and of the Gauss-Markov drift.
PRIORS = [
    {"N": Prior.log_normal(0.02, 0.05), "K": Prior.log_normal(2e-3, 0.15)},
    {"N": Prior.log_normal(0.03, 0.02), "K": Prior.log_normal(1e-3, 0.6)},
    {
        "N": Prior.log_normal(0.02, 0.1),
        "sigma_m": Prior.log_normal(0.02, 0.25),
        "alpha": Prior.log_normal(0.02, 0.3),
    },
    {"K": Prior.log_normal(2e-3, 0.3)},
    {"sigma_m": Prior.log_normal(0.03, 1.2), "alpha": Prior.log_normal(0.01, 0.8)},
]


@pytest.mark.parametrize("priors", PRIORS)
def test_library_and_reference_agree_on_log_normal_priors(priors: dict[str, Prior]) -> None:
    """The report's tolerances: evidence 0.05 nat, a probability a quarter of it, mean 0.05 sd, sd 3 %; a quantile the
    same 0.05 sd, of an interval of 3.3. The reference integrates the density itself."""
    model = with_priors(**priors)
    group = model.group_of("gx")
    law = "gauss_markov" if "alpha" in priors else "random_walk"
    tables = make_tables(model, 1.0, ("gx",))
    for n in case_records((60, 400), (40, 60, 120, 400, 1500)):
        for seed in range(case_records(1, 5)):
            truth = draw_parameters(group, law, np.random.default_rng([n, seed, len(priors)]))
            y, _ = simulate_bank_samples(law, truth, 1.0, n, seed)
            y = y.astype(np.float32).astype(np.float64)
            bank = Bank(tables)
            bank.push(y[:, None])
            ours, theirs = bank.report(0), reference_axis(y, 1.0, group, MODEL.hypotheses)
            evidence, probability, mean, sd = worst_difference(ours, theirs)
            assert evidence <= 0.05 and probability <= 0.0125 and mean <= 0.05 and sd <= 0.03, (n, seed)
            likeliest = max(theirs.probability, key=lambda name: theirs.probability[name])
            for parameter, other in theirs.parameters[likeliest].items():
                for key in ("q05", "median", "q95"):
                    one = getattr(ours.parameters[likeliest][parameter], key)
                    assert one == pytest.approx(getattr(other, key), abs=0.02 * (other.q95 - other.q05)), (n, seed, key)
            assert ours.bias_mean == pytest.approx(theirs.bias_mean, abs=0.05 * theirs.bias_sd)
            assert ours.bias_sd == pytest.approx(theirs.bias_sd, rel=0.03)


#: The parts: medians, and sd of ln between them.
PARTS = {"N": (0.02, 0.06), "K": (1.5e-3, 0.2)}


def a_unit(
    random: np.random.Generator, samples: int, factor: float = 1.0
) -> tuple[np.ndarray, float, dict[str, float]]:
    """A random walk's readings [samples] at 1 Hz, the bias at the last, and the truth; K times `factor`."""
    truth = {name: median * math.exp(sd * random.standard_normal()) for name, (median, sd) in PARTS.items()}
    truth["K"] *= factor
    drift = 0.3 * random.standard_normal() + np.cumsum(truth["K"] * random.standard_normal(samples))
    return drift + truth["N"] * random.standard_normal(samples), float(drift[-1]), truth


def batch_file(folder: Path, units: int, seed: int, lots: dict[str, float] | None = None) -> Path:
    """The model file of a batch of recordings of an hour, in lots with their factor on K."""
    random, rows, names = np.random.default_rng(seed), ["file,device,lot"], list(lots or {"": 1.0})
    (folder / "b").mkdir(parents=True)
    for k in range(units):
        lot = names[k % len(names)]
        y, _, _ = a_unit(random, 3600, (lots or {}).get(lot, 1.0))
        save(folder / f"b/u{k:03}.npz", {"gx": ("deg/s", y)}, 1.0)
        rows.append(f"u{k:03}.npz,d{k:03},{lot}")
    (folder / "units.csv").write_text("\n".join(rows))
    place = folder / "batch.yaml"
    fleet([str(folder / "b/*.npz")], folder / "t.csv", units_table=folder / "units.csv", write_model=place)
    return place


def held(model: Model, lengths: tuple[int, ...], units: int, seed: int) -> dict[tuple[str, int], tuple[float, float]]:
    """By quantity and length: share of the 90 % intervals of a module that hold the truth, and rms error."""
    tables = make_tables(model, 1.0, ("gx",), "cortex-m4f")
    random = np.random.default_rng(seed)
    found: dict[tuple[str, int], list[tuple[bool, float]]] = {}
    for _ in range(units):
        for length in lengths:
            y, bias, truth = a_unit(random, length)
            bank = Bank(tables, build="_coarse")
            bank.push(y[:, None])
            report = bank.report(0)
            error = report.bias_mean - bias
            found.setdefault(("bias", length), []).append((abs(error) <= HALF_90 * report.bias_sd, error))
            for name, value in truth.items():
                e = report.parameters["random_walk"][name]
                found.setdefault((name, length), []).append((e.q05 <= value <= e.q95, math.log(e.median / value)))
    return {
        key: (float(np.mean([one for one, _ in rows])), float(np.sqrt(np.mean([error**2 for _, error in rows]))))
        for key, rows in found.items()
    }


def test_a_module_that_begins_with_the_batch_knows_more(tmp_path: Path) -> None:
    """New units after 1 and 5 minutes, by the module's report: its intervals are honest, K is known many times better
    and the bias no worse than by the default model. Of few units three standard deviations of the count."""
    units, new = case_records((24, 60), (40, 600))
    place = batch_file(tmp_path, units, 11)
    batch, default = held(Model.load(place), (60, 300), new, 12), held(MODEL, (60, 300), new, 12)
    off = max(0.045, 3.0 * math.sqrt(0.09 / new))
    for key, (share, error) in batch.items():
        print(f"{key}: batch {share:.3f} {error:.3g}, default {default[key][0]:.3f} {default[key][1]:.3g}")
    for key, (share, error) in batch.items():
        assert 0.9 - off <= share <= 0.9 + off or key[0] != "bias", (key, share)
        assert share >= 0.9 - off, (key, share)
        assert error <= 1.02 * default[key][1], key
    assert batch["K", 60][1] < 0.3 * default["K", 60][1]


def test_the_printed_example(tmp_path: Path) -> None:
    """The batch of tools/pages/fleet.md, by its own code: the command prints the lines of the page, wrapped."""
    text = (ROOT / "tools" / "pages" / "fleet.md").read_text(encoding="utf-8").partition("## The population")[2]
    made, command, printed = (text.split("```python\n")[1].split("```")[0], *text.split("\n\n    ")[1:3])
    if not case_records(0, 1):
        pytest.skip("SLOW: make cases")
    (tmp_path / "make.py").write_text(made)
    subprocess.run([sys.executable, "make.py"], cwd=tmp_path, check=True)
    words = [*COMMAND, *shlex.split(command.removeprefix(".venv/bin/selfcal "))]
    found = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=1800)
    print(found.stdout)
    assert_alike(printed.split("\n\n")[0], found.stdout)


@pytest.mark.parametrize("factor", [1.0, 0.35, 4.0])
def test_a_part_unlike_the_batch_is_not_adequate(tmp_path: Path, factor: float) -> None:
    """K of the batch, and times 0.35 and 4: 5 and 7 sd of its spread. Beside wide priors another law takes the drift.
    A part of the batch is beyond the limit once in 1000; of those far off one in four may hide behind its interval."""
    tree, place = yaml.safe_load(DEFAULT.read_text()), tmp_path / "batch.yaml"
    priors = {name: {"law": "log_normal", "median": median, "sd": sd} for name, (median, sd) in PARTS.items()}
    tree["groups"]["gyro"]["own_priors"] = {"gx": priors}
    place.write_text(yaml.safe_dump(tree))
    few = case_records(4, 100)
    random, passed = np.random.default_rng(91), 0
    for k in range(few):
        y, _, _ = a_unit(random, 3600, factor)
        save(tmp_path / f"{k}.npz", {"gx": ("deg/s", y)}, 1.0)
        passed += identify(tmp_path / f"{k}.npz", model=place)["axes"]["gx"]["checks"]["batch"]["passed"]
    assert passed >= 0.97 * few if factor == 1.0 else passed <= 0.25 * few


def own(place: Path) -> dict[str, dict[str, Any]]:
    """The written priors of gx."""
    priors: dict[str, dict[str, Any]] = yaml.safe_load(place.read_text())["groups"]["gyro"]["own_priors"]["gx"]
    return priors


def test_the_written_priors_are_the_batch_s(tmp_path: Path) -> None:
    """Medians within 4 standard errors, a spread within a factor of two; a walk's odds on one axis of six.

    A batch that is identified by them has the same population: a prior is no second measurement."""
    place = batch_file(tmp_path, 30, 21)
    for name, (median, sd) in PARTS.items():
        found = own(place)[name]
        assert found["law"] == "log_normal" and 0.5 < found["sd"] / math.hypot(sd, 0.02) < 2.0
        assert abs(math.log(found["median"] / median)) < 4.0 * math.hypot(sd, 0.1) / math.sqrt(30)
    odds = yaml.safe_load(place.read_text())["hypotheses"]
    shares = {"constant": 1.0 / 33.0, "random_walk": 31.0 / 33.0, "gauss_markov": 1.0 / 33.0}  # but for doubts
    assert odds == pytest.approx({law: (share + 5.0 / 3.0) / 6.0 for law, share in shares.items()}, abs=0.05)
    again = tmp_path / "again.yaml"
    fleet([str(tmp_path / "b/*.npz")], tmp_path / "t.csv", model=place, write_model=again)
    for name, found in own(again).items():
        assert found["median"] == pytest.approx(own(place)[name]["median"], rel=0.02)
        assert found["sd"] == pytest.approx(own(place)[name]["sd"], rel=0.15)


def test_a_lot_that_is_apart_widens_the_prior(tmp_path: Path) -> None:
    """A new unit may be of any lot: K doubles in one of three, which is a sd of 0.33 of ln. A third of them fixes it
    within 0.1."""
    found = own(batch_file(tmp_path, 36, 22, {"A": 1.0, "B": 1.0, "C": 2.0}))
    spread = math.hypot(PARTS["K"][1], math.log(2.0) * math.sqrt(2.0) / 3.0)
    assert found["K"]["sd"] == pytest.approx(spread, abs=0.1)
    assert found["K"]["median"] == pytest.approx(PARTS["K"][0] * 2.0 ** (1.0 / 3.0), rel=0.15)
    assert found["N"]["sd"] < 0.15


def test_what_is_no_prior(tmp_path: Path) -> None:
    stated = "K: {law: log_uniform, min: 2.0e-5, max: 2.0e-2}"
    place = tmp_path / "m.yaml"
    for given, words in (
        ("K: {law: log_normal, median: 1.0e-3}", "'sd' is missing"),
        ("K: {law: log_normal, median: 1.0e-3, sd: 9.0}", "must be 0.0001 to 5, not 9"),
        ("K: {law: log_normal, median: 1.0e-3, sd: 0.1, max: 1.0}", "unknown entry 'max' (known: law, median, sd)"),
        ("K: {law: log_normal, median: 1.0e-19, sd: 2.0}", "min and max must differ, within"),
        ("K: {law: log_uniform, min: 2.0e-5, max: 2.0e-2, sd: 1.0}", "unknown entry 'sd' (known: law, min, max)"),
        ("K: {law: gamma, min: 2.0e-5, max: 2.0e-2}", "(log_uniform, uniform or log_normal)"),
    ):
        place.write_text(DEFAULT.read_text().replace(stated, given, 1))
        with pytest.raises(UserError) as caught:
            Model.load(place)
        assert words in str(caught.value), given
    (tmp_path / "b").mkdir()
    save(tmp_path / "b/one.npz", {"gx": ("deg/s", np.random.default_rng(1).standard_normal(500))}, 1.0)
    with pytest.raises(UserError, match="no parameter has a population: it takes five units"):
        fleet([str(tmp_path / "b/*")], tmp_path / "t.csv", write_model=tmp_path / "batch.yaml")
    assert not (tmp_path / "batch.yaml").exists()
