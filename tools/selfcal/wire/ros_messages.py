"""Reports of modules as messages of ROS 2: `diagnostic_msgs/DiagnosticArray`, and `sensor_msgs/Imu` with covariances.

A message is a mapping of the fields of its definition, as `rosidl_runtime_py.set_message_fields` takes it. Nothing of
ROS is imported. Units are those of REP 103: rad/s, m/s^2, s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from selfcal.base import units

#: Fields of an Imu by the letter of an axis, and their unit.
_SENSORS = {"g": ("angular_velocity", "rad/s"), "a": ("linear_acceleration", "m/s^2")}


def header(at_s: float, frame: str) -> dict[str, Any]:
    """A header; `at_s`: s since 1970."""
    second = math.floor(at_s)
    return {"stamp": {"sec": second, "nanosec": min(round(1e9 * (at_s - second)), 999_999_999)}, "frame_id": frame}


def diagnostics(report: Mapping[str, Any], at_s: float) -> dict[str, Any]:
    """The DiagnosticArray of a report's content (`streams.content`): a status of its axis."""
    judged, laws = report.get("adequacy", {}), report["laws"]
    likeliest = _likeliest(report)
    # Levels as diagnostic_msgs has them: 0 OK, 1 WARN, 3 STALE.
    level, words = 0, "calibrated"
    if not report["complete"] or likeliest is None:
        level, words = 3, "the report is not complete"
    elif judged.get("state") == "inadequate":
        level, words = 1, f"not adequate: {judged['suspicion']}"
    elif judged.get("state") == "not_judged":
        words = "calibrated, not judged"
    values = {"unit": report["unit"], "law": likeliest or "", "bias": _pair(report["bias"])}
    values |= {
        key: _pair(estimate) for key, estimate in (laws.get(likeliest) or {}).items() if isinstance(estimate, Mapping)
    }
    status = {
        "level": level,
        "name": f"selfcal: {report['axis']}",
        "message": words,
        "hardware_id": f"node{report['node']}",
        "values": [{"key": key, "value": value} for key, value in values.items()],
    }
    return {"header": header(at_s, ""), "status": [status]}


def imu(reports: Mapping[str, Mapping[str, Any]], rate_hz: float, at_s: float) -> dict[str, Any]:
    """The Imu of a node's last report by axis: the biases in place of readings, and the covariances of a reading at
    `rate_hz` less its bias: N^2 of the likeliest law times the rate, and the variance of the bias. A sensor without all
    axes has -1, as the definition says of what is not there; so has the orientation."""
    message: dict[str, Any] = {
        "header": header(at_s, "imu"),
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": [-1.0, *[0.0] * 8],
    }
    for letter, (field, unit) in _SENSORS.items():
        of_axes = [_known(reports.get(f"{letter}{axis}"), unit) for axis in "xyz"]
        covariance = [0.0] * 9
        for k, numbers in enumerate(of_axes):
            if numbers is not None:
                covariance[4 * k] = numbers[1] ** 2 * rate_hz + numbers[2] ** 2
        message[field] = {
            axis: 0.0 if numbers is None else numbers[0] for axis, numbers in zip("xyz", of_axes, strict=True)
        }
        message[f"{field}_covariance"] = [-1.0, *[0.0] * 8] if None in of_axes else covariance
    return message


def _known(report: Mapping[str, Any] | None, unit: str) -> tuple[float, float, float] | None:
    """Bias, N and the bias' sd of a report, in `unit`; None where any of them is missing."""
    law = None if report is None else _likeliest(report)
    if report is None or law is None:
        return None
    numbers = (report["bias"].get("mean"), report["laws"][law].get("N", {}).get("mean"), report["bias"].get("sd"))
    if any(number is None for number in numbers):
        return None
    factor = units.factor(report["unit"], unit)
    return numbers[0] * factor, numbers[1] * factor, numbers[2] * factor


def _likeliest(report: Mapping[str, Any]) -> str | None:
    probability = {
        law: estimate["probability"]
        for law, estimate in report["laws"].items()
        if estimate.get("probability") is not None
    }
    return max(probability, key=lambda law: probability[law], default=None)


def _pair(estimate: Mapping[str, Any]) -> str:
    """A mean and its sd, in words."""
    mean, sd = estimate.get("mean"), estimate.get("sd")
    return "" if mean is None or sd is None else f"{mean:.6g} ± {sd:.2g}"
