"""The contract of a cause, for every cause of `CAUSES` in every form: it is named, its interval holds the truth, and
every verb reads the model that `diagnose --write-model` writes.

Truth: the numbers that each record was drawn with, in numpy alone (effects.py). A cause that has no form there is drawn
by `simulate --effect`, with the defaults of its keys: a new cause is in the test by itself.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from effects import FORMS, RATES, Drawn, K, N
from scipy.stats import binom

from selfcal.base.errors import UserError
from selfcal.diagnosis import loop
from selfcal.diagnosis.causes import CAUSES
from selfcal.model.file import DEFAULT
from selfcal.verbs.codegen import codegen
from selfcal.verbs.compare import compare
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.fleet import fleet
from selfcal.verbs.identify import identify
from selfcal.verbs.plan import plan
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate

from conftest import CASE_RECORDS, ROOT, case_records

#: The rest of a refusal is the way out.
NO_FORM, NO_INPUT = "no module makes `form: play`: leave", "no module makes `input: variance`: leave"
NO_CURVE = "no module makes `form: free`: leave"
OUTSIDE = "outside the model's priors"
MODULES = ("codegen", "replay", "replay --from")
#: Verbs that refuse the written model, or the recording with it, by cause and form.
REFUSED: Mapping[tuple[str, str], Mapping[str, str]] = {
    ("temperature", "play"): dict.fromkeys(MODULES, NO_FORM),
    ("temperature", "free"): dict.fromkeys(MODULES, NO_CURVE),
    ("vibration", "static"): dict.fromkeys(MODULES, NO_INPUT),
    ("vibration", "lag"): dict.fromkeys(MODULES, NO_INPUT),
    ("outliers", "lost words"): {"replay": OUTSIDE, "replay --from": OUTSIDE},
    # A start has the grid of its model, which `replay` alone lays about the record.
    ("held_samples", "throughout"): {"replay --from": OUTSIDE},
    ("motion", "hands"): {"replay --from": OUTSIDE},
}
#: Causes that no model file states: the record names them again with the model that was written from it.
FAULTS = "a fault of this recording"
AGAIN: Mapping[str, str] = {
    **dict.fromkeys(("missing_samples", "stuck", "held_samples", "rate_change", "motion"), FAULTS),
    **dict.fromkeys(("outliers", "saturation", "variance_change"), "the module handles it, the readings show it"),
    "two_level": "the bank has no law of two levels",
    "shared": "the bank has one axis",
    "unexplained": "it has no model",
}
#: ... of single forms.
AGAIN_FORMS = {("periodic", "band"), ("quantization", "dead band")}
#: Noise that two axes share is a leak of one into the other as well, which the model file states.
STATED = {("shared", "white")}
#: What `simulate` does not make again of the written model, or not always.
NOT_AGAIN: Mapping[tuple[str, str], str] = {
    ("vibration", "static"): "no simulated axis is shaken",
    ("vibration", "lag"): "no simulated axis is shaken",
    ("periodic", "half the rate"): "the simulated line is a sine, which has no value at half the rate",
    ("rate_change", "half"): "the model is of the rate that the record has throughout",
    ("unexplained", "flat"): "it has no model",
    ("variance_change", "by temperature"): "the simulated noise level follows no channel",
    ("held_samples", "throughout"): "the model is of the part's own rate",
    **{
        ("temperature", form): "the simulated temperature only rises"
        for form in ("cube", "play", "first_order", "free")
    },
    **{("cross_axis", form): "the simulated axis has a drift of its own" for form in ("lag", "square")},
}
#: Forms that another one has as a case.
CASES_OF = {"first_order": ("static", "lag", "rate")}
#: `compare` and `fleet` identify and diagnose several records: `make test` asks them for this cause. Nor does it ask
#: all verbs of a written model that is the first one but for what `simulate` makes. `make cases` asks all.
SEVERAL = "supply"
#: Both axes are asked for where a cause is one of both.
BOTH = ("shared", "motion")


def forms_of(cause: str) -> tuple[str, ...]:
    return tuple(FORMS.get(cause, {"": None}))


#: In `make test` the first form of a cause, in `make cases` every form.
#: `misread` has no recipe: it is the log that is wrong (test_cases_misread.py has its kinds). `tilt` is one of three
#: accelerometers alone: tests/tools/test_module.py.
PAIRS = [
    (cause, form)
    for cause in CAUSES
    if cause not in ("misread", "tilt")
    for form in forms_of(cause)[: None if CASE_RECORDS else 1]
]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of the two gyros alone, without a lattice."""
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["groups"] = {"gyro": {**tree["groups"]["gyro"], "axes": ["gx", "gy"], "lsb": 0.0}}
    tree["gate"]["N"] = {"gyro": tree["gate"]["N"]["gyro"]}
    axis = {"hypothesis": "random_walk", "bias": 0.1, "N": N, "K": K}
    tree["simulate"] = {"rate_hz": 1.0, "duration_s": 1200.0, "axes": {"gx": axis, "gy": axis}}
    path = tmp_path_factory.mktemp("base") / "base.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def record(cause: str, form: str, seed: int, base: Path, log: Path, sign: float | None = None) -> Mapping[str, float]:
    """Write a record with the effect; return its truth. `sign`: of the effect, drawn by default."""
    if cause not in FORMS:
        (applied,) = simulate(base, log, seed, [f"{cause}:axis=gx"])["effects"]
        truth: Mapping[str, float] = applied["axes"]["gx"]
        return truth
    drawn = Drawn(seed, RATES.get(cause, 1.0))
    drawn.sign = sign or drawn.sign
    truth = FORMS[cause][form](drawn)
    drawn.write(log)
    return truth


def first_of(found: Mapping[str, Any], cause: str, form: str | None = None) -> Mapping[str, Any] | None:
    """The first finding of an axis that was asked for, if it is the cause, or cannot be told from it. Of a side channel
    in this form, if one is given."""
    for axis in found["axes"].values():
        for first in axis["findings"][:1]:
            known = (first["estimate"].get("form", ""), *first["estimate"].get("form_also_possible", ()))
            of = {None, *known, *(case for one in known for case in CASES_OF.get(one, ()))}
            if cause in (first["cause"], *first["also_possible"]):
                return dict(first) if cause not in ("temperature", "supply") or form in of else None
    return None


def off(finding: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, tuple[float, bool]]:
    """Of each true number how many standard deviations the estimate is off, and whether its 90 % interval has it."""
    found: dict[str, tuple[float, bool]] = {}
    for key, value in truth.items():
        known = finding["estimate"].get(key)
        if isinstance(known, Mapping):
            away = abs(known["median"] - value)
            sd = max(known["sd"], 1e-6 * abs(value))
            found[key] = away / sd, bool(known["q05"] <= value <= known["q95"] or away < sd)
    return found


def coefficients(model: Path) -> list[str]:
    """Wishes of every coefficient of gx that a model file states and a channel moves in proportion."""
    return [
        f"{one['name']} within 40 %"
        for one in yaml.safe_load(model.read_text(encoding="utf-8")).get("regressors", [])
        if one["kind"] in ("column", "rate")
        and one["column"] != "gx"  # another axis has it
        and one.get("form", "static") in ("static", "lag", "rate")
        and one.get("input", "value") == "value"
    ]


def chain(logs: list[Path], model: Path, axes: list[str], folder: Path) -> dict[str, Callable[[], object]]:
    """Every verb that takes the written model. Means of 4 s are enough to set two records beside each other."""
    return {
        "diagnose": lambda: diagnose(logs[0], axes=axes, model=model, write_model=folder / "twice.yaml"),
        "identify": lambda: identify(logs[0], axes=["gx"], model=model, suspicion=False),
        "simulate": lambda: simulate(model, folder / "again.npz", seed=8),
        "replay": lambda: replay(logs[0], axes=["gx"], model=model, target="host", report_every=1000.0),
        "replay --from": lambda: replay(
            logs[0], axes=["gx"], model=model, start=folder / "first.json", report_every=1e3
        ),
        "compare": lambda: compare(logs, axes=["gx"], model=model, decimate=0.25),
        "fleet": lambda: fleet(logs, folder / "fleet.csv", axes=["gx"], model=model, workers=1),
        "plan": lambda: plan(model, want=["N within 30 %", *coefficients(model)], axis="gx", records=8),
        "codegen": lambda: codegen(model, folder / "tables"),
    }


@pytest.mark.parametrize(("cause", "form"), PAIRS, ids=["-".join(pair) for pair in PAIRS])
def test_every_verb_reads_what_one_wrote(cause: str, form: str, base: Path, tmp_path: Path) -> None:
    """The cause is named, each number lies within four of its standard deviations (1 in 16 000), and the chain closes:
    with the written model the record is adequate or names other causes. A second record has a gain, or a reason."""
    axes = ["gx", "gy"] if cause in BOTH else ["gx"]
    logs, model = [tmp_path / "first.npz", tmp_path / "second.npz"], tmp_path / "model.yaml"
    truth, _ = (record(cause, form, 20 + k, base, log, 1.0) for k, log in enumerate(logs))
    found = diagnose(logs[0], axes=axes, model=base, write_model=model, on=logs[1], json=tmp_path / "first.json")
    first = first_of(found, cause, form)
    assert first is not None, found["axes"]
    assert all(away < 4.0 for away, _ in off(first, truth).values()), (off(first, truth), first["estimate"])
    assert (first["gain_on"] is None) == bool(first.get("gain_on_reason"))
    results: dict[str, Any] = {}
    trees = [yaml.safe_load(path.read_text(encoding="utf-8")) | {"name": "", "simulate": {}} for path in (base, model)]
    for verb, call in chain(logs, model, axes, tmp_path).items():
        same = trees[0] == trees[1] and verb not in ("diagnose", "simulate")
        if not CASE_RECORDS and (same or (verb in ("compare", "fleet") and cause != SEVERAL)):
            continue
        said = REFUSED.get((cause, form), {}).get(verb)
        if said is None:
            results[verb] = call()
        else:
            with pytest.raises(UserError, match=re.escape(said)):
                call()
    again = {one["cause"] for axis in results["diagnose"]["axes"].values() for one in axis["findings"]}
    once_more = (cause in AGAIN or (cause, form) in AGAIN_FORMS) and (cause, form) not in STATED
    assert (cause in again) == once_more, again
    twice = yaml.safe_load((tmp_path / "twice.yaml").read_text(encoding="utf-8"))
    if cause not in AGAIN and (cause, form) not in AGAIN_FORMS:
        stated = trees[1].get("regressors", [])
        assert twice.get("regressors", [])[: len(stated)] == stated
        assert any(text.startswith(f"{cause}:") for text in twice["simulate"]["effects"]) or cause == "quantization"
    assert not any("error" in unit for unit in results.get("fleet", {}).get("units", ()))
    if case_records(0, 1) and (cause, form) not in NOT_AGAIN:
        simulated = diagnose(tmp_path / "again.npz", axes=axes, model=base)
        assert first_of(simulated, cause) is not None, simulated["axes"]


@pytest.mark.skipif(not CASE_RECORDS, reason="make cases")
@pytest.mark.parametrize(("cause", "form"), PAIRS, ids=["-".join(pair) for pair in PAIRS])
def test_it_is_named_and_its_intervals_hold(cause: str, form: str, base: Path, tmp_path: Path) -> None:
    """Named first in 9 of 10, and every number held by its 90 % interval: no tail of the binomial below 1 in 1000."""
    count, named, held, of = case_records(1, 16), 0, Counter[str](), Counter[str]()
    for seed in range(count):
        truth = record(cause, form, 1000 + seed, base, tmp_path / "log.npz")
        found = diagnose(tmp_path / "log.npz", axes=["gx", "gy"] if cause in BOTH else ["gx"], model=base)
        first = first_of(found, cause, form)
        named += first is not None
        for key, (_, inside) in ({} if first is None else off(first, truth)).items():
            of[key] += 1
            held[key] += inside
    print(f"{cause}, {form}: {named} of {count} named, held {dict(held)} of {dict(of)}")
    assert binom.cdf(named, count, 0.9) > 1e-3
    assert all(binom.cdf(held[key], of[key], 0.9) > 1e-3 for key in of), (held, of)


def test_a_clean_record_names_none(base: Path, tmp_path: Path) -> None:
    """Each cause in 1 of 200 at most: in so many records more than 5 of one of 25 causes have a chance of 1 in 70."""
    named, count = Counter[str](), case_records(2, 200)
    for seed in range(count):
        Drawn(5000 + seed, *((1.0, 1200.0), (1.0, 3600.0), (5.0, 1200.0))[seed % 3]).write(tmp_path / "log.npz")
        named.update(
            {one["cause"] for one in diagnose(tmp_path / "log.npz", axes=["gx"], model=base)["axes"]["gx"]["findings"]}
        )
    print(f"clean: {dict(named)} of {count}")
    assert all(each <= (5 if count >= 200 else 0) for each in named.values()), named


def test_the_recipe_of_a_cause_makes_one(base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """CONTRIBUTING's cause as printed, for a shape that no other cause has. Truth: its coefficient, 0.05, and its time
    constant, 200 s, which lies between two of the recipe's grid."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (text,) = re.findall(
        r"```python\n(.*?)```", page[page.index("### A cause") : page.index("### A kind of term")], re.S
    )
    toy = ModuleType("toy")
    toy.__dict__["shape"] = lambda t, tau_s: np.sign(np.sin((t / 5.0) ** 1.2)) * np.exp(-t / tau_s)
    exec(compile(text.replace("NAME", "toy"), "toy", "exec"), toy.__dict__)
    added = MappingProxyType({"toy": toy.__dict__["CAUSE"], **CAUSES})
    for name, module in list(sys.modules.items()):
        if name.startswith("selfcal.") and getattr(module, "CAUSES", None) is CAUSES:
            monkeypatch.setattr(module, "CAUSES", added)
    monkeypatch.setattr(loop, "LOOKS", (toy.__dict__["CAUSE"].looks, *loop.LOOKS))
    log, model = tmp_path / "log.npz", tmp_path / "model.yaml"
    simulate(base, log, 3, ["toy:axis=gx,coefficient=0.05,tau_s=200"])
    for again in (False, True):
        (found,) = diagnose(log, axes=["gx"], model=base, write_model=model)["axes"]["gx"]["findings"]
        assert found["cause"] == "toy"
        for key, truth in (("coefficient", 0.05), ("tau_s", 200.0)):
            assert abs(found["estimate"][key]["median"] - truth) < 4.0 * found["estimate"][key]["sd"]
        (effect,) = yaml.safe_load(model.read_text(encoding="utf-8"))["simulate"]["effects"]
        assert effect.startswith("toy:coefficient=0.0") and effect.endswith(",axis=gx")
        if not again:
            simulate(model, log, 4)
