"""JSON Schemas (2020-12) of the files: `python -m selfcal.show.schemas` writes them into tools/schemas/.

An editor checks a model file by its schema, another program a result. The entries are those that `model/file.py` and
the classes of `results.py` know. The limits between entries stand in the code alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

from selfcal.model.file import MOST_AXES, MOST_HYPOTHESES, MOST_TAPS, NODES, REGRESSORS, SCHEMA
from selfcal.model.forms import FORMS, INPUTS
from selfcal.model.laws import KINDS, NAMED, PLACES
from selfcal.show.results import Comparison, Diagnosis, Identification, Object

Json = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: YAML reads 1e-3, without a dot, as text.
_NUMBER: Json = {"type": ["number", "string"], "pattern": r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"}
NUMBER, PRIOR = {"$ref": "#/$defs/number"}, {"$ref": "#/$defs/prior"}
TEXT: Json = {"type": ["string", "number"]}
COUNT: Json = {"type": "integer", "minimum": 0}
_OF = {str: "string", bool: "boolean", int: "integer", float: "number"}


def _map(values: Json, **more: Any) -> Json:
    """A mapping of these `values`."""
    return {"type": "object", "additionalProperties": values, **more}


def _only(entries: Mapping[str, Json], needed: Sequence[str] = ()) -> Json:
    """A mapping of these entries and no others."""
    return {"type": "object", "properties": dict(entries), "required": list(needed), "additionalProperties": False}


def _list(items: Json, **more: Any) -> Json:
    return {"type": "array", "items": items, **more}


def _group() -> Json:
    """Schema of a group of axes."""
    bias = _only({"law": {"const": "normal"}, "sd": NUMBER}, ["law", "sd"])
    priors = {"bias": bias, **dict.fromkeys(PLACES, PRIOR)}
    return _only(
        {
            "axes": _list({"type": "string"}, minItems=1, maxItems=MOST_AXES),
            "unit": TEXT,
            "range": NUMBER,
            "lsb": NUMBER,
            "stuck_limit": COUNT,
            "priors": _only(priors, ["bias", "N"]),
            "own_priors": {"anyOf": [_map(_only(priors)), {"type": "null"}]},
        },
        ["axes", "unit", "priors"],
    )


def model() -> Json:
    """Schema of a model file."""
    limits: dict[str, Json] = {"law": {"enum": ["log_uniform", "uniform"]}, "min": NUMBER, "max": NUMBER}
    prior = {
        "oneOf": [
            _only(limits, list(limits)),
            _only({"law": {"const": "log_normal"}, "median": NUMBER, "sd": NUMBER}, ["law", "median", "sd"]),
        ]
    }
    kinds = [
        _only({"kind": {"const": name}, "deviation": TEXT, **dict.fromkeys(kind.keys, NUMBER)}, ["kind"])
        for name, kind in KINDS.items()
    ]
    term = {"anyOf": [{"enum": [name for name, kind in KINDS.items() if not kind.needs_time]}, *kinds]}
    law = _only({"probability": NUMBER, "terms": _list(term), "coloured_noise": {"type": "boolean"}}, ["terms"])
    special = {"column": TEXT, "unit": TEXT, "input": {"enum": list(INPUTS)}, "form": {"enum": list(FORMS)}}
    special["knots"] = _list(_list(NUMBER, minItems=2, maxItems=2), minItems=2)
    regressors = [
        _only(
            {"name": TEXT, "kind": {"const": kind}, "sd": _map(NUMBER, minProperties=1), "probability": NUMBER}
            | {key: special.get(key, NUMBER) for key in keys},
            ["name", "kind", "sd"],
        )
        for kind, keys in REGRESSORS.items()
    ]
    nodes = {"type": "integer", "minimum": NODES[0], "maximum": NODES[1]}
    of_gate = {"window_s": NUMBER, "false_alarm": NUMBER, "hold": COUNT, "settle": COUNT, "memory": COUNT}
    term_of_input = _only({"kind": {"const": "markov"}, "deviation": NUMBER, "alpha": NUMBER}, ["deviation", "alpha"])
    truth = _only({"hypothesis": TEXT, "bias": NUMBER, **dict.fromkeys(PLACES, NUMBER)})
    entries = {
        "schema": {"const": SCHEMA},
        "name": TEXT,
        "bank_rate_hz": NUMBER,
        "sensor": _only(
            {"name": TEXT, "rate_hz": NUMBER, "filter_taps": COUNT | {"minimum": 1, "maximum": MOST_TAPS}}, ["rate_hz"]
        ),
        "groups": _map(_group(), minProperties=1),
        "hypotheses": {
            "type": "object",
            "properties": dict.fromkeys(NAMED, NUMBER),
            "additionalProperties": law,
            "minProperties": 1,
            "maxProperties": MOST_HYPOTHESES,
        },
        "nodes": _map(_map({"anyOf": [nodes, _list(nodes)]}), required=["host"]),
        "simulate": _only(
            {
                "rate_hz": NUMBER,
                "duration_s": NUMBER,
                "axes": {"anyOf": [_map(truth), {"type": "null"}]},
                "effects": _list({"type": "string"}),
            }
        ),
    }
    more: dict[str, Json] = {
        "regressors": {"anyOf": [_list({"oneOf": regressors}), {"type": "null"}]},
        "half_life_s": NUMBER,
        "gate": _only(of_gate | {"N": _map(NUMBER, minProperties=1)}, [*of_gate, "N"]),
        "handle": _only({"outlier_sd": NUMBER, "steps": {"type": "boolean"}, "variance_changes": {"type": "boolean"}}),
        "correlation_time_s": NUMBER,
        "hidden_input": _only(
            {"law": _list(term_of_input, minItems=1, maxItems=1), "loadings": _map(NUMBER)}
            | {"noise_correlation": _map(NUMBER)},
            ["law"],
        ),
    }
    places = {"number": _NUMBER, "prior": prior}
    return {
        "$schema": DIALECT,
        "title": "Model file of selfcal",
        **_only(entries | more, list(entries)),
        "$defs": places,
    }


def result(of: type[Object]) -> Json:
    """Schema of a class of results. A number unknown to JSON (infinity) is null; an axis may have only `error`."""
    places: dict[str, Json] = {}
    main = _hint(of, places)
    return {"$schema": DIALECT, "title": str(of.__doc__).split("\n\n")[0], **main, "$defs": places}


def _hint(hint: Any, places: dict[str, Json]) -> Json:
    """Schema of an annotation; classes go to `places`."""
    if isinstance(hint, UnionType):
        return {"anyOf": [_hint(choice, places) for choice in get_args(hint)]}
    if hint is NoneType:
        return {"type": "null"}
    arguments = get_args(hint)
    if get_origin(hint) is list:
        return _list(_hint(arguments[0], places))
    if get_origin(hint) is dict:
        return _map(_hint(arguments[1], places))
    if isinstance(hint, type) and issubclass(hint, Object):
        if hint.__name__ not in places:
            places[hint.__name__] = {}
            hints = get_type_hints(hint)
            needed = [key for key, value in hints.items() if NoneType not in get_args(value)]
            entries = {key: _hint(value, places) for key, value in hints.items()}
            failed = {"anyOf": [{"required": ["error"]}, {"required": needed}]}
            places[hint.__name__] = {"type": "object", "properties": entries} | (
                failed if "error" in hints else {"required": needed}
            )
        return {"$ref": f"#/$defs/{hint.__name__}"}
    kind = _OF.get(hint)
    return {} if kind is None else {"type": [kind, "null"] if hint is float else kind}


def schemas() -> dict[str, Json]:
    """By the name of the file."""
    of = {"identify": Identification, "diagnose": Diagnosis, "compare": Comparison}
    return {"model": model(), **{name: result(results) for name, results in of.items()}}


if __name__ == "__main__":
    folder = Path(__file__).parents[2] / "schemas"
    folder.mkdir(exist_ok=True)
    for name, schema in schemas().items():
        text = json.dumps(schema, indent=1, ensure_ascii=False) + "\n"
        (folder / f"{name}.schema.json").write_text(text, encoding="utf-8")
