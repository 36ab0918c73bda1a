"""Frames made by the C code (tests/c/telemetry_stream.c), and a pseudo-terminal to send them over."""

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
    sources = ["tests/c/telemetry_stream.c", "lib/telemetry.c", "port/app/slcan.c"]
    command = [os.environ.get("CC", "cc"), "-std=c99", "-O1", "-Ilib", "-Iport", "-Iport/app", "-o", str(program)]
    subprocess.run([*command, *sources, "-lm"], cwd=ROOT, check=True)
    return program


@lru_cache(maxsize=4)
def stream(seed: int, reports: int, hypotheses: int = 3, slow_ms: int = 0) -> tuple[Sent, ...]:
    """All that the C code sends for `reports` random reports of six axes, of which each takes `slow_ms`."""
    command = [str(_program()), str(seed), str(reports), str(hypotheses), str(slow_ms)]
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
            message = {0x200: "STATUS", 0x201: "GX", 0x202: "GY", 0x203: "GZ", 0x204: "AX", 0x205: "AY", 0x206: "AZ"}[
                int(rest[1:4], 16)
            ]
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
