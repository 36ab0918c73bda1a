"""`identify --export`: numbers against their definition in the target's own terms."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from selfcal.adequacy.overbound import overbound, upper_limit
from selfcal.base.errors import UserError
from selfcal.logs.recording import save
from selfcal.show.export import FORMS, SensorKind, text_of
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


def _kalibr(of: Mapping[str, float], dt: float) -> tuple[float, float]:
    """kalibr_common/ConfigReader.py: noise density / sqrt(dt) a sample; the walk is continuous."""
    return (of["gyroscope_noise_density"] / dt**0.5 * dt) ** 2, of["gyroscope_random_walk"] ** 2 * dt


#: By format what its reader adds in a step: the gyro's numbers by their names in the file, and the step, s, give the
#: variance of an angle and of the bias. Each formula is the reader's own, with its place.
READERS: dict[str, Callable[[Mapping[str, float], float], tuple[float, float]]] = {
    "kalibr": _kalibr,
    "allan_variance_ros": _kalibr,  # the package's file is kalibr's
    # open_vins, ov_msckf/src/state/Propagator.cpp: Qc = sigma_w^2 / dt, through G = dt; sigma_wb^2 dt
    "openvins": lambda of, dt: (of["gyroscope_noise_density"] ** 2 / dt * dt**2, of["gyroscope_random_walk"] ** 2 * dt),
    # ORB_SLAM3, src/Tracking.cc: sf = sqrt(IMU.Frequency), Calib(Ng sf, Na sf, Ngw / sf, Naw / sf); ImuTypes.cc: B = dt
    "orbslam3": lambda of, dt: (
        (of["IMU.NoiseGyro"] * of["IMU.Frequency"] ** 0.5 * dt) ** 2,
        of["IMU.GyroWalk"] ** 2 / of["IMU.Frequency"],
    ),
    # VINS, factor/integration_base.h: V has 0.5 dt for either reading's noise, and dt for the walk's
    "vins": lambda of, dt: (2.0 * (0.5 * dt * of["gyr_n"]) ** 2, (dt * of["gyr_w"]) ** 2),
    # PX4, src/modules/ekf2/EKF/covariance.cpp: sq(dt gyro_noise), sq(dt gyro_bias_p_noise); dt is EKF2_PREDICT_US
    "px4": lambda of, dt: ((dt * of["EKF2_GYR_NOISE"]) ** 2, (dt * of["EKF2_GYR_B_NOISE"]) ** 2),
    # rotors_gazebo_plugins/src/gazebo_imu_plugin.cpp: density / sqrt(dt); sqrt(-w^2 tau / 2 (exp(-2 dt / tau) - 1))
    "rotors": lambda of, dt: (
        (of["gyroscopeNoiseDensity"] / dt**0.5 * dt) ** 2,
        -(of["gyroscopeRandomWalk"] ** 2)
        * of["gyroscopeBiasCorrelationTime"]
        / 2.0
        * math.expm1(-2.0 * dt / of["gyroscopeBiasCorrelationTime"]),
    ),
}


@pytest.mark.parametrize("rate_hz", [4.0, 61.7, 250.0])
@pytest.mark.parametrize("form", FORMS)
def test_its_reader_has_the_densities(form: str, rate_hz: float) -> None:
    """N^2 dt and K^2 dt a step of whoever reads the file, at its own step, whatever rate the recording has. Of RotorS'
    Gauss-Markov drift what it does in a step beside a correlation time of 40 s; six digits are written."""
    N, K, alpha = 3.1e-4, 7.7e-6, 0.025
    spread = {"N": N, "K": K, "sigma_m": K / math.sqrt(2.0 * alpha), "alpha": alpha}
    gyro = SensorKind(spread, {"N": 2.0 * N, "K": 2.0 * K}, 0.95, False, ())
    text = text_of(
        form, gyro, replace(gyro, median={**spread, "N": 9.0 * N}), {"path": "a", "rate_hz": rate_hz, "duration_s": 1.0}
    )
    pairs = re.findall(r"<(\w+)>([-+.e\d]+)<|^(?:param set )?\s*([\w.]+):? ([-+.e\d]+)\s+#", text, re.MULTILINE)
    found = {one or other: float(value or number) for one, value, other, number in pairs}
    dt = 0.01 if form == "px4" else 1.0 / rate_hz
    angle, bias = READERS[form](found, dt)
    assert angle == pytest.approx(N**2 * dt, rel=1e-5)
    assert bias == pytest.approx(K**2 * dt, rel=1e-5 + alpha * dt)
    if form in ("px4", "vins"):  # the file's words say how to change the step
        assert ("EKF2_PREDICT_US 10000" if form == "px4" else f"of an IMU at {rate_hz:g} Hz") in text


#: What ov_core::YamlParser and Kalibr's intrinsics are asked for (open_vins, config/rpng_sim/kalibr_imu_chain.yaml).
OPENVINS = (
    "T_i_b", "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density",
    "gyroscope_random_walk", "rostopic", "time_offset", "update_rate", "model",
    "Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg",
)  # fmt: skip
#: What allan_variance_ros, scripts/analysis.py, writes.
ALLAN_VARIANCE_ROS = (
    "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk",
    "rostopic", "update_rate",
)  # fmt: skip


def test_openvins_and_allan_variance_ros_have_their_keys_and_si_values(tmp_path: Path) -> None:
    """Keys in the order of the programs' own files. Values: N = sd / sqrt(rate) within 4 sd of a variance of 2000 block
    means, K = step sd / sqrt(dt) of a walk within a factor 1.5 (some 60 independent stretches), in rad
    and m. allan_variance_ros reads K where the slope +1/2 meets 3 s, where K^2 tau / 3 is K^2."""
    rng = np.random.default_rng(9)
    rate, n = 8.0, 16_000
    noise, steps = rng.standard_normal((2, n)), np.cumsum(rng.standard_normal((2, n)), axis=1)
    gyro, accel = 0.2 * noise[0] + 2e-3 * steps[0], 3.0 * noise[1] + 0.02 * steps[1]
    log = tmp_path / "log.csv"
    save(log, {"gx": ("deg/s", gyro), "ax": ("mg", accel)}, rate, {})
    for form in ("openvins", "allan_variance_ros"):
        identify(log, export=(form, tmp_path / form))
    text = (tmp_path / "openvins").read_text()
    assert text.startswith("%YAML:1.0\n")  # what cv::FileStorage wants, and no other YAML reader takes
    chain = yaml.safe_load(text.partition("\n")[2])
    assert list(chain) == ["imu0"] and tuple(chain["imu0"]) == OPENVINS
    file = yaml.safe_load((tmp_path / "allan_variance_ros").read_text())
    assert tuple(file) == ALLAN_VARIANCE_ROS
    truth = {
        "gyroscope_noise_density": (0.2 * DEG / math.sqrt(rate), 4.0 / math.sqrt(2.0 * 2000)),
        "accelerometer_noise_density": (3.0 * 9.80665e-3 / math.sqrt(rate), 4.0 / math.sqrt(2.0 * 2000)),
        "gyroscope_random_walk": (2e-3 * DEG * math.sqrt(rate), 0.5),
        "accelerometer_random_walk": (0.02 * 9.80665e-3 * math.sqrt(rate), 0.5),
    }
    for found in (chain["imu0"], file):
        for name, (value, tolerance) in truth.items():
            assert found[name] == pytest.approx(value, rel=tolerance), name
        assert found["update_rate"] == rate and found["rostopic"].startswith("/")
    assert np.array_equal(chain["imu0"]["T_i_b"], np.eye(4)) and np.array_equal(chain["imu0"]["Tg"], np.zeros((3, 3)))
    for name in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC"):
        assert np.array_equal(chain["imu0"][name], np.eye(3))


@pytest.mark.parametrize("form", FORMS)
def test_every_number_carries_its_unit(form: str, log: Path, tmp_path: Path) -> None:
    out = tmp_path / form
    identify(log, export=(form, out))
    text = out.read_text()
    assert "rad/s" in text
    assert "m/s^2" in text
    assert "nan" not in text


def test_the_file_says_what_it_covers(log: Path, tmp_path: Path) -> None:
    """Axes, rate, adequacy, and beside every number the other estimate."""
    for form in FORMS:
        out = tmp_path / form
        identify(log, export=(form, out))
        text = out.read_text()
        assert "from log.csv: 4 Hz, 1000 s" in text
        assert "Written: medians" in text
        assert "gyro: axes gx, gy;" in text
        assert "accelerometer: axes ax;" in text
        assert text.count(": adequate") == 2
        assert text.count("overbound 0.95: ") == 4
        assert "from 2 to 1" in text


def test_an_axis_that_no_law_explains_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(6000.0)
    sine = 0.02 * np.sin(t * 0.0628) + 0.04 * rng.standard_normal(t.size)
    log = tmp_path / "log.csv"
    save(log, {"gx": ("deg/s", sine), "ax": ("mg", rng.standard_normal(t.size))}, 1.0, {})
    identify(log, export=("kalibr", tmp_path / "k.yaml"))
    text = (tmp_path / "k.yaml").read_text()
    assert "# gyro: NOT ADEQUATE: no law explains gx\n" in text
    assert "# accelerometer: adequate\n" in text


def test_an_overbound_takes_the_medians_place(log: Path, tmp_path: Path) -> None:
    """Its white noise and walk lie above every gyro's measured curve, and the files agree among each other."""
    kalibr, rotors, px4 = (tmp_path / name for name in ("k", "r", "p"))
    for form, out in (("kalibr", kalibr), ("rotors", rotors), ("px4", px4)):
        document = identify(log, export=(form, out), overbound=0.95)
    text = kalibr.read_text()
    written = yaml.safe_load(text)
    assert "Written: overbound 0.95" in text
    median = document["axes"]["gy"]["parameters"]["random_walk"]["N"]["median"] * DEG
    assert f"rad/s/sqrt(Hz); median {median:.6e}" in text
    n, k = written["gyroscope_noise_density"], written["gyroscope_random_walk"]
    for name in ("gx", "gy"):
        allan = document["axes"][name]["allan"]
        tau = np.array(allan["tau_s"])
        assert (n**2 / tau + k**2 * tau / 3.0 > (DEG * np.array(allan["recording"])) ** 2).all()
    xml = rotors.read_text()
    assert f"<gyroscopeRandomWalk>{k:.6e}<" in xml
    assert "<gyroscopeBiasCorrelationTime>1.000000e+09<" in xml  # a walk, not a Gauss-Markov drift
    parameters = dict(re.findall(r"param set (\S+) (\S+)", px4.read_text()))
    assert float(parameters["EKF2_GYR_NOISE"]) == pytest.approx(n * math.sqrt(100.0), rel=1e-5)
    for level in (0.4, 1.0, math.nan):
        with pytest.raises(UserError, match=r"--overbound must be 0\.5 or more"):
            identify(log, export=("kalibr", kalibr), overbound=level)


def test_an_overbound_is_above_everywhere_and_has_the_least_area() -> None:
    """Against a search over 400 x 400 pairs of N and K, on curves of two axes, one with a hump: no pair that lies above
    has less area, and the best of the lattice is as near as its step of 2 %."""
    tau = np.geomspace(2.0, 2000.0, 41)
    hump = 0.02 * np.exp(-0.5 * np.log(tau / 60.0) ** 2)
    curves = [np.sqrt(0.04**2 / tau + hump**2 + 1e-7 * tau), np.sqrt(0.06**2 / tau + 1e-7 * tau)]
    n, k = overbound([tau, tau], curves)

    def variance(n: np.ndarray, k: np.ndarray) -> np.ndarray:
        return np.asarray(n[..., None] ** 2 / tau + k[..., None] ** 2 * tau / 3.0)

    def area(n: np.ndarray, k: np.ndarray) -> np.ndarray:
        return np.asarray(np.trapezoid(np.log(variance(n, k)), np.log(tau), axis=-1))

    def above(n: np.ndarray, k: np.ndarray) -> np.ndarray:
        return np.asarray((variance(n, k) >= np.maximum(*curves) ** 2 * (1.0 - 1e-9)).all(axis=-1))

    assert above(np.array(n), np.array(k))
    grid_n, grid_k = np.meshgrid(np.geomspace(0.005, 15.0, 400), np.geomspace(1e-5, 0.03, 400))
    best = float(area(grid_n, grid_k)[above(grid_n, grid_k)].min())
    assert float(area(np.array(n), np.array(k))) <= best + 1e-9
    assert best - float(area(np.array(n), np.array(k))) < 2.0 * 0.02 * math.log(1000.0)


def test_upper_limits_hold_as_often_as_they_say() -> None:
    """A variance of 6 degrees of freedom, 4000 times: 95 % of the limits are above the truth, to 4 sd."""
    freedom = np.full(4000, 6.0)
    measured = np.sqrt(np.random.default_rng(1).chisquare(6.0, 4000) / 6.0)
    share = float((upper_limit(measured, freedom, 0.95) > 1.0).mean())
    assert share == pytest.approx(0.95, abs=4.0 * math.sqrt(0.95 * 0.05 / 4000))


def test_wrong_exports_are_one_clear_line(log: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no format 'excel'"):
        identify(log, export=("excel", tmp_path / "x"))
    with pytest.raises(UserError, match="at least one accelerometer"):
        identify(log, axes=["gx"], export=("kalibr", tmp_path / "x"))
