"""Which model a module runs: the model whose tables have the `model_id` of its status."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from itertools import combinations
from pathlib import Path

from selfcal.base.errors import UserError
from selfcal.diagnosis.warm import Start, load_start, warmed
from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.wire.dbc_file import BY_PLACE, Names
from selfcal.wire.frames import AXES, wire_names


class KnownModels:
    """The default model, and the model of the file `path`, with the diagnosis `start` that its module was built from.
    Raises UserError for an invalid model, or the start of another model."""

    def __init__(self, path: Path | str | None = None, start: Path | str | None = None) -> None:
        if start is not None and path is None:
            raise UserError("--from goes with --model: it is of one model")
        self.models = [*([] if path is None else [Model.load(path)]), Model.load()]
        self._start = None if start is None else load_start(start, self.models[0])
        self._named = lru_cache(maxsize=32)(self._find)

    def names(self, status: Mapping[str, float]) -> Names:
        """Names of the model that a module with this status runs; BY_PLACE until the model is known."""
        numbers = tuple(status.get(key, math.nan) for key in ("model_id", "bank_interval", "bank_block"))
        return BY_PLACE if any(math.isnan(value) for value in numbers) else self._named(*numbers)

    def advice(self, status: Mapping[str, float]) -> str:
        """The remedy for names that are places; empty if the model is known."""
        if "model_id" not in status or "bank_block" not in status or self.names(status).known:
            return ""
        return f"names are places: give the model {int(status['model_id']):08x} that it was built with, --model FILE"

    def _find(self, model_id: float, interval_s: float, block: float) -> Names:
        for model in self.models:
            start = self._start if model is self.models[0] else None
            if int(model_id) in _ids(model, start, interval_s, int(block)):
                return wire_names(model)
        return BY_PLACE


def _ids(model: Model, start: Start | None, interval_s: float, block: int) -> Iterator[int]:
    """Ids of the model's tables for each target and choice of axes that telemetry can carry, in the model's order."""
    if not 0.0 < interval_s < math.inf or block < 1:
        return
    sent = [axis for axis in model.axes if axis in AXES]
    for target in model.nodes:
        for count in range(len(sent), 0, -1):
            for axes in combinations(sent, count):
                with suppress(UserError):  # an interval that the model has no tables for
                    yield warmed(make_tables(model, block / interval_s, axes, target, 1.0 / interval_s), start).id
