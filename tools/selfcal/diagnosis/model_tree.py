"""Changes of a model file's tree that several causes share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from selfcal.model.file import LARGEST, SMALLEST

#: Nodes on the host of a law that is a sum, as `sums.yaml` has them.
NODES = [24, 20]
#: Nodes of that law on the Cortex-M0, whose RAM holds a single such law besides the random walk.
SMALL_NODES = [12, 8]


def add_law(tree: dict[str, Any], law: str, parameter: str, prior: Mapping[str, Any], entry: Any = 1) -> None:
    """Add a law to the model, with a prior of its parameter in every group and nodes on every target. `entry`: its
    odds, or the mapping that states its terms."""
    tree["hypotheses"].setdefault(law, entry)
    for target, nodes in tree["nodes"].items():
        own = {"host": NODES, "cortex-m0": SMALL_NODES}.get(target, nodes["gauss_markov"])
        nodes.setdefault(law, list(own))
    for group in tree["groups"].values():
        for priors in (group["priors"], *(group.get("own_priors") or {}).values()):
            if parameter == "B":
                priors.setdefault(parameter, dict(priors.get("sigma_m", group["priors"]["sigma_m"])))
            elif priors is group["priors"]:
                priors.setdefault(parameter, dict(prior))


def add_handling(tree: dict[str, Any], what: str, value: float | bool) -> None:
    """Have the module handle something by itself, unless the model says already how."""
    tree["handle"] = {what: value, **(tree.get("handle") or {})}


def digits(value: float, count: int = 6) -> float:
    """The digits that a model file has of a number, within the numbers that it takes: some fits end at nothing."""
    size = min(max(abs(value), SMALLEST), LARGEST) if value else 0.0
    return float(f"{math.copysign(size, value):.{count}g}")
