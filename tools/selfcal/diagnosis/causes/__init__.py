"""Every cause, in the order in which the tools list them."""

from types import MappingProxyType

from selfcal.diagnosis.causes import (
    colored_noise,
    cross_axis,
    flicker,
    held_samples,
    missing_samples,
    motion,
    outliers,
    periodic,
    quantization,
    ramp,
    rate_change,
    saturation,
    step,
    stuck,
    supply,
    temperature,
    unexplained,
    variance_change,
    vibration,
)

CAUSES = MappingProxyType(
    {
        module.CAUSE.id: module.CAUSE
        for module in (
            temperature,
            supply,
            cross_axis,
            vibration,
            ramp,
            step,
            periodic,
            flicker,
            colored_noise,
            quantization,
            outliers,
            variance_change,
            saturation,
            missing_samples,
            stuck,
            held_samples,
            rate_change,
            motion,
            unexplained,
        )
    }
)
