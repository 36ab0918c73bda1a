"""Logs whose right answer takes a part that is not built yet. Each test fails, and names the step that builds it.

Truth: the numbers in each script of the shared cases. The day an answer is right the test fails as `strict`: move it to
the file of its kind.
"""

from pathlib import Path
from typing import Any

import pytest

from selfcal.base.errors import UserError
from selfcal.verbs.diagnose import diagnose

from conftest import shared_case


def later(step: int, part: str) -> pytest.MarkDecorator:
    """Strict: an answer that has become right is a failure of this file."""
    return pytest.mark.xfail(strict=True, raises=(AssertionError, UserError), reason=f"step {step}: {part}")


def causes_of(log: Path) -> dict[str, dict[str, Any]]:
    """Estimates by cause, of every axis, from means of 1 s."""
    axes = diagnose(log, decimate=1.0)["axes"]
    return {finding["cause"]: finding["estimate"] for axis in axes.values() for finding in axis.get("findings", [])}


@later(12, "forms of a channel's influence")
def test_a_cubic_of_the_temperature_has_its_curvature(tmp_path: Path) -> None:
    """P30: from -5 to 40 degC. The form's keys are those of the contract; `ramp` is wrong."""
    found = causes_of(shared_case("P30_cubic.py", tmp_path))
    assert "ramp" not in found
    assert found.get("temperature", {}).get("form") in ("square", "cube")
