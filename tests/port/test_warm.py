"""The warm start (tools/selfcal/diagnosis/warm.py): the prior of a diagnosis, in the library and in the firmware.

Truth: the dense Gaussian density of a record under the stated prior; records whose truth is drawn from that prior; and
a simulated part. The figures of tests/ACCURACY.md come from tests/warm_start.py, whose campaign is run here with few
records.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import stats
from warm_start import LAW, PART, both, campaign, diagnosed, law_known

from selfcal.bank.axis_result import HALF_90
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.diagnosis.warm import PRIOR_REACH, RUN_TO_RUN, RUN_TO_RUN_COEFFICIENT, WIDENED, load_start, warmed
from selfcal.logs.recording import load as load_recording
from selfcal.model.file import DEFAULT, Model
from selfcal.model.regressors import columns_of
from selfcal.model.tables import make_tables
from selfcal.verbs.codegen import codegen
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate
from selfcal.wire.known_models import KnownModels

Files = tuple[Path, Path]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """The extended model and the diagnosis of a simulated part."""
    return diagnosed(tmp_path_factory.mktemp("part"), seed=1)


def test_the_prior_is_the_posterior_widened(files: Files) -> None:
    """Limits and sd by hand from the document; what was not identified stays. A law without probability takes N from
    the likeliest one, and keeps the rest."""
    model = Model.load(files[0])
    posterior = json.loads(files[1].read_text())["axes"]["gx"]["posterior"]
    tables = both(*files)
    likeliest = max(posterior["hypotheses"], key=posterior["hypotheses"].get)
    for h, cold in zip(tables["warm"].hypotheses, tables["cold"].hypotheses, strict=True):
        for place, name in enumerate(("N", "K")):
            excluded = posterior["hypotheses"][h.name] < 0.01
            told = posterior["parameters"][likeliest if excluded and name == "N" else h.name].get(name)
            low, high, uniform, measured = h.priors[0][place]
            assert not uniform
            if told is None or not told["identified"] or (excluded and name != "N"):
                assert (low, high) == (tables["cold"].axes[0].ln_min[place], tables["cold"].axes[0].ln_max[place])
                assert not measured
                continue
            sd = math.hypot(math.log(told["q95"] / told["q05"]) / (2.0 * HALF_90), RUN_TO_RUN[name])
            assert measured
            assert (low, high) == pytest.approx(
                (math.log(told["median"]) - PRIOR_REACH * sd, math.log(told["median"]) + PRIOR_REACH * sd)
            )
        assert (h.rho, h.alpha, h.ln_probability) == (cold.rho, cold.alpha, cold.ln_probability)
    one = posterior["regressors"]["temperature"]["coefficients"]["temperature"]
    (column,) = tables["warm"].regressors
    assert column.coefficient_mean == (pytest.approx(one["mean"]),)
    assert column.coefficient_sd == (
        pytest.approx(WIDENED * math.hypot(one["sd"], RUN_TO_RUN_COEFFICIENT * one["mean"])),
    )
    # the truth of the part lies within, by 4 sd of what is expected
    (row,) = law_known(tables["warm"]).hypotheses[0].priors
    for place, name in enumerate(("N", "K")):
        assert row[place][0] < math.log(PART[name]) < row[place][1]
    assert abs(column.coefficient_mean[0] - PART["coefficient"]) < 4.0 * column.coefficient_sd[0]
    # axes that were not diagnosed keep the model's priors
    all_axes = warmed(make_tables(model, 1.0), load_start(files[1], model))
    assert all_axes.regressors[0].coefficient_mean[1:] == (0.0,) * 5
    assert all_axes.hypotheses[0].priors[1][0][3] is False


def test_the_likelihood_is_that_of_the_dense_density(files: Files) -> None:
    """Constant law, one node: y ~ N(m (z - z_r), P0 11' + s^2 (z - z_r)(z - z_r)' + sigma^2 I). A float32 bank's sums
    of 50 samples: 1e-3 nat. Without the mean the density differs by 0.1 nat and more."""
    tables = both(*files)["warm"]
    tables = replace(tables, hypotheses=(replace(tables.hypotheses[0], ln_probability=0.0),))
    assert tables.hypotheses[0].rho is None
    (column,), n, sigma = tables.regressors, 50, 0.04
    rng = np.random.default_rng(2)
    for first, slope in ((0.0, 0.02), (7.0, 0.1), (-5.0, 0.0)):  # the last one a constant temperature
        z = np.float32(column.reference + first + slope * np.arange(n))
        y = np.float32(3.0 + 0.07 * (z - column.reference) + sigma * rng.standard_normal(n))
        bank = Bank(tables)
        bank.push(y[:, None], None, z[:, None])
        centred = z.astype(float) - column.reference
        covariance = tables.axes[0].bias_sd ** 2 + column.coefficient_sd[0] ** 2 * np.outer(centred, centred)
        covariance += sigma**2 * np.eye(n)
        dense = stats.multivariate_normal(column.coefficient_mean[0] * centred, covariance)
        assert bank.raw.log_likelihood_subset(0, 0, 1, sigma) == pytest.approx(dense.logpdf(y.astype(float)), abs=1e-3)
        if slope > 0.05:
            none = stats.multivariate_normal(0.0 * centred, covariance)
            assert abs(none.logpdf(y.astype(float)) - dense.logpdf(y.astype(float))) > 0.1


def test_intervals_hold_the_truth_as_often_as_they_say(files: Files) -> None:
    """N, K and coefficient drawn from the warm prior: 400 rests of 300 samples, one set of seeds. The bounds are the
    central 99.8 % of the binomial law of 400 and 0.9: 0.85 to 0.94."""
    found = campaign({"warm": law_known(both(*files)["warm"])}, 300, 400, 1, "prior")["warm"]["held"]
    low, high = (bound / 400 for bound in stats.binom(400, 0.9).ppf([0.001, 0.999]))
    print(f"\n90 % intervals hold {found} of 400 truths ({low:.3f} to {high:.3f})")
    assert all(low <= share <= high for share in found.values())


def test_a_warm_start_gains_at_once(files: Files) -> None:
    """The same part again, 60 samples after the start: the corrected output 300 s later errs by a third of the cold
    one's error (tests/ACCURACY.md: a quarter); K and the coefficient are narrower, N no wider. 60 rests."""
    found = campaign(both(*files), 60, 60, 1, "same")
    cold, warm = found["cold"], found["warm"]
    assert warm["error"] < cold["error"] / 3.0
    assert warm["sd"]["K"] < 0.5 * cold["sd"]["K"]
    assert warm["sd"]["coefficient"] < 0.5 * cold["sd"]["coefficient"]
    assert warm["sd"]["N"] < 1.05 * cold["sd"]["N"]
    assert warm["used"] > 0.95 > cold["used"]


def test_a_record_that_no_law_explains_without_its_regressor(tmp_path: Path) -> None:
    """The bias follows the temperature late, so far that under the measured priors no law has evidence without it: the
    module starts from its own record's diagnosis, and has the coefficient and N that were simulated. 4 sd, and 2 %
    for the lag, which the module takes as known."""
    tree, model, known = yaml.safe_load(DEFAULT.read_text(encoding="utf-8")), tmp_path / "m.yaml", tmp_path / "d.json"
    tree["simulate"] = {
        "rate_hz": 2.0,
        "duration_s": 1500.0,
        "axes": {"gy": {"hypothesis": "random_walk", "N": 0.03, "K": 1e-3}},
    }
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(tree), encoding="utf-8")
    simulate(tmp_path / "base.yaml", log := tmp_path / "log.npz", 7, ["temperature:axis=gy,coefficient=-0.7,lag_s=150"])
    diagnose(log, axes=["gy"], model=tmp_path / "base.yaml", decimate=1.0, json=known, write_model=model)
    axis = replay(log, axes=["gy"], model=model, start=known, report_every=500.0)["axes"]["gy"]
    (regressor,) = axis["regressors"].values()
    (coefficient,) = regressor["coefficients"].values()
    assert regressor["probability"] > 0.99 and axis["module_reason"] is None
    N = axis["parameters"]["random_walk"]["N"]
    for found, truth in ((coefficient, -0.7), (N, 0.03)):
        assert abs(found["median"] - truth) < 4.0 * math.hypot(found["sd"], 0.02 * truth)


@pytest.fixture(scope="module")
def short(files: Files, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five minutes of the part."""
    folder = tmp_path_factory.mktemp("short")
    text = files[0].read_text().replace("duration_s: 7200.0", "duration_s: 300.0")
    (folder / "short.yaml").write_text(text)
    simulate(folder / "short.yaml", folder / "short.npz", seed=8)
    return folder / "short.npz"


@pytest.mark.parametrize("target", ["host", "cortex-m4f"])
def test_the_firmware_starts_warm(target: str, files: Files, short: Path) -> None:
    """The last report of the image against the library with the same prior: medians within 0.05 sd, sd to 3 %, for a
    module's report integrates more coarsely. The axis counts as identified; from a cold start it does not."""
    model = Model.load(files[0])
    recording = load_recording(short)
    tables = warmed(make_tables(model, recording.rate_hz, ("gx",)), load_start(files[1], model))
    bank = Bank(tables)
    samples = recording.in_unit("gx", "deg/s").astype(np.float32)
    bank.push(samples[:, None], recording.missing_before, columns_of(model.regressors, recording))
    truth = bank.report(0, 1)
    axis = replay(short, axes=["gx"], model=files[0], start=files[1], target=target)["axes"]["gx"]
    for name, want in truth.parameters[LAW].items():
        got = axis["parameters"][LAW][name]
        assert got["median"] == pytest.approx(want.median, abs=0.05 * want.sd)
        assert got["sd"] == pytest.approx(want.sd, rel=0.03)
        assert got["identified"]
    assert axis["regressors"]["temperature"]["probability"] > 0.99
    assert axis["module_reason"] is None
    if target == "host":
        cold = replay(short, axes=["gx"], model=files[0], target=target)["axes"]["gx"]
        assert cold["module_reason"] == "not_identified"


def test_the_header_names_the_data(files: Files, tmp_path: Path) -> None:
    """And the tables are of another id, which `monitor --from` knows."""
    warm = codegen(files[0], tmp_path / "warm", start=files[1])
    cold = codegen(files[0], tmp_path / "cold")
    assert "Priors of gx from rest.npz, 7200 s" in (tmp_path / "warm" / "selfcal_model.h").read_text()
    assert "Priors of" not in (tmp_path / "cold" / "selfcal_model.h").read_text()
    assert warm.id != cold.id
    status = {"model_id": float(warm.id), "bank_interval": warm.dt_s, "bank_block": float(warm.block)}
    assert KnownModels(files[0], files[1]).names(status).known
    assert not KnownModels(files[0]).names(status).known
    with pytest.raises(UserError, match="--from goes with --model"):
        KnownModels(None, files[1])


def at(document: dict[str, Any], *keys: str) -> dict[str, Any]:
    """The entry of some keys."""
    for key in keys:
        document = document[key]
    return document


OF_N = ("axes", "gx", "posterior", "parameters", LAW, "N")
OF_COLUMN = ("axes", "gx", "posterior", "regressors", "temperature")


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda d: d.update(schema="selfcal.identify/1"), "not a diagnosis: schema 'selfcal.identify/1'"),
        (lambda d: d.pop("schema"), "not a diagnosis: no schema"),
        (lambda d: d.pop("model"), "model: must be a mapping"),
        (lambda d: d["model"].update(bank_rate_hz=2.0), "is of another model than"),
        (lambda d: d["model"].update(groups=7), "groups: must be a mapping"),
        (lambda d: d["recording"].update(path="a\nb"), "recording.path: must be the name of a file"),
        (lambda d: d["recording"].update(duration_s=-1), "recording.duration_s: must be a finite number above 0"),
        (lambda d: d.update(axes=[]), "axes: must be a mapping"),
        (lambda d: d["axes"].update(wz=d["axes"]["gx"]), "axes: the model has no axis 'wz'"),
        (lambda d: d["axes"]["gx"].update(unit="m/s^2"), "axes.gx.unit: "),
        (lambda d: d["axes"]["gx"].update(posterior=None), "has no posterior of any axis"),
        (lambda d: at(d, "axes", "gx", "posterior", "parameters").pop(LAW), "must have the laws"),
        (lambda d: at(d, *OF_N[:-1]).pop("K"), "must have N, K"),
        (lambda d: at(d, *OF_N).update(median=math.nan), "N.median: must be a finite number above 0, not nan"),
        (lambda d: at(d, *OF_N).update(q05=None), "N.q05: must be a finite number above 0, not None"),
        (lambda d: at(d, *OF_N).update(q95=True), "N.q95: must be a finite number above 0, not True"),
        (lambda d: at(d, *OF_N).update(q05=1.0), "q05, median and q95 must ascend"),
        (lambda d: at(d, *OF_N).update(q05=8.0, median=9.0, q95=10.0), "lies outside the model's prior"),
        (lambda d: at(d, *OF_COLUMN).update(probability=2.0), "probability: must be 0 to 1"),
        (
            lambda d: at(d, *OF_COLUMN, "coefficients", "temperature").update(sd=0.0),
            "sd: must be a finite number above 0",
        ),
        (lambda d: at(d, *OF_COLUMN[:-1]).update(supply={}), "must be a mapping of the model's regressors"),
    ],
)
def test_another_file_is_refused_in_one_line(
    spoil: Callable[[dict[str, Any]], object], said: str, files: Files, tmp_path: Path
) -> None:
    document = json.loads(files[1].read_text())
    spoil(document)
    (tmp_path / "bad.json").write_text(json.dumps(document))
    with pytest.raises(UserError) as error:
        codegen(files[0], tmp_path / "tables", start=tmp_path / "bad.json")
    assert said in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "bad.json"))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "tables").exists()


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b'{"schema": ' + b"9" * 5000 + b"}"])
def test_what_is_no_json_is_refused_in_one_line(text: bytes, files: Files, tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_bytes(text)
    with pytest.raises(UserError, match="not a diagnosis") as error:
        load_start(tmp_path / "bad.json", Model.load(files[0]))
    assert "\n" not in str(error.value)
