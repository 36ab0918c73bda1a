"""How much work a diagnosis may do, and when it must stop: asked for at every pass of the filter."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import dataclass
from typing import TypeVar

from selfcal.base.ending import Stopped

#: Work of an axis at most, samples times columns that the filter has run over: some 40 s of a processor. A record of
#: more than 0.7 million samples has 6000 passes over the readings and the bias: some 50 s a million samples.
WORK_MOST, PASSES_MOST = 8e9, 6000

T = TypeVar("T")
R = TypeVar("R")


class Spent(Stopped):
    """An axis has had its work."""


@dataclass
class Work:
    """Work that is left, and whether to stop now."""

    stop: Callable[[], bool]
    left: float = math.inf

    def count(self, samples: int, columns: int) -> None:
        """Count a pass over `samples` with `columns`. Raise Stopped on a stop, or Spent if the work is used up."""
        if self.stop():
            raise Stopped
        self.left -= samples * (1.0 + columns)
        if self.left < 0.0:
            raise Spent


_now: ContextVar[Work] = ContextVar("work", default=Work(lambda: False))  # noqa: B039 - without bound: never changed


def count(samples: int, columns: int) -> None:
    """`Work.count` of the work that goes on here."""
    _now.get().count(samples, columns)


def of_axis(samples: int) -> Work:
    """The work that an axis of this many samples may take."""
    return Work(_now.get().stop, max(WORK_MOST, 2.0 * PASSES_MOST * samples))


@contextmanager
def within(work: Work) -> Iterator[None]:
    """The passes of the block count as this work."""
    token = _now.set(work)
    try:
        yield
    finally:
        _now.reset(token)


def each(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Call in threads: nearly all the time goes into the compiled filter and the transforms, which run side by side."""
    jobs = [(copy_context(), item) for item in items]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda job: job[0].run(function, job[1]), jobs))
