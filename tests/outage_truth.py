"""`selfcal diagnose --navigate` on simulated parts: does the filter fly as its sentence states?

    python tests/outage_truth.py --records 20

Each part has one effect on gx, N and K of a tactical gyroscope, and two records of `selfcal simulate`. The sentence is
of held-out time of the first. It comes true where flights with the second record's errors are off by as much: once as
`--on` has them, by the model of the first record, and once by a filter that is told the truth.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import yaml

from selfcal.base.grid import Array
from selfcal.logs.recording import Recording, load
from selfcal.model.file import DEFAULT
from selfcal.studies import outage
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.simulate import simulate

#: The truth of gx: deg/s/sqrt(Hz), deg/s^2/sqrt(Hz); length of a record, s.
N, K, DURATION_S = 3e-3, 2e-5, 3600.0
COEFFICIENT, AMPLITUDE, TAU_S = 0.004, 0.3, 600.0
#: By cause: the effect on the first record, on the second one, and what it adds to the second one's readings, by time
#: and temperature.
EFFECTS: dict[str, tuple[str, str | None, Callable[[Array, Array], Array]]] = {
    "temperature": (
        of := f"temperature:axis=gx,coefficient={COEFFICIENT}",
        of,
        lambda t, temp: COEFFICIENT * temp,
    ),
    "turn_on": (
        of := f"turn_on:axis=gx,amplitude={AMPLITUDE},tau_s={TAU_S}",
        of,
        lambda t, temp: AMPLITUDE * np.exp(-t / TAU_S),
    ),
    "step": ("step:axis=gx,time_s=800,amplitude=0.03", None, lambda t, temp: 0.0 * t),
}
SIDES, PLACES = ("before", "after"), ("held_out", "on", "truth")
#: Both numbers of a sentence are counted as true within this share of the second record's.
NEAR = 0.2


def part(folder: Path) -> Path:
    """The model file of a part with one gyroscope."""
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["groups"] = {"gyro": {**tree["groups"]["gyro"], "axes": ["gx"], "lsb": 1e-5}}
    tree.pop("gate", None)
    law = {"hypothesis": "random_walk", "bias": 0.1, "N": N, "K": K}
    tree["simulate"] = {"rate_hz": 1.0, "duration_s": DURATION_S, "axes": {"gx": law}}
    path = folder / "part.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def of_truth(second: Recording, added: Callable[[Array, Array], Array]) -> dict[str, Any]:
    """Flights with the second record's errors by a filter that is told the truth."""
    time_s = np.arange(second.samples) / second.rate_hz
    errors = second.columns["gx"].values - added(time_s, second.columns["temp"].values)
    return outage.flights({"gx": outage.KnownAxis({"N": N, "K": K}, errors - np.median(errors))})


def stated(cause: str, seed: int, folder: Path) -> dict[str, Mapping[str, Any]] | None:
    """Of one part by outage, s: the sentence (`held_out`), `on` the second record, and the `truth` there. None: the
    cause is not named."""
    on_first, on_second, added = EFFECTS[cause]
    own = part(folder)
    for name, effect, number in (
        ("a", on_first, 2 * seed),
        ("b", on_second, 2 * seed + 1),
    ):
        simulate(own, folder / f"{name}.npz", number, [effect] if effect else [])
    second = load(folder / "b.npz")
    both: dict[str, Any] = {}

    def twice(document: dict[str, Any], *given: Any) -> None:
        for key, flown in (("on", second), ("held_out", None)):
            add(document, *given[:-1], flown)
            both[key] = next(
                (one["navigation"] for one in document["findings"] if one["cause"] == cause),
                None,
            )

    add = outage.add_outages
    with mock.patch.object(outage, "add_outages", twice):
        diagnose(folder / "a.npz", model=own, axes="gx", navigate=True)
    if not both.get("on") or not both["held_out"]:
        return None
    return {
        "held_out": both["held_out"]["outage_s"],
        "on": both["on"]["outage_s"],
        "truth": of_truth(second, added),
    }


def pooled(known: Sequence[Mapping[str, Any]], place: str, seconds: str, key: str) -> str:
    """Over the parts: rms of positions, mean of NEES; without the finding and with it."""
    power = 2 if key == "position_m" else 1
    cells = []
    for side in SIDES if place != "truth" else SIDES[1:]:
        values = [(one[place][seconds] if place == "truth" else one[place][seconds][side])[key] for one in known]
        cells.append(f"{float(np.mean(np.power(values, power))) ** (1 / power):.3g}")
    return " -> ".join(cells)


def is_near(one: Mapping[str, Any], seconds: str) -> bool:
    """Whether both numbers of a sentence come true."""
    stated, on = one["held_out"][seconds], one["on"][seconds]
    return all(abs(stated[side]["position_m"] / on[side]["position_m"] - 1.0) < NEAR for side in SIDES)


def table(records: int) -> list[str]:
    """A row a cause and outage."""
    heads = ["effect", "outage, s"]
    for key in ("m", "NEES"):
        heads += [f"stated, {key}", f"on the second record, {key}", f"told the truth, {key}"]
    rows = [f"| {' | '.join([*heads, f'within {100 * NEAR:.0f} %'])} |"]
    for cause in EFFECTS:
        with tempfile.TemporaryDirectory() as folder:
            known = [one for k in range(records) if (one := stated(cause, k, Path(folder))) is not None]
        for seconds in map(str, outage.OUTAGES_S):
            cells = [pooled(known, place, seconds, key) for key in ("position_m", "nees") for place in PLACES]
            near = sum(is_near(one, seconds) for one in known)
            rows.append(f"| {cause} | {seconds} | {' | '.join(cells)} | {near} of {len(known)} |")
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=20)
    print("\n".join(table(parser.parse_args().records)))
