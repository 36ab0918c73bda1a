"""A driver of port/sensors, compiled for this machine, with a main loop around it and a model of its part."""

from __future__ import annotations

import ctypes
import random
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from conftest import ROOT

STATES = ("off", "starting", "running", "failed")
NONE, ABSENT, SET_UP, SELF_TEST, SILENT, NO_DATA, STUCK = range(7)
Six = ctypes.c_float * 6
Bytes = ctypes.POINTER(ctypes.c_uint8)

SHIM = """
#include "NAME.h"
const sensor_t *shim_sensor(void) { return &NAME; }
int shim_state(void) { return (int)NAME.state->condition; }
int shim_fault(void) { return (int)NAME.state->fault; }
const sensor_counters_t *shim_counters(void) { return &NAME.state->counters; }
float shim_side(unsigned channel) { return NAME.side(NAME.state, channel); }
"""


@dataclass
class Clock:
    """What a part's model takes of a machine."""

    time_us: float = 0.0
    random: random.Random = field(default_factory=lambda: random.Random(1))
    violations: list[str] = field(default_factory=list)


class Bus(ctypes.Structure):
    """sensor_bus_t."""

    TIME = ctypes.CFUNCTYPE(ctypes.c_uint64)
    TIME_32 = ctypes.CFUNCTYPE(ctypes.c_uint32)
    OPEN = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
    EXCHANGE = ctypes.CFUNCTYPE(ctypes.c_bool, Bytes, Bytes, ctypes.c_size_t)
    RESET = ctypes.CFUNCTYPE(None, ctypes.c_bool)
    CHOOSE = ctypes.CFUNCTYPE(None, ctypes.c_uint8)
    TRANSFER = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_uint8, Bytes, ctypes.c_size_t, Bytes, ctypes.c_size_t)
    _fields_ = (
        ("time_us", TIME), ("time_us32", TIME_32), ("open", OPEN), ("exchange", EXCHANGE), ("begin", EXCHANGE),
        ("reset_line", RESET), ("choose", CHOOSE), ("transfer", TRANSFER),
    )  # fmt: skip


class Counters(ctypes.Structure):
    """sensor_counters_t."""

    NAMES = ("samples", "stale", "repeated", "alarms", "damaged", "anomalies", "overruns", "faults")
    _fields_ = tuple((name, ctypes.c_uint32) for name in NAMES)


def compile_c(folder: Path, sources: list[Path], include: list[Path]) -> ctypes.CDLL:
    """A library of C files, checked for undefined behaviour as it runs."""
    warnings = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wdouble-promotion", "-Werror")
    checked = ("-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    command = ["gcc", "-std=c99", "-O1", *warnings, *checked, "-shared", "-fPIC", *(f"-I{path}" for path in include)]
    subprocess.run([*command, *map(str, sources), "-lm", "-o", str(folder / "made.so")], check=True)
    return ctypes.CDLL(str(folder / "made.so"))


def compile_driver(folder: Path, name: str) -> ctypes.CDLL:
    """port/sensors/NAME.c with sensor.c, and functions that look into it."""
    (folder / "shim.c").write_text(SHIM.replace("NAME", name), encoding="utf-8")
    sensors = ROOT / "port" / "sensors"
    loaded = compile_c(folder, [sensors / "sensor.c", sensors / f"{name}.c", folder / "shim.c"], [sensors])
    loaded.shim_counters.restype = ctypes.POINTER(Counters)
    loaded.shim_sensor.restype = ctypes.c_void_p
    loaded.shim_side.restype = ctypes.c_float
    for call in ("open", "read", "offsets"):
        getattr(loaded, f"sensor_{call}").restype = ctypes.c_bool
    loaded.sensor_open.argtypes = (ctypes.c_void_p, ctypes.POINTER(Bus), ctypes.c_float)
    return loaded


class Product:
    """A main loop around the driver: it comes by every `loop_us` and takes what waits. A child gives exchange(),
    choose() or transfer()."""

    def __init__(
        self, library: ctypes.CDLL, part: Callable[[Clock], Any], rate_hz: float, loop_us: float = 3000.0
    ) -> None:
        self.clock = Clock()
        self.part = part(self.clock)
        self.library, self.loop_us = library, loop_us
        self.sensor = ctypes.c_void_p(library.shim_sensor())
        self.bus = Bus(
            Bus.TIME(lambda: int(self.clock.time_us)), Bus.TIME_32(lambda: int(self.clock.time_us) & 0xFFFFFFFF),
            Bus.OPEN(lambda wire: None), Bus.EXCHANGE(self.exchange), Bus.EXCHANGE(), Bus.RESET(),
            Bus.CHOOSE(self.choose), Bus.TRANSFER(self.transfer),
        )  # fmt: skip
        self.broken = False
        #: Reading and missing samples before it, each.
        self.taken: list[tuple[tuple[float, ...], int]] = []
        self.known = library.sensor_open(self.sensor, ctypes.byref(self.bus), rate_hz)

    def exchange(self, out: Any, into: Any, count: int) -> bool:
        """SPI."""
        raise NotImplementedError

    def choose(self, chip: int) -> None:
        """SPI."""
        raise NotImplementedError

    def transfer(self, address: int, out: Any, written: int, into: Any, wanted: int) -> bool:
        """I2C."""
        raise NotImplementedError

    def run(self, seconds: float) -> None:
        """Let time go by."""
        end = self.clock.time_us + 1e6 * seconds
        reading, missing = Six(), ctypes.c_uint32()
        while self.clock.time_us < end:
            self.library.sensor_poll(self.sensor)
            while self.library.sensor_read(self.sensor, reading, ctypes.byref(missing)):
                self.taken.append((tuple(reading), missing.value))
            self.clock.time_us += self.loop_us

    def until(self, state: str, seconds: float) -> None:
        """Run until a state; fails after so many seconds."""
        end = self.clock.time_us + 1e6 * seconds
        while self.state != state:
            assert self.clock.time_us < end, (self.state, self.fault)
            self.run(1e-6)

    @property
    def state(self) -> str:
        """One of STATES."""
        return STATES[self.library.shim_state()]

    @property
    def fault(self) -> int:
        """The last one."""
        return int(self.library.shim_fault())

    @property
    def counters(self) -> Counters:
        """The driver's own."""
        return self.library.shim_counters().contents  # type: ignore[no-any-return]
