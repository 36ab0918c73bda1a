"""What the loop finds on an axis: named causes, the state before and after each, and what is left over."""

from __future__ import annotations

from dataclasses import dataclass, field

from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import Look, State
from selfcal.diagnosis.statistics import Statistic


@dataclass(frozen=True)
class Finding:
    """One named cause on one axis. `partner`: the other axis, of a cause that two share."""

    look: Look
    round: int
    before: State
    after: State
    also_possible: tuple[str, ...] = ()
    shared_with: tuple[str, ...] = ()
    partner: State | None = None


@dataclass
class Diagnosed:
    """One axis after the loop: what it began as, what it is, and what was found in which record. `unfinished`: why it
    is not done, "" if it is."""

    first: State
    state: State
    record: Record
    findings: list[Finding] = field(default_factory=list)
    before: list[Statistic] = field(default_factory=list)
    after: list[Statistic] = field(default_factory=list)
    refused: list[Look] = field(default_factory=list)
    unfinished: str = ""

    @property
    def by_gain(self) -> list[Finding]:
        """The findings, the one that gains most first."""
        return sorted(self.findings, key=lambda finding: finding.look.gain, reverse=True)

    @property
    def adequate(self) -> bool:
        return not self.findings
