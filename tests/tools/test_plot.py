"""The picture of a run: what is written, faint and shared in it. Truth: the reports that were put in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib import pyplot

from selfcal.model.file import Model
from selfcal.show.run_plot import plot_run
from selfcal.wire.dbc_file import BY_PLACE, Names
from selfcal.wire.frames import AxisReport, wire_names

G = 9.80665  # m/s^2


NAMES = wire_names(Model.load())


def report(axis: str, time_s: float, probability: tuple[float, float, float], scale: float = 1.0) -> AxisReport:
    values = {"hypotheses": 3.0} | {f"h{k}_probability": p for k, p in enumerate(probability)}
    numbers = {"h0_N": 0.06, "h1_N": 0.04, "h1_p1": 0.001}
    numbers |= {"h2_N": 0.04, "h2_p1": 0.02, "h2_p2": 0.01}  # Gauss-Markov's alpha is no reading
    for name, value in numbers.items():
        size = value * (1.0 if name.endswith("p2") else scale)
        values |= {f"{name}_q05": 0.8 * size, f"{name}_median": size, f"{name}_q95": 1.25 * size}
    return AxisReport(axis, time_s, True, values)


@pytest.fixture
def figure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Draws and returns the figure, which plot_run() would close."""
    kept: list[Any] = []
    close = pyplot.close
    monkeypatch.setattr(pyplot, "close", kept.append)

    def draw(*arguments: Any, **options: Any) -> Any:
        options.setdefault("names", NAMES)
        plot_run(arguments[0], tmp_path / "run.png", "a $title_ of its own", *arguments[1:], **options)
        assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
        return kept.pop()

    yield draw
    close("all")


HISTORY = {
    "gx": [report("gx", t, (0.0, 0.7, 0.3)) for t in range(10)],
    "gy": [report("gy", t, (0.0, 0.004, 0.996), 3.0) for t in range(10)],
    "ax": [report("ax", t, (0.0, 0.7, 0.3), G) for t in range(10)],
}


def test_verdict_values_units_and_scales(figure: Any) -> None:
    drawn = figure(HISTORY, None, {"gx": "deg/s", "gy": "deg/s", "ax": "g"})
    panels = {name: drawn.axes[5 * row : 5 * row + 5] for row, name in enumerate(HISTORY)}
    assert panels["gx"][0].get_title("right") == "random walk 0.700"
    assert panels["gy"][0].get_title("right") == "gauss markov 0.996"
    assert panels["gx"][1].get_title("right") == "0.04 [0.032, 0.05]"
    assert panels["ax"][1].get_title("right") == "0.04 [0.032, 0.05]"  # in g, as the table
    assert panels["gx"][4].get_title("right") == "100 [80, 125]"  # 1/alpha
    assert panels["gy"][2].get_title("right") == ""  # K of a law that is out of the question
    assert [panel.get_ylabel() for panel in panels["ax"][1:]] == ["g/√Hz", "g/s/√Hz", "g", "s"]
    assert panels["gx"][2].get_ylabel() == "°/s²/√Hz"
    for column in range(1, 5):
        assert panels["gx"][column].get_ylim() == panels["gy"][column].get_ylim()
    assert panels["gx"][1].get_ylim() != panels["ax"][1].get_ylim()
    low, high = panels["gx"][1].get_ylim()
    assert low < 0.032
    assert high > 3.0 * 0.05
    assert [line.get_alpha() for line in panels["gx"][0].lines] == [0.2, 1.0, 1.0]  # constant is faint
    assert [line.get_alpha() for line in panels["gy"][0].lines] == [0.2, 0.2, 1.0]


def test_a_hostile_truth_is_not_drawn(figure: Any) -> None:
    """A recording's metadata may hold anything."""
    truth: dict[str, Any] = {
        "gx": "no map",
        "gy": {"hypothesis": ["x"], "N": "0.1", "K": -1.0, "sigma_m": float("nan"), "alpha": 0},
        "gz": {"hypothesis": "$\\frac{$", "unit": "no unit", "N": 0.04, "K": True},
        "ax": {"hypothesis": None, "unit": "m/s^2", "N": 10**400, "alpha": 10**400},
        "ay": {"hypothesis": "random_walk", "unit": "V", "N": 0.04},
    }
    drawn = figure({axis: [report(axis, t, (0.0, 0.7, 0.3)) for t in range(3)] for axis in truth}, truth)
    assert len(drawn.axes) == 25
    assert not any(line.get_linestyle() == "--" for panel in drawn.axes for line in panel.lines)


def test_a_truth_is_drawn_in_the_picture_s_unit(figure: Any) -> None:
    drawn = figure(HISTORY, {"ax": {"hypothesis": "random_walk", "unit": "m/s^2", "K": 0.001 * G}}, {"ax": "g"})
    (line,) = (line for line in drawn.axes[5 * 2 + 2].lines if line.get_linestyle() == "--")
    assert line.get_ydata()[0] == pytest.approx(0.001)
    assert drawn.axes[10].get_title("right") == "random walk 0.700 (truth: random walk)"


def test_without_a_model_panels_are_places(figure: Any) -> None:
    """A place that a law lacks has no line; the last place is drawn as it came."""
    drawn = figure({"gx": HISTORY["gx"]}, names=BY_PLACE)
    assert [panel.get_title("left") for panel in drawn.axes] == ["P", "N", "p1", "p2"]
    assert [len(panel.lines) for panel in drawn.axes] == [3, 3, 2, 1]
    assert drawn.axes[0].get_title("right") == "h1 0.700"
    assert drawn.axes[2].get_ylabel() == ""


def test_the_same_law_twice_has_two_lines_in_one_panel(figure: Any) -> None:
    names = Names(("slow", "fast", "both"), (("N",), ("N", "sigma_m"), ("N", "sigma_m", "alpha")))
    drawn = figure({"gx": HISTORY["gx"]}, names=names)
    assert [panel.get_title("left") for panel in drawn.axes] == ["P", "N", "sigma_m", "1/alpha"]
    assert [len(panel.lines) for panel in drawn.axes] == [3, 3, 2, 1]
