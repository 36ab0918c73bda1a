"""Frames made by the C code (tests/lib/telemetry_stream.c), and a pseudo-terminal to send them over."""

from __future__ import annotations

import os
import select
import subprocess
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import can

ROOT = Path(__file__).resolve().parents[2]
_folder = TemporaryDirectory(prefix="selfcal-wire-")


@dataclass(frozen=True)
class Sent:
    """One report or status as it went out: `truth` by signal name, `lines` SLCAN without the CR."""

    message: str
    truth: dict[str, float]
    lines: list[str]


@lru_cache(maxsize=1)
def _program() -> Path:
    program = Path(_folder.name) / "telemetry_stream"
    sources = ["tests/lib/telemetry_stream.c", "lib/telemetry.c", "port/app/slcan.c"]
    options = ["-std=c99", "-O1", "-Ilib", "-Iport", "-Iport/app", "-Itools/bindings", "-Itests/common"]
    command = [os.environ.get("CC", "cc"), *options, "-o", str(program), *sources, "-lm"]
    subprocess.run(command, cwd=ROOT, check=True)
    return program


#: Messages by the offset of their identifiers from the node's first one: the status, then by axis.
AXES = ("GX", "GY", "GZ", "AX", "AY", "AZ")
MESSAGES = {0: "STATUS"} | {1 + axis: name for axis, name in enumerate(AXES)}
MESSAGES |= {10 + axis: name for axis, name in enumerate(AXES)}
MESSAGES |= {32 + 8 * axis + k: name for axis, name in enumerate(AXES) for k in range(8)}


@lru_cache(maxsize=8)
def stream(
    seed: int, reports: int, hypotheses: int = 3, slow_ms: int = 0, columns: int = 0, node: int = 0
) -> tuple[Sent, ...]:
    """All that the C code sends for `reports` random reports of six axes, of which each takes `slow_ms`."""
    command = [str(_program()), *map(str, (seed, reports, hypotheses, slow_ms, columns, node))]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    sent: list[Sent] = []
    truth: dict[str, dict[str, float]] = {}
    last = ""
    for row in text.splitlines():
        kind, _, rest = row.partition(" ")
        if kind == "V":
            message, signal, number = rest.split(" ")
            truth.setdefault(message, {})[signal] = float(number)
        else:
            message = MESSAGES[int(rest[1:4], 16) - 0x200 - 128 * node]
            if message != last:
                sent.append(Sent(message, truth.pop(message, {}), []))  # none: a status between the reports
                last = message
            sent[-1].lines.append(rest)
    return tuple(sent)


def lines(sent: tuple[Sent, ...]) -> list[str]:
    """All SLCAN lines in order."""
    return [line for one in sent for line in one.lines]


def message(line: str) -> can.Message:
    """A sound SLCAN line as a python-can message."""
    return can.Message(arbitration_id=int(line[1:4], 16), is_extended_id=False, data=bytes.fromhex(line[5:]))


@contextmanager
def serial_line(data: bytes) -> Iterator[str]:
    """A pty whose other end sends `data` once the host has written SLCAN `O`; yields its path."""
    master, slave = os.openpty()
    tty.setraw(slave)
    stop = threading.Event()

    def run() -> None:
        heard = b""
        rest: bytes | None = None
        while not stop.is_set():
            ready, writable, _ = select.select([master], [master] if rest else [], [], 0.05)
            if ready:
                heard += os.read(master, 4096)
                if rest is None and heard.endswith(b"O\r"):
                    rest = data
            if writable and rest:
                rest = rest[os.write(master, rest[:1024]) :]

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        stop.set()
        thread.join()
        os.close(slave)
        os.close(master)
