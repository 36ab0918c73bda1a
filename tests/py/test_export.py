"""`identify --export`: numbers against their definition in the target's own terms."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from selfcal.errors import UserError
from selfcal.export import FORMS
from selfcal.recording import save
from selfcal.verbs.identify import identify

RATE = 4.0
DEG = math.pi / 180.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two gyros in deg/s, the second noisier, and an accelerometer in mg."""
    rng = np.random.default_rng(5)
    path = tmp_path_factory.mktemp("export") / "log.csv"
    noise = rng.standard_normal((3, 4000))
    save(path, {"gx": ("deg/s", 0.05 * noise[0]), "gy": ("deg/s", 0.1 * noise[1]), "ax": ("mg", noise[2])}, RATE, {})
    return path


def test_kalibr_is_in_si_and_names_the_worst_axis(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "imu.yaml"
    document = identify(log, export=("kalibr", out))
    text = out.read_text()
    written = yaml.safe_load(text)
    gyro = document["axes"]["gy"]["parameters"]["random_walk"]["N"]["median"]
    accel = document["axes"]["ax"]["parameters"]["random_walk"]["N"]["median"]
    # six digits are written
    assert written["gyroscope_noise_density"] == pytest.approx(gyro * DEG, rel=1e-6)
    assert written["accelerometer_noise_density"] == pytest.approx(accel * 9.80665e-3, rel=1e-6)
    assert written["update_rate"] == RATE
    assert "N gy" in text
    # and they are the densities put in: sd / sqrt(rate), to 4 sd of a variance estimate from 1000 block means
    assert gyro == pytest.approx(0.1 / math.sqrt(RATE), rel=4 / math.sqrt(2000))


def test_px4_and_vins_per_sample_values_follow_from_the_densities(log: Path, tmp_path: Path) -> None:
    kalibr, px4, vins = (tmp_path / name for name in ("k", "p", "v"))
    for form, out in (("kalibr", kalibr), ("px4", px4), ("vins", vins)):
        identify(log, export=(form, out))
    densities = yaml.safe_load(kalibr.read_text())
    parameters = dict(re.findall(r"param set (\S+) (\S+)", px4.read_text()))
    # noise = N / sqrt(dt), bias noise = K / sqrt(dt)
    n, k = densities["gyroscope_noise_density"], densities["gyroscope_random_walk"]
    assert float(parameters["EKF2_GYR_NOISE"]) == pytest.approx(n * math.sqrt(RATE), rel=1e-5)
    assert float(parameters["EKF2_GYR_B_NOISE"]) == pytest.approx(k * math.sqrt(RATE), rel=1e-5)
    found = re.search(r"gyr_w: (\S+) .*?Hz: (\S+) rad/s", vins.read_text())
    assert found is not None
    # a random walk takes steps of K sqrt(dt)
    assert float(found[1]) == pytest.approx(k, rel=1e-5)
    assert float(found[2]) == pytest.approx(k / math.sqrt(RATE), rel=1e-5)


@pytest.mark.parametrize("form", FORMS)
def test_every_number_carries_its_unit(form: str, log: Path, tmp_path: Path) -> None:
    out = tmp_path / form
    identify(log, export=(form, out))
    text = out.read_text()
    assert "rad/s" in text
    assert "m/s^2" in text
    assert "nan" not in text


def test_wrong_exports_are_one_clear_line(log: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no format 'excel'"):
        identify(log, export=("excel", tmp_path / "x"))
    with pytest.raises(UserError, match="at least one accelerometer"):
        identify(log, axes=["gx"], export=("kalibr", tmp_path / "x"))
