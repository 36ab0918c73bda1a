"""The JSON Schemas: up to date, kept by every file of ours, and as strict as the reader of model files.

Truth: the model files and results themselves, and the messages of `model/file.py`. The judge is the small part of JSON
Schema 2020-12 that the schemas use, written here.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from test_cases_priors import at_rest

from selfcal import compare, diagnose, identify
from selfcal.base.errors import UserError
from selfcal.logs.recording import Recording
from selfcal.model.file import DEFAULT, Model, parts
from selfcal.show.schemas import schemas

from conftest import ROOT

KINDS: dict[str, Callable[[Any], bool]] = {
    "object": lambda value: isinstance(value, dict),
    "array": lambda value: isinstance(value, list),
    "string": lambda value: isinstance(value, str),
    "boolean": lambda value: isinstance(value, bool),
    "null": lambda value: value is None,
    "integer": lambda value: isinstance(value, int) and not isinstance(value, bool),
    "number": lambda value: isinstance(value, int | float) and not isinstance(value, bool),
}
#: Keywords that only describe.
WORDS = {"$schema", "title", "$defs"}


def holds(value: Any, schema: dict[str, Any], root: dict[str, Any]) -> bool:
    """Whether a value keeps a schema. An unknown keyword is a fault of the schema."""
    for key, rule in schema.items():
        match key:
            case "$ref":
                place: Any = root
                for name in rule.removeprefix("#/").split("/"):
                    place = place[name]
                kept = holds(value, place, root)
            case "type":
                kept = any(KINDS[kind](value) for kind in ([rule] if isinstance(rule, str) else rule))
            case "const":
                kept = value == rule
            case "enum":
                kept = value in rule
            case "pattern":
                kept = not isinstance(value, str) or re.search(rule, value) is not None
            case "minimum" | "maximum":
                kept = not KINDS["number"](value) or (value >= rule if key == "minimum" else value <= rule)
            case "anyOf":
                kept = any(holds(value, one, root) for one in rule)
            case "oneOf":
                kept = sum(holds(value, one, root) for one in rule) == 1
            case "items":
                kept = not isinstance(value, list) or all(holds(one, rule, root) for one in value)
            case "minItems" | "maxItems":
                kept = not isinstance(value, list) or (len(value) >= rule if key == "minItems" else len(value) <= rule)
            case "minProperties" | "maxProperties":
                size = len(value) if isinstance(value, dict) else rule
                kept = size >= rule if key == "minProperties" else size <= rule
            case "required":
                kept = not isinstance(value, dict) or all(name in value for name in rule)
            case "properties":
                kept = not isinstance(value, dict) or all(
                    holds(value[name], one, root) for name, one in rule.items() if name in value
                )
            case "additionalProperties":
                beyond = (
                    [name for name in value if name not in schema.get("properties", {})]
                    if KINDS["object"](value)
                    else []
                )
                kept = not beyond if rule is False else all(holds(value[name], rule, root) for name in beyond)
            case "propertyNames":
                kept = not isinstance(value, dict) or all(holds(name, rule, root) for name in value)
            case _:
                assert key in WORDS, key
                kept = True
        if not kept:
            return False
    return True


def test_the_files_are_up_to_date() -> None:
    """`python -m selfcal.show.schemas` writes them."""
    folder = ROOT / "tools" / "schemas"
    assert {path.name for path in folder.iterdir()} == {f"{name}.schema.json" for name in schemas()}
    for name, schema in schemas().items():
        assert json.loads((folder / f"{name}.schema.json").read_text(encoding="utf-8")) == schema


def test_every_model_file_keeps_its_schema(tmp_path: Path) -> None:
    schema = schemas()["model"]
    paths = [*DEFAULT.parent.glob("*.yaml"), *parts().values(), ROOT / "tests" / "data" / "simulated_adis16405.yaml"]
    y = at_rest(4, 0.01, 1e-5, 1.0, 1500.0)
    y[700:] += 0.2 * np.sin(0.05 * np.arange(800))
    diagnose(Recording.from_arrays(y, 1.0, "deg/s"), write_model=tmp_path / "found.yaml")
    for path in [*paths, tmp_path / "found.yaml"]:
        assert holds(yaml.safe_load(path.read_text(encoding="utf-8")), schema, schema), path


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("name",), None),
        (("nam",), "x"),
        (("schema",), "selfcal.model/2"),
        (("bank_rate_hz",), "fast"),
        (("sensor", "taps"), 2),
        (("sensor", "filter_taps"), 0),
        (("groups", "gyro", "axes"), []),
        (("groups", "gyro", "priors", "N"), {"law": "log_uniform", "min": 1.0}),
        (("groups", "gyro", "priors", "N"), {"law": "normal", "sd": 1.0}),
        (("groups", "gyro", "priors", "bias"), {"law": "log_uniform", "min": 1.0, "max": 2.0}),
        (("groups", "gyro", "stuck_limit"), -1),
        (("hypotheses", "mine"), 1),
        (("hypotheses", "mine"), {"terms": ["jump"]}),
        (("nodes", "host", "random_walk"), 4),
        (("nodes",), {"cortex-m0": {}}),
        (("simulate", "axes", "gx"), {"noise": 1.0}),
        (("gate", "N"), {}),
        (("regressors",), [{"name": "a", "kind": "weather", "sd": {"gyro": 1.0}}]),
        (("regressors",), [{"name": "a", "kind": "step", "sd": {"gyro": 1.0}, "tau_s": 3.0}]),
        (("handle",), {"steps": "yes"}),
    ],
)
def test_what_the_reader_refuses_the_schema_refuses(place: tuple[str, ...], value: Any, tmp_path: Path) -> None:
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    changed = copy.deepcopy(tree)
    at = changed
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    schema = schemas()["model"]
    assert holds(tree, schema, schema) and not holds(changed, schema, schema)
    with pytest.raises(UserError):
        Model.of_tree(changed, tmp_path / "model.yaml")


def test_results_keep_theirs(tmp_path: Path) -> None:
    """Of a step, of an axis without a result, and of a change; without a key that must be there none does."""
    y = at_rest(9, 0.01, 0.0, 1.0, 900.0)
    after = y.copy()
    after[500:] += 0.4
    logs = [
        Recording.from_arrays({"gx[deg/s]": values, "gy[deg/s]": np.zeros(900)}, 1.0, name=name)
        for name, values in (("before", y), ("after", after))
    ]
    identify(logs[1], json=tmp_path / "identify")
    diagnose(logs[1], json=tmp_path / "diagnose")
    compare(logs, json=tmp_path / "compare")
    for name, schema in schemas().items():
        if name == "model":
            continue
        document = json.loads((tmp_path / name).read_text(encoding="utf-8"))
        assert document["schema"].startswith(f"selfcal.{name}/")
        assert holds(document, schema, schema), name
        del document["axes"]
        assert not holds(document, schema, schema)
