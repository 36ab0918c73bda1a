"""What the loop finds on an axis: named causes, the state before and after each, and what is left over."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from selfcal.base.grid import Array, Mask
from selfcal.diagnosis.hidden import Hidden
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.statistics import Statistic
from selfcal.likelihood.heldout import HeldOut
from selfcal.likelihood.state import FittedColumn, Look, State

#: Most rounds: a recording that holds more causes is reported as it is then.
ROUNDS = 12
#: Name of a misfit without a cause.
UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class Finding:
    """A named cause on an axis. `partner`: the other axis, of a cause that two share. `held_out`: its gain, where the
    loop has asked for it. `event`: above 0, the number of the event of several axes that it is a part of.
    `record`: the means that it was found in, where its axis was looked at in every sample. `ends`: the model with all
    other findings of its axis, and with all findings, once the loop has both."""

    look: Look
    round: int
    before: State
    after: State
    also_possible: tuple[str, ...] = ()
    rivals: tuple[Look, ...] = ()
    partner: State | None = None
    held_out: HeldOut | None = None
    event: int = 0
    record: Record | None = None
    ends: tuple[State, State] | None = None

    @property
    def without_and_with(self) -> tuple[State, State]:
        """The model without it and with it: all others are in both. Those of its round where the loop was stopped."""
        return self.ends or (self.before, self.after)

    def ended(self, final: State) -> Finding:
        """The finding with its `ends`: what it added to the model of its round is taken out of the `final` model."""
        before, after = self.before, self.after
        if before is after or after is final:
            return replace(self, ends=(final if before is after else before, final))
        terms = {term.name: getattr(before.extras, term.name) for term in fields(before.extras)}
        terms = {name: value for name, value in terms.items() if value != getattr(after.extras, name)}
        less = final.without({column.name for column in self.columns}).refit(
            y=np.where(np.isfinite(after.y), final.y + before.y - after.y, before.y),
            r=final.r * (before.r / after.r),
            extras=replace(final.extras, **terms),
            fits=before.fits,  # from a drift that is nothing no climb begins
        )
        return replace(self, ends=(less, final))

    @property
    def columns(self) -> tuple[FittedColumn, ...]:
        """The columns that it added to the model."""
        known = {regressor.name for regressor in self.before.regressors}
        return tuple(regressor for regressor in self.after.regressors if regressor.name not in known)


def rarer(level: Array) -> Mask:
    """[n]: where a noise level is above its lowest, or where it is not if it is above for most of the time."""
    above: Mask = level > level.min()
    return above if 2 * np.count_nonzero(above) <= level.size else ~above


@dataclass
class Diagnosed:
    """An axis after the loop: what it began as, what it is, and what was found in which record.

    harmful     looks that predict held-out time clearly worse, which are no findings.
    dropped     looks that other axes explain.
    stated      what the model file has already, which is no finding either.
    unfinished  why it is not done, "" if it is.
    hidden      what moves several axes, this axis among them.
    """

    first: State
    state: State
    record: Record
    findings: list[Finding] = field(default_factory=list)
    before: list[Statistic] = field(default_factory=list)
    after: list[Statistic] = field(default_factory=list)
    harmful: list[Look] = field(default_factory=list)
    dropped: list[Look] = field(default_factory=list)
    stated: list[Finding] = field(default_factory=list)
    unfinished: str = ""
    hidden: Hidden | None = None

    @property
    def loud(self) -> Mask:
        """[n]: when its noise is louder than most of the time, for a while."""
        ratio = self.state.r / self.first.r
        passes = any("r" in each.look.changes and "duration_s" in each.look.estimate for each in self.findings)
        found: Mask = (ratio > ratio.min()) & rarer(ratio) & passes
        return found

    @property
    def drift(self) -> tuple[State, State]:
        """The axis with the jumps of a hidden quantity in its drift, and without them."""
        return (self.state, self.state) if self.hidden is None else self.hidden.in_drift(self.state)

    @property
    def by_gain(self) -> list[Finding]:
        """The findings, the largest gain first."""
        return sorted(self.findings, key=lambda finding: finding.look.gain, reverse=True)

    @property
    def adequate(self) -> bool:
        return not self.findings
