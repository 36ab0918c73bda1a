"""Snapshots through the bindings: the format as a reader of another language sees it, and records cut anywhere.

Truth: a bank that was never stopped, bit for bit; the format's description in lib/snapshot.c; zlib's CRC-32.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from selfcal.bank.library import Bank
from selfcal.model.file import Model, Regressor
from selfcal.model.tables import Tables, make_tables

#: 10 Hz averaged to 1 Hz, two axes of the gyro.
AXES = ("gx", "gy")
SAMPLES = 3000
HEADER = struct.Struct("<4sIHBBHHII")


def tables() -> Tables:
    return make_tables(Model.load(), 10.0, AXES, "cortex-m4f")


def record() -> tuple[np.ndarray, np.ndarray]:
    """Samples [n, 2] with a random walk, NaN and saturated ones among them; missing ones before each [n], up to 2 h."""
    rng = np.random.default_rng(3)
    drift = np.cumsum(rng.normal(0.0, 1e-3, (SAMPLES, 2)), axis=0)
    samples = (0.1 + drift + rng.normal(0.0, 0.05, (SAMPLES, 2))).astype(np.float32)
    samples[rng.integers(0, SAMPLES, 40), 0] = np.nan
    samples[rng.integers(0, SAMPLES, 40), 1] = 300.0
    missing = np.where(rng.random(SAMPLES) < 0.01, rng.integers(1, 200, SAMPLES), 0).astype(np.uint64)
    missing[SAMPLES // 2] = 72_000
    return samples, missing


def _build(double: bool) -> str:
    return "_library64" if double else "_library32"


@pytest.mark.parametrize("double", [False, True], ids=["float", "double"])
def test_restored_at_any_cut_the_rest_is_the_same(double: bool) -> None:
    """Bit for bit: equal snapshots at the end hold every bit of the state, and the reports are made from it."""
    samples, missing = record()
    whole = Bank(tables(), build=_build(double))
    # every sample of some blocks, and places all over the record
    cuts = sorted({*range(0, 25), *range(1500, 1525), *np.random.default_rng(4).integers(0, SAMPLES, 100).tolist()})
    snapshots = {}
    at = 0
    for cut in cuts:
        whole.push(samples[at:cut], missing[at:cut])
        snapshots[cut] = whole.raw.save()
        at = cut
    whole.push(samples[at:], missing[at:])
    end = whole.raw.save()
    counters = whole.raw.counters()
    assert counters["gaps"] > 50 and counters["blocks_part"] > 20 and sum(counters["saturated"]) > 20
    report = whole.report(1)
    for cut, snapshot in snapshots.items():
        bank = Bank(tables(), build=_build(double))
        bank.raw.restore(snapshot)
        assert bank.raw.sound
        assert bank.raw.save() == snapshot
        bank.push(samples[cut:], missing[cut:])
        assert bank.raw.save() == end, f"cut at sample {cut}"
    assert bank.report(1) == report


def test_the_header_and_checksum_are_those_of_the_format() -> None:
    """Truth: the format's description in lib/snapshot.c, and zlib's CRC-32."""
    made = tables()
    for double, real in ((False, 4), (True, 8)):
        bank = Bank(made, build=_build(double))
        samples, missing = record()
        bank.push(samples, missing)
        snapshot = bank.raw.save()
        magic, length, version, size, axes, nodes, zero, model, _ = HEADER.unpack_from(snapshot)
        assert (magic, length, version, size) == (b"SFCL", len(snapshot), 3, real)
        assert (axes, nodes, zero, model) == (len(AXES), bank.raw.nodes, 0, made.id)
        assert struct.unpack("<I", snapshot[-4:])[0] == zlib.crc32(snapshot[:-4])
        (x,) = struct.unpack("<f" if real == 4 else "<d", snapshot[-4 - real : -4])
        assert np.isfinite(x) and x != 0.0  # the last axis's drift as the last node predicts it


def test_flips_and_truncations_are_refused_and_change_nothing() -> None:
    samples, missing = record()
    bank = Bank(tables())
    bank.push(samples, missing)
    snapshot = bank.raw.save()
    other = Bank(tables())
    other.push(samples[:777], missing[:777])
    before = other.raw.save()
    rng = np.random.default_rng(5)
    for bit in [*range(8 * HEADER.size), *rng.integers(8 * HEADER.size, 8 * len(snapshot), 2000).tolist()]:
        flipped = bytearray(snapshot)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError):
            other.raw.restore(bytes(flipped))
    for length in range(len(snapshot)):
        with pytest.raises(ValueError, match="truncated"):
            other.raw.restore(snapshot[:length])
    with pytest.raises(ValueError, match="longer"):
        other.raw.restore(snapshot + b"\0")
    assert other.raw.save() == before


def test_builds_and_models_refuse_each_others_snapshots() -> None:
    made = tables()
    other_model = make_tables(Model.load(), 20.0, AXES, "cortex-m4f")
    for double in (False, True):
        bank = Bank(made, build=_build(double))
        for stranger in (Bank(made, build=_build(not double)), Bank(other_model, build=_build(double))):
            with pytest.raises(ValueError, match="not a snapshot of this model and build"):
                stranger.raw.restore(bank.raw.save())


@pytest.mark.parametrize("double", [False, True], ids=["float", "double"])
def test_a_bank_with_regressors_goes_on_bit_for_bit(double: bool) -> None:
    """As above, with two columns beside the constant: their sums and averagers are state as well."""
    model = replace(
        Model.load(),
        regressors=(
            Regressor("temperature", "column", "degC", {"gyro": 0.05, "accel": 0.05}, column="temp", reference=25.0),
            Regressor("time", "time", "s", {"gyro": 3e-4, "accel": 3e-4}),
        ),
    )
    made = make_tables(model, 10.0, AXES, "cortex-m4f")
    samples, missing = record()
    z = np.column_stack([20.0 + 5.0 * np.sin(np.arange(SAMPLES) / 300.0), np.arange(SAMPLES) / 10.0]).astype(np.float32)
    whole = Bank(made, build=_build(double))
    whole.push(samples, missing, z)
    end, report = whole.raw.save(), whole.report(0, mask=3)
    for cut in (0, 1, 7, 160, 1501, 1507, 2999):
        bank, other = Bank(made, build=_build(double)), Bank(made, build=_build(double))
        bank.push(samples[:cut], missing[:cut], z[:cut])
        other.raw.restore(bank.raw.save())
        other.push(samples[cut:], missing[cut:], z[cut:])
        assert other.raw.save() == end, f"cut at sample {cut}"
        assert other.report(0, mask=3) == report
