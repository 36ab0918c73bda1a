"""Other ways to identify the same record, each in a module of its own, and the table that names them all.

A rival is a function of a `Problem`. It returns an `Answer`. No rival sees the truth, and none is tuned to it. Another
package's rival joins by an entry point of the group GROUP: its name, and `package.module:function`.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points

from selfcal.base.errors import install_line
from selfcal.studies.methods.problem import Answer, Problem, Value

__all__ = ["GROUP", "RIVALS", "Answer", "Problem", "Rival", "Value"]
#: Entry points of other packages' rivals.
GROUP = "selfcal.rivals"


@dataclass(frozen=True)
class Rival:
    """`function` of `module` (in this package, unless it is `foreign`). `package`: what it needs beyond selfcal's own
    dependencies."""

    name: str
    title: str
    module: str
    function: str
    package: str = ""
    foreign: bool = False

    def load(self) -> Callable[[Problem], Answer]:
        """The function. Its import is not part of the time that is measured."""
        module = import_module(self.module if self.foreign else f"selfcal.studies.methods.{self.module}")
        method: Callable[[Problem], Answer] = getattr(module, self.function)
        return method

    @property
    def missing(self) -> str:
        """Why it cannot run here, with the next step; empty if it can."""
        if not self.package or importlib.util.find_spec(self.package) is not None:
            return ""
        return f"{self.package} is not installed: {install_line(self.package)}"


RIVALS = {
    rival.name: rival
    for rival in (
        Rival("library", "selfcal, the library", "own_bank", "library"),
        Rival("grid", "the bank on a dense grid, own", "dense_grid", "grid"),
        Rival("allan_slopes", "Allan deviation, slopes read", "allan_fits", "slopes"),
        Rival("allan_fit", "Allan deviation, weighted fit", "allan_fits", "fit_weighted"),
        Rival("gmwm", "wavelet moments (GMWM)", "wavelets", "gmwm"),
        Rival("autocorrelation", "autocorrelation fit", "autocorrelation", "autocorrelation"),
        Rival("whittle", "spectrum (Whittle) fit", "whittle", "whittle"),
        Rival("ml", "maximum likelihood, statsmodels", "likelihood", "maximum_likelihood", "statsmodels"),
        Rival("steady_state", "steady-state Kalman likelihood", "steady_state", "steady_state"),
        Rival("arma", "ARMA prediction error, statsmodels", "prediction_error", "arma", "statsmodels"),
        Rival("rls", "recursive least squares, ARMA form", "recursive", "recursive_least_squares"),
        Rival("subspace", "subspace, stochastic realization", "subspace", "subspace", "statsmodels"),
        Rival("ekf", "joint EKF, filterpy", "joint_filters", "ekf", "filterpy"),
        Rival("ukf", "joint UKF, filterpy", "joint_filters", "ukf", "filterpy"),
        Rival("dual_ekf", "dual EKF", "dual", "dual_ekf"),
        Rival("particles", "bootstrap particle filter", "particles", "particles"),
        Rival("rbpf", "Rao-Blackwellised particle filter", "rao_blackwell", "rao_blackwell"),
        Rival("mmae", "multiple models (MMAE), filterpy", "multiple_model", "mmae", "filterpy"),
    )
}
for _own in entry_points(group=GROUP):
    RIVALS.setdefault(_own.name, Rival(_own.name, f"{_own.name}, {_own.module}", _own.module, _own.attr, foreign=True))
