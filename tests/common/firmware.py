"""The images for the tests: built as `make firmware` builds them, run on the boards of host_sim/parts."""

from __future__ import annotations

import fcntl
import os
import subprocess
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import can
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from selfcal.model.file import PARTS_FOLDER, Model
from selfcal.verbs.codegen import codegen
from selfcal.wire.frames import AxisReport, Decoder

from conftest import CAMPAIGN

ROOT = Path(__file__).resolve().parents[2]

parts = pytest.importorskip("parts.board", reason="unicorn or pyelftools is missing: make setup-dev")
Board = parts.Board
NrfBoard = parts.NrfBoard
import image_sizes  # noqa: E402  of tests/bench
from unicorn import UC_HOOK_CODE, Uc  # noqa: E402  after the check that it is there
from unicorn import arm_const as arm  # noqa: E402

CORES = {name: core for name, (core, _, _) in image_sizes.BOARDS.items()}
T = TypeVar("T")
AXES = ("gx", "gy", "gz", "ax", "ay", "az")
#: Of a fault campaign's trials; the rows of `make campaigns` go to build/campaigns.txt as well.
MANY = CAMPAIGN

#: SELFCAL_EXTENDED=1 runs the suites with a model as `diagnose` extends it: two columns and the outlier gate.
EXTENDED = os.environ.get("SELFCAL_EXTENDED", "") == "1"
EXTENSION = {
    "handle": {"outlier_sd": 6.0},
    "regressors": [
        {"name": "warmth", "kind": "column", "column": "temp", "unit": "degC", "reference": 25, "sd": {"gyro": 0.5}},
        {"name": "supply", "kind": "column", "column": "supply", "unit": "V", "reference": 5, "sd": {"gyro": 10.0}},
    ],
}


def often(trials: int) -> int:
    """`make test` runs a quarter of a campaign's trials; `make campaigns` MANY times all of them."""
    return MANY * trials if MANY > 1 else (trials + 3) // 4


def some(every: Sequence[T], *chosen: T) -> Sequence[T]:
    """Parameters of a test: `chosen` in `make test`, all of them in `make campaigns`."""
    return every if MANY > 1 else chosen


#: A model whose bank takes no sample within a test, so that no report is made and time goes by fast. The slowest rate
#: at which the sensor takes the clock of the default model; at SLOW_RATE_HZ it wants a slower one.
QUIET_RATE_HZ = 163.84
SLOW_RATE_HZ = 102.4
QUIET_BANK_HZ = 0.01


@lru_cache
def image(
    name: str,
    flags: str = "",
    quiet: bool = False,
    bank_hz: float = QUIET_BANK_HZ,
    laws: tuple[str, ...] = ("constant", "random_walk", "gauss_markov"),
    target: str = "stm32f405",
    rate_hz: float = QUIET_RATE_HZ,
    node: int | None = None,
    sensor: str = image_sizes.SENSOR,
) -> Path:
    """The ELF file of a configuration, made if it is not there or older than a source. `quiet`: at `rate_hz`, bank at
    `bank_hz`, these `laws` (a report of Gauss-Markov takes the emulator seconds). `node`: its number on its bus.
    `sensor`: one of port/sensors, with the model file of its name, or the path of a driver."""
    folder = ROOT / "build" / "firmware" / (f"{name}-extended" if EXTENDED else name)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        model = Model.load().path
        if sensor != image_sizes.SENSOR:
            own = "/" in sensor  # a driver elsewhere, with its model file beside it
            room, driver = (Path(sensor).parent, Path(sensor).stem) if own else (PARTS_FOLDER, sensor)
            [model] = room.glob(f"{driver}*.yaml")
        document = yaml.safe_load(model.read_text())
        if quiet:
            document["bank_rate_hz"] = bank_hz
            document["hypotheses"] = dict.fromkeys(laws, 1)
        if EXTENDED:
            document |= EXTENSION
        (folder / "model.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
        codegen(folder / "model.yaml", folder / "new", target=CORES[target], rate=rate_hz if quiet else None)
        for file in (folder / "new").iterdir():
            old = folder / file.name
            if not old.exists() or old.read_bytes() != file.read_bytes():
                old.write_bytes(file.read_bytes())
        makefile = f"port/{target}/{target}.mk"
        command = ["make", "-s", "-f", makefile, target, f"MODEL_DIR={folder}", f"OUT={folder}"]
        command += [f"SENSOR={sensor}"]
        command += [] if node is None else [f"NODE={node}"]
        subprocess.run([*command, f"CFLAGS={flags}"], cwd=ROOT, check=True)
    return folder / "selfcal.elf"


def tell(name: str, trials: int, survived: int, more: str = "") -> None:
    """A row of the table of campaigns."""
    row = f"{name:40} {trials:>9,} {survived:>9,}   {more}".rstrip()
    print(f"\n{row}")
    if MANY > 1:
        with (ROOT / "build" / "campaigns.txt").open("a") as file:
            file.write(row + "\n")


def reports(frames: list[can.Message]) -> tuple[Decoder, list[AxisReport]]:
    """What the host's decoder makes of frames that were watched from the start."""
    decoder = Decoder(from_start=True)
    found = [report for frame in frames for report in decoder.feed(frame)]
    return decoder, found


def messages(board: parts.Board, since: int = 0) -> list[can.Message]:
    """The frames heard on the CAN bus, from the `since`-th on."""
    return [
        can.Message(timestamp=us / 1e6, arbitration_id=frame[0], data=frame[1], is_extended_id=False)
        for us, frame in board.frames[since:]
    ]


def status(board: parts.Board) -> dict[str, float]:
    """The last status heard."""
    return reports(messages(board))[0].status


def set_up(board: parts.Board | parts.NrfBoard) -> dict[int, int]:
    """The sensor's MSC_CTRL, SMPL_PRD and SENS_AVG."""
    return {address: board.sensor.registers[address] for address in (0x34, 0x36, 0x38)}


def readings(samples: list[tuple[int, ...]]) -> NDArray[np.float32]:
    """LSB to deg/s and m/s^2 as the data sheet scales them, in the driver's float arithmetic [n, 6]."""
    scale = np.array([0.05] * 3 + [0.032656145] * 3, dtype=np.float32)
    return np.array(samples, dtype=np.float32) * scale


class Tap:
    """What the application gives to the library: every selfcal_push() with its place on the sensor's count of samples,
    found by what that, selfcal_push_moving() and selfcal_skip() have been given before. With a gate also what came to
    that, `seen`: samples missing, and the sample. Watches only."""

    def __init__(self, board: parts.Board) -> None:
        self.board = board
        self.place = -1
        self.pushed: list[tuple[int, tuple[float, ...]]] = []
        self.skips: list[int] = []
        self.seen: list[tuple[int, tuple[float, ...]]] = []
        self.intervals: list[int] = []  # place of the last sample of each bank sample
        self._missing = 0
        hooks = {
            "selfcal_push_with": self._push,
            "selfcal_push_moving": self._move,
            "selfcal_skip": self._skip,
            "selfcal_gate_push": self._see,
            "selfcal_gate_skip": self._miss,
            "selfcal_bank_sample": lambda *_: self.intervals.append(self.place),
        }
        for name, call in hooks.items():
            address = board.machine.symbols[name] & ~1
            board.machine.uc.hook_add(UC_HOOK_CODE, call, None, address, address)

    def _push(self, uc: Uc, address: int, size: int, data: object) -> None:
        self.place += 1
        sample = np.frombuffer(bytes(uc.mem_read(uc.reg_read(arm.UC_ARM_REG_R1), 24)), dtype="<f4")
        self.pushed.append((self.place, tuple(sample.tolist())))

    def _move(self, uc: Uc, address: int, size: int, data: object) -> None:
        self.place += 1
        self.skips.append(1)

    def _see(self, uc: Uc, address: int, size: int, data: object) -> None:
        sample = np.frombuffer(bytes(uc.mem_read(uc.reg_read(arm.UC_ARM_REG_R1), 24)), dtype="<f4")
        self.seen.append((self._missing, tuple(sample.tolist())))
        self._missing = 0

    def _miss(self, uc: Uc, address: int, size: int, data: object) -> None:
        self._missing += uc.reg_read(arm.UC_ARM_REG_R2) | uc.reg_read(arm.UC_ARM_REG_R3) << 32

    def _skip(self, uc: Uc, address: int, size: int, data: object) -> None:
        count = uc.reg_read(arm.UC_ARM_REG_R2) | uc.reg_read(arm.UC_ARM_REG_R3) << 32  # AAPCS: a 64-bit argument
        self.place += count
        self.skips.append(count)

    def _made(self, each: Iterable[T]) -> dict[tuple[float, ...], T]:
        """What belongs to each sample that the sensor made, by its readings."""
        rows = readings([sample for _, _, sample in self.board.sensor.taken]).tolist()
        return dict(zip(map(tuple, rows), each, strict=True))

    def wrong(self) -> int:
        """Pushed samples that are none of those the sensor made."""
        made = self._made(self.board.sensor.taken)
        return sum(sample not in made for _, sample in self.pushed)

    def foreign(self) -> int:
        """Pushed samples that the sensor made with other settings than the driver's."""
        sensor, value = self.board.sensor, self.board.value
        wanted = value("sensor.sample_period"), 0x0401  # 300 deg/s, two taps
        settings = self._made(sensor.made_with)
        return sum(settings[sample] != wanted for _, sample in self.pushed if sample in settings)

    def mistimed(self) -> int:
        """Steps between pushed samples that are more than one sample, and a thousandth of the step, off the time
        between the samples by the sensor's clock, at the rate it is to have: for a sensor that was reset, whose count
        then stood still."""
        sensor = self.board.sensor
        period = sensor.period_us() * (self.board.value("sensor.sample_period") + 1) / (sensor.registers[0x36] + 1)
        made = self._made(us for _, us, _ in sensor.taken)
        # of a sensor that stands still two repeats are taken: what it made is the first
        made_new = [pushed for k, pushed in enumerate(self.pushed) if k == 0 or pushed[1] != self.pushed[k - 1][1]]
        off = 0
        for (place, sample), (next_place, next_sample) in pairwise(made_new):
            true = (made[next_sample] - made[sample]) / period
            off += abs(next_place - place - true) > 1.0 + 1e-3 * true
        return off

    def misplaced(self, slack: int) -> int:
        """Pushed samples whose place is more than `slack` off the sensor's own count, taken from the first one on. One
        pair in 10^7 of samples at rest are equal in all axes: then either's place will do."""
        index: dict[tuple[float, ...], list[int]] = {}
        for number, _, sample in self.board.sensor.taken:
            index.setdefault(tuple(readings([sample])[0].tolist()), []).append(number)
        first = index[self.pushed[0][1]][0] - self.pushed[0][0]
        return sum(
            min(abs(number - first - place) for number in index[sample]) > slack
            for place, sample in self.pushed
            if sample in index
        )
