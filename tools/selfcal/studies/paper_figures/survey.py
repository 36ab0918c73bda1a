"""Section 4.2 as an example: the errors of a gravity map by leaving out one track at a time.

A vessel measures the gravity anomaly along parallel tracks. The field is a second-order Markov field, as gravimetry
models it: covariance sigma^2 (1 + r/L) e^(-r/L). A track's readings have white noise and a slow error of their own, the
gravimeter's drift, which is Gauss-Markov. The map at a track is the optimal interpolation of all other tracks. Its
error is the difference from the track's readings. With C the covariance of all readings, that difference at track b is

    (C^-1)_bb^-1 (C^-1 y)_b        so that a single inverse leaves out each track in turn

The map maker knows the field's covariance, and counts the slow error as white noise.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from selfcal.base.grid import Array
from selfcal.model.file import Model
from selfcal.show.chart import Curve, Figure, Panel
from selfcal.studies.paper_figures.reproduction import Reproduction
from selfcal.studies.paper_figures.section4 import AREA_SAMPLES, AREA_STEP_S, MGAL, identified, map_tables, of_map_error

#: The field: rms, mGal, and length, km.
FIELD_MGAL, FIELD_KM = 10.0, 12.0
#: A track's own errors: slow errors over 150 min, and white noise, mGal.
SLOW_MGAL, NOISE_MGAL = 1.0, 0.01
#: Areas: tracks, all over the same width, km.
TRACKS = {"area 1": 9, "area 2": 13, "area 3": 17, "area 4": 25}
WIDTH_KM = 24.0


def left_out(tracks: int, rng: np.random.Generator) -> Array:
    """Differences of each track from the map of all others, mGal, [tracks, AREA_SAMPLES]."""
    # The vessel makes 8 knots.
    along, across = np.arange(AREA_SAMPLES) * (8.0 * 1.852 * AREA_STEP_S / 3600.0), np.linspace(0.0, WIDTH_KM, tracks)
    x, y = (grid.ravel() for grid in np.meshgrid(along, across))
    far = np.hypot(x[:, None] - x, y[:, None] - y) / FIELD_KM
    field = FIELD_MGAL**2 * (1.0 + far) * np.exp(-far)
    count = x.size
    # A covariance of smooth fields is singular but for rounding: 1e-9 of it is 0.6 microgal.
    truth = np.linalg.cholesky(field + 1e-9 * FIELD_MGAL**2 * np.eye(count)) @ rng.standard_normal(count)
    steps = AREA_STEP_S / 60.0 / 150.0 * np.abs(np.subtract.outer(np.arange(AREA_SAMPLES), np.arange(AREA_SAMPLES)))
    slow = rng.standard_normal((tracks, AREA_SAMPLES)) @ np.linalg.cholesky(SLOW_MGAL**2 * np.exp(-steps)).T
    measured = truth + slow.ravel() + NOISE_MGAL * rng.standard_normal(count)
    return differences(field + (SLOW_MGAL**2 + NOISE_MGAL**2) * np.eye(count), measured, tracks)


def differences(covariance: Array, measured: Array, tracks: int) -> Array:
    """Each track of `measured` [tracks * n] less its optimal interpolation of all other tracks, [tracks, n]."""
    inverse = np.linalg.inv(covariance)
    weighted = (inverse @ measured).reshape(tracks, -1)
    n = weighted.shape[1]
    blocks = inverse.reshape(tracks, n, tracks, n)
    return np.stack([np.linalg.solve(blocks[k, :, k], weighted[k]) for k in range(tracks)])


def surveys(seed: int) -> dict[str, Array]:
    """By area: the differences of its tracks, mGal, [tracks, AREA_SAMPLES]."""
    return {area: left_out(count, np.random.default_rng([seed, count])) for area, count in TRACKS.items()}


def figure(model: Model, areas: Mapping[str, Array]) -> Reproduction:
    """The law of the errors by area, and whether more tracks make them smaller and longer."""
    tables = map_tables(model)
    fits = {area: [of_map_error(tables, MGAL * error) for error in errors] for area, errors in areas.items()}
    shares, sure = identified(fits)
    estimates = {area: np.array([estimate for _, estimate in each]) for area, each in fits.items()}
    medians = np.array([np.median(values, axis=0) for values in estimates.values()])
    t = AREA_STEP_S / 3600.0 * np.arange(AREA_SAMPLES, dtype=np.float64)
    errors = Figure(
        "Section 4.2, errors of the maps",
        f"The middle track of an area less the map of the others, tracks over {WIDTH_KM:g} km.",
        [
            Panel(f"{area}, {len(each)} tracks", "time, h", "mGal", [Curve("track less map", t, each[len(each) // 2])])
            for area, each in areas.items()
        ],
    )
    by_area = [
        Figure(
            f"Section 4.2, {what}",
            f"{what.capitalize()} over the correlation interval, a dot a track.",
            [
                Panel(
                    f"{area}, {TRACKS[area]} tracks",
                    "correlation interval, min",
                    f"{name}, mGal",
                    [Curve("a track", values[:, 1], values[:, column], "dots")],
                    log_x=True,
                    log_y=column == 0,
                )
                for area, values in estimates.items()
            ],
        )
        for what, name, column in (("process rms", "σm", 0), ("white noise", "N", 2))
    ]
    falls = medians[-1] < medians[0]
    agrees = bool(min(shares.values()) > 50.0 and falls[0] and falls[2] and not falls[1])
    return Reproduction(
        "Section 4.2, one track left out",
        [errors, *by_area],
        "Gauss–Markov is the more probable in 78 to 100 % of an area's records; the more tracks, the lower the rms "
        "of the noise and of the correlated error, and the longer the correlation interval.",
        "; ".join(
            f"{TRACKS[area]} tracks: Gauss–Markov in {shares[area]:.0f} %, σm {rms:.2g} mGal, interval {minutes:.0f} "
            f"min, N {noise:.2g} mGal"
            for area, (rms, minutes, noise) in zip(areas, medians.tolist(), strict=True)
        )
        + f" (medians); mean calculated probability {sure:.0f} %.",
        "agrees" if agrees else "differs",
        f"With few tracks the error is the field between them, smooth over {FIELD_KM:g} km, so that the interval does "
        "not grow with the tracks; the survey is simulated, for the paper's data are not public.",
    )
