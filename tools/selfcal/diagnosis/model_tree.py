"""Changes of a model file's tree that several causes share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Nodes on the host of a law that is a sum: `sums.yaml` says what they bear.
NODES = [24, 20]
#: ... on the Cortex-M0, whose RAM holds one such law beside the random walk.
SMALL_NODES = [12, 8]


def add_law(tree: dict[str, Any], law: str, parameter: str, prior: Mapping[str, Any]) -> None:
    """Have the model one law more, with a prior of its parameter in every group and nodes on every target."""
    tree["hypotheses"].setdefault(law, 1)
    for target, nodes in tree["nodes"].items():
        own = {"host": NODES, "cortex-m0": SMALL_NODES}.get(target, nodes["gauss_markov"])
        nodes.setdefault(law, list(own))
    for group in tree["groups"].values():
        own = dict(group["priors"]["sigma_m"]) if parameter == "B" else dict(prior)
        group["priors"].setdefault(parameter, own)


def add_handling(tree: dict[str, Any], what: str, value: float | bool) -> None:
    """Have the module handle something by itself, unless the model says already how."""
    tree["handle"] = {what: value, **(tree.get("handle") or {})}


def digits(value: float) -> float:
    """The six digits that a model file has of a number."""
    return float(f"{value:.6g}")
