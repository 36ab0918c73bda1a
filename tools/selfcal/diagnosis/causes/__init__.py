"""Every cause, in the order in which the tools list them: the module NAME has the cause NAME."""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType

from selfcal.diagnosis.cause import Cause as _Cause

_NAMES = """
    temperature supply cross_axis shared vibration ramp step tilt pulse two_level turn_on periodic oscillation flicker
    colored_noise quantization_noise quantization outliers variance_change saturation missing_samples misread stuck
    held_samples rate_change motion unexplained
"""
CAUSES: Mapping[str, _Cause] = MappingProxyType(
    {name: import_module(f"{__name__}.{name}").CAUSE for name in _NAMES.split()}
)
