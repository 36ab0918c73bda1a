"""Every cause, in the order in which the tools list them."""

from collections.abc import Mapping
from types import MappingProxyType

from selfcal.diagnosis.cause import Cause as _Cause
from selfcal.diagnosis.causes import (
    colored_noise,
    cross_axis,
    flicker,
    held_samples,
    misread,
    missing_samples,
    motion,
    oscillation,
    outliers,
    periodic,
    pulse,
    quantization,
    quantization_noise,
    ramp,
    rate_change,
    saturation,
    shared,
    step,
    stuck,
    supply,
    temperature,
    tilt,
    turn_on,
    two_level,
    unexplained,
    variance_change,
    vibration,
)

CAUSES: Mapping[str, _Cause] = MappingProxyType(
    {
        module.CAUSE.id: module.CAUSE
        for module in (
            temperature,
            supply,
            cross_axis,
            shared,
            vibration,
            ramp,
            step,
            tilt,
            pulse,
            two_level,
            turn_on,
            periodic,
            oscillation,
            flicker,
            colored_noise,
            quantization_noise,
            quantization,
            outliers,
            variance_change,
            saturation,
            missing_samples,
            misread,
            stuck,
            held_samples,
            rate_change,
            motion,
            unexplained,
        )
    }
)
