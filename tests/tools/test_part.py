"""`selfcal part`, the model files of common parts, and axes of any name and unit.

Truth: the numbers that the records are made with, and conversions of units done by hand.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_cases_priors import at_rest, deviation, write

import selfcal
from selfcal.base.errors import UserError
from selfcal.model.file import DEFAULT, Model, file_of, parts
from selfcal.verbs.codegen import codegen
from selfcal.verbs.identify import identify
from selfcal.verbs.part import part
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate

G = 9.80665
#: Key, text, the group that it is for, and N there, in deg/s/sqrt(Hz) or m/s^2/sqrt(Hz).
SHEETS = [
    ("N=0.3deg/sqrt(h)", "gyro", 0.3 / 60.0),
    ("gyro.N = 2e-4 rad/s/sqrt(Hz)", "gyro", 2e-4 * 180.0 / math.pi),
    ("density=8mdps/sqrt(Hz)", "gyro", 8e-3 / math.sqrt(2.0)),
    ("density=70ug/sqrt(Hz)", "accel", 70e-6 * G / math.sqrt(2.0)),
    ("accel.N=0.04m/s/sqrt(h)", "accel", 0.04 / 60.0),
]


def test_a_recording_becomes_a_model_that_every_verb_takes(tmp_path: Path) -> None:
    """Rate, lattice and range as they were made; N inside the middle decade of its prior; then N within 4 sd."""
    lsb, N = 0.0078125, 0.02
    y = np.round(at_rest(1, N, 5e-5, 50.0, 900.0, 0.4) / lsb) * lsb
    z = np.minimum(at_rest(2, 150e-6, 1e-6, 50.0, 900.0, 1.999), 2.0)  # clips at its 2 g
    log = write(tmp_path / "my log.npz", 50.0, gy=("dps", y), az=("g", z))
    model = part([log], tmp_path / "own.yaml")
    assert model.name == "my log" and model.sensor_rate_hz == 50.0
    gyro, accel = model.groups
    assert gyro.axes == ("gy",) and gyro.lsb == pytest.approx(lsb) and gyro.range == 0.0
    assert accel.axes == ("az",) and accel.range == pytest.approx(2.0 * G, rel=1e-5)
    assert 30.0 < gyro.priors["N"].max / N < 300.0
    (found,) = identify(log, axes=["gy"], model=tmp_path / "own.yaml", suspicion=False)["axes"].values()
    assert found["priors"] == "model" and abs(deviation(found["parameters"]["constant"]["N"], N)) < 4.0
    assert codegen(tmp_path / "own.yaml", tmp_path / "tables").rate_hz == pytest.approx(50.0)
    simulate(tmp_path / "own.yaml", tmp_path / "made.npz", seed=4)
    made = identify(tmp_path / "made.npz", axes=["gy"], model=tmp_path / "own.yaml", suspicion=False)["axes"]["gy"]
    assert made["parameters"]["gauss_markov"]["N"]["median"] == pytest.approx(N, rel=0.3)


@pytest.mark.parametrize(("text", "group", "N"), SHEETS)
def test_a_data_sheet_becomes_a_model(text: str, group: str, N: float, tmp_path: Path) -> None:
    """N two decades either way, to the two digits that the file has."""
    model = part((), tmp_path / "own.yaml", name="Sheet", datasheet=[text, "rate=200Hz", "gyro.range=8.7rad/s"])
    own = {one.name: one for one in model.groups}
    assert own[group].priors["N"].max == pytest.approx(100.0 * N, rel=0.05)
    assert own["gyro"].range == pytest.approx(8.7 * 180.0 / math.pi, rel=1e-5) and own["accel"].range == 0.0
    assert model.sensor_rate_hz == 200.0
    other = "accel" if group == "gyro" else "gyro"
    assert own[other].priors == next(one for one in Model.load().groups if one.name == other).priors


def test_an_axis_has_its_own_number(tmp_path: Path) -> None:
    sheet = ["N=0.1deg/sqrt(h)", "gz.N=1deg/sqrt(h)", "gz.B=36deg/h", "rate=100Hz"]
    model = part((), tmp_path / "own.yaml", datasheet=sheet)
    middle = {axis: model.group_of(axis).priors["N"].max / 100.0 for axis in ("gx", "gy", "gz")}
    assert middle == pytest.approx({"gx": 0.1 / 60.0, "gy": 0.1 / 60.0, "gz": 1.0 / 60.0}, rel=0.05)
    drift = model.group_of("gz").priors["sigma_m"]
    assert math.sqrt(drift.min * drift.max) == pytest.approx(0.01, rel=0.05)
    assert model.group_of("gx").priors["sigma_m"] != drift


@pytest.mark.parametrize(
    ("sheet", "said"),
    [
        ([], "recording at rest"),
        (["N=0.1deg/sqrt(h)"], "rate=200Hz"),
        (["N=0.1", "rate=10Hz"], "write KEY=NUMBER"),
        (["N=0.1parsec", "rate=10Hz"], "write KEY=NUMBER"),
        (["M=0.1deg", "rate=10Hz"], "no key 'M'"),
        (["N=0.1V/sqrt(Hz)", "rate=10Hz"], "is no unit of N"),
        (["hx.N=0.1deg/sqrt(h)", "rate=10Hz"], "no group or axis 'hx'"),
        (["N=-1deg/sqrt(h)", "rate=10Hz"], "write KEY=NUMBER"),
        (["N=1e999deg/sqrt(h)", "rate=10Hz"], "write KEY=NUMBER"),
        (["gx.lsb=1dps", "rate=10Hz"], "of a group"),
        (["rate=5deg/s"], "in Hz"),
    ],
)
def test_what_no_data_sheet_states_is_one_line(sheet: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        part((), tmp_path / "own.yaml", datasheet=sheet)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "own.yaml").exists()


def test_a_recording_that_moved_is_no_part(tmp_path: Path) -> None:
    values = at_rest(9, 0.01, 1e-4, 20.0, 300.0)
    values[4000:] += 3.0 * np.random.default_rng(1).normal(size=2000)
    log = write(tmp_path / "log.npz", 20.0, gx=("deg/s", values))
    with pytest.raises(UserError, match="gx moved; take a stretch at rest: --start 0 --end "):
        part([log], tmp_path / "own.yaml")
    assert part([log], tmp_path / "own.yaml", end_s=199.0).axes == ("gx",)


# -------------------------------------------------------------------------------------------------- parts by their name


def test_parts_are_found_by_name() -> None:
    """In any spelling, with or without signs; the default model is the ADIS16405's."""
    for spelled, name in {"bmi088": "bmi088", "BMI088": "bmi088", "icm-42688-p": "icm42688p"}.items():
        assert file_of(spelled) == parts()[name]
    assert file_of("ADIS16405") == file_of(None) == DEFAULT
    with pytest.raises(UserError, match=r"no part 'bmi099' \(there are adis16405, .*tactical\)"):
        Model.load("bmi099")


def test_a_file_of_a_parts_name_is_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bmi088").write_text(DEFAULT.read_text(encoding="utf-8").replace("name: default", "name: mine"))
    assert Model.load("bmi088").name == "mine"


@pytest.mark.parametrize("name", parts())
def test_a_part_of_the_folder_works_everywhere(name: str, tmp_path: Path) -> None:
    """Its file names the source of each number. It has tables for three targets. `simulate` has its N, and `identify`
    finds it within 4.5 sd by the model's own priors."""
    for line in parts()[name].read_text(encoding="utf-8").splitlines():
        assert not line.strip().startswith(("range:", "lsb:")) or "#" in line, line
    for target in ("host", "cortex-m4f", "cortex-m0-small"):
        codegen(name, tmp_path / target, target=target)
    truth = simulate(name, tmp_path / "log.npz", seed=3)["truth"]
    known = [axis for axis in truth if axis in Model.load(name).simulate["axes"]]
    assert known or name == "adis16405"  # the default model leaves its N open
    if not known:
        return
    for axis, found in identify(tmp_path / "log.npz", axes=known, model=name, suspicion=False)["axes"].items():
        assert found["priors"] == "model"
        if "lattice" not in found["checks"]:  # rounding adds to N
            assert abs(deviation(found["parameters"][truth[axis]["hypothesis"]]["N"], truth[axis]["N"])) < 4.5


# -------------------------------------------------------------------------------------------- axes of any name and unit


def test_axes_of_any_name_and_unit(tmp_path: Path) -> None:
    """A gravimeter and a magnetometer in two units: the model by `part`; N and K within 4 sd; the host's firmware over
    the same readings within 1e-3 of P and 0.1 sd of N."""
    truth = {"gravity": (0.05, 2e-3), "mx": (0.1, 3e-3), "m.y": (120.0, 4.0)}
    log = write(
        tmp_path / "log.npz",
        10.0,
        gravity=("mGal", at_rest(5, *truth["gravity"], 10.0, 1200.0, 1200.0)),
        mx=("uT", at_rest(6, *truth["mx"], 10.0, 1200.0, 22.0)),
        **{"m.y": ("nT", at_rest(7, *truth["m.y"], 10.0, 1200.0, -4.1e4))},
    )
    own = tmp_path / "own.yaml"
    model = part([log], own, axes=["gravity", "mx", "m.y"])
    assert [(group.name, group.unit, group.axes) for group in model.groups] == [
        ("gravity", "mGal", ("gravity",)),
        ("field", "uT", ("mx", "m.y")),
    ]
    found = identify(log, model=own, suspicion=False)["axes"]
    assert list(found) == ["gravity", "mx", "m.y"]
    for name, axis in found.items():
        walk = axis["parameters"]["random_walk"]
        assert abs(deviation(walk["N"], truth[name][0])) < 4.0 and abs(deviation(walk["K"], truth[name][1])) < 4.0
    assert found["m.y"]["bias_now"]["unit"] == "nT"
    for name, axis in replay(log, model=own)["axes"].items():
        assert axis["bias_now"]["unit"] == found[name]["bias_now"]["unit"]
        for law, probability in axis["hypotheses"].items():
            assert abs(probability - found[name]["hypotheses"][law]) < 2e-3
        one, other = (tree["parameters"]["random_walk"]["N"] for tree in (axis, found[name]))
        assert abs(one["median"] - other["median"]) < 0.1 * other["sd"]
    simulate(own, tmp_path / "made.npz", seed=1)
    assert list(identify(tmp_path / "made.npz", model=own, suspicion=False)["axes"]) == ["gravity", "mx", "m.y"]
    assert codegen(own, tmp_path / "tables").axes[2].name == "m.y"


def test_a_board_has_no_axis_of_another_name(tmp_path: Path) -> None:
    log = write(tmp_path / "log.npz", 10.0, mx=("uT", at_rest(6, 0.1, 3e-3, 10.0, 300.0, 22.0)))
    part([log], tmp_path / "own.yaml", axes=["mx"])
    with pytest.raises(UserError, match="have no axis mx; take --target host"):
        replay(log, model=tmp_path / "own.yaml", target="cortex-m4f")


def test_seven_axes_do_not_fit_the_wire(tmp_path: Path) -> None:
    named = {f"m{k}": ("uT", at_rest(k, 0.1, 3e-3, 10.0, 60.0)) for k in range(7)}
    log = write(tmp_path / "log.npz", 10.0, **named)
    part([log], tmp_path / "own.yaml", axes=list(named))
    with pytest.raises(UserError, match="no room for m0, m1"):
        replay(log, model=tmp_path / "own.yaml")


def test_own_priors_of_an_unknown_axis_are_refused(tmp_path: Path) -> None:
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["groups"]["gyro"]["own_priors"] = {"ax": {"N": {"law": "log_uniform", "min": 1e-4, "max": 1.0}}}
    with pytest.raises(UserError, match=r"groups.gyro.own_priors: unknown entry 'ax' \(known: gx, gy, gz\)"):
        Model.of_tree(tree, tmp_path / "own.yaml")


def test_codegen_names_the_axes_without_a_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """gz is a copy of gx, which `part` refuses; the recording has no accelerometer."""
    random = np.random.default_rng(31)
    x, y = 0.03 * random.standard_normal((2, 900))
    selfcal.part({"gx": x, "gy": y, "gz": 1.7 * x}, tmp_path / "own.yaml", rate_hz=5.0, units="deg/s")
    capsys.readouterr()
    selfcal.codegen(tmp_path / "own.yaml", tmp_path / "tables")
    assert "own.yaml: wide priors, without a result in the file: gz\n" in capsys.readouterr().err
