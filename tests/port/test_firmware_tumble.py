"""The image of the STM32F405 calibrates itself: commands, telemetry, saved state, corrected samples.

Truth: the part that a hand turns, of host_sim/parts/turned.py, with scales, angles, biases and g-sensitivities of the
test's own. The user does as telemetry says.
"""

from __future__ import annotations

import math

import numpy as np
from firmware import AXES, Board, image, messages
from parts.icm42688 import Icm42688
from parts.turned import Turned
from test_firmware_commands import KEY, RESULT, challenge, new_answers

from selfcal.wire import command as verb
from selfcal.wire.frames import Decoder, tumble_text

RATE_HZ, BANK_HZ = 25.0, 0.5
FLAGS = f"-DBOARD_REPORT_MS=900000 -DAPP_CORRECTED_MS=500 -DSELFCAL_MODEL_TUMBLED=1 {verb.build_flag(KEY)}"
#: N of the part, deg/s and m/s^2 in sqrt(s): the data sheet's.
N = (0.002, 4.9e-4)
REFUSED, DAMAGED = 3, 7
HEADER = 32  # bytes of a slot's header; its third word is the length of what follows


class User:
    """Somebody with the part in the hand and telemetry before the eyes."""

    def __init__(self, part: Turned, name: str = "tumble", flags: str = FLAGS) -> None:
        elf = image(
            name, flags, quiet=True, bank_hz=BANK_HZ, laws=("constant", "random_walk"), rate_hz=RATE_HZ,
            sensor="icm42688",
        )  # fmt: skip
        self.part = part
        self.board = Board(elf, seed=41, sensor=lambda machine: Icm42688(machine, part))
        self.decoder, self.read = Decoder(), 0
        self.corrected: list[dict[str, float]] = []

    def wait(self, seconds: float) -> None:
        """Time goes by, frames are read."""
        self.board.run(seconds)
        for message in messages(self.board, self.read):
            self.decoder.feed(message)
            if "motion" in self.decoder.corrected:
                self.corrected.append(self.decoder.corrected)
                self.decoder.corrected = {}
        self.read = len(self.board.frames)

    def order(self, name: str, argument: int = 0, seconds: float = 0.1) -> int:
        """Give a command; its result."""
        data = verb.payload(name, argument, key=KEY, challenge=challenge(self.board))
        since = len(self.board.frames)
        self.board.can.say(0x208, data)
        self.wait(seconds)
        (result,) = (int(one["result"]) for one in new_answers(self.board, since) if "result" in one)
        return result

    @property
    def told(self) -> str:
        """What the monitor says of the calibration."""
        return tumble_text(self.decoder.tumble)

    def place(self, side: str) -> None:
        """Turn the part until this side, as `+x -y up`, is up, and wait until its rest counts."""
        rests = self.decoder.tumble["rests"]
        self.part.to([side.count(f"+{axis}") - side.count(f"-{axis}") for axis in "xyz"])
        for _ in range(30):
            self.wait(1.0)
            if self.decoder.tumble["rests"] > rests:
                return
        raise AssertionError(f"no rest at {side}: {self.told}")

    def learn(self) -> None:
        """At rest for long enough: one report of all axes, and no other within the test."""
        assert self.order("telemetry_period", 4000) == RESULT["done"]
        for _ in range(20):
            self.wait(1.0)
            if self.corrected and "sd_gz" in self.corrected[-1]:
                break
        assert self.order("telemetry_period", 900_000) == RESULT["done"]

    def rest_at(self, up: tuple[float, float, float]) -> tuple[dict[str, float], dict[str, float], int]:
        """Means and last sd of the corrected readings at rest in an attitude, and their number."""
        self.part.to(up)
        self.wait(3.0)
        self.corrected.clear()
        self.wait(8.0)
        kept = [one for one in self.corrected if "sd_az" in one]
        mean = {axis: float(np.mean([one.get(f"corrected_{axis}", math.nan) for one in kept])) for axis in AXES}
        return mean, {axis: kept[-1].get(f"sd_{axis}", math.nan) for axis in AXES}, len(kept)


def turned(seed: int) -> Turned:
    """A part with errors of a low price, and its data sheet's noise."""
    T = np.array([[1.0, -0.024, 0.011], [0.0, 1.0, 0.019], [0.0, 0.0, 1.0]])
    G = np.array([[0.0024, -0.0011, 0.0006], [0.0013, -0.0019, 0.0022], [-0.0004, 0.0015, 0.0031]])
    noise = (N[0] * math.sqrt(RATE_HZ), N[1] * math.sqrt(RATE_HZ))
    return Turned(
        RATE_HZ, T * [0.987, 1.014, 1.006], np.array([-0.27, 0.18, 0.41]), np.array([0.35, -0.6, 0.2]), G, noise, seed
    )  # fmt: skip


#: None of the twelve positions.
ATTITUDES = [(0.3, -0.5, 0.8), (-0.7, 0.6, -0.2), (0.5, 0.6, -0.62)]


def compare(user: User) -> None:
    """Corrected accelerations are the true ones, and gyros show no force, in attitudes that were not among the rests.

    Tolerance: five standard deviations of the mean of the compared readings and of what the module itself tells of its
    calibration. The readings' step, g/8192, is dithered by noise of twice its size. A gyro's told sd is of its bias;
    G (f - f0), of forces up to 2 g apart, adds 2 g times the sd of its row: twice N / sqrt(10 s) over the root of
    6 rests along an axis. An uncorrected reading is off by 0.2 m/s^2 and 0.02 deg/s.
    """
    for up in ATTITUDES:
        mean, sd, count = user.rest_at(up)
        assert count > 10
        force = user.part.gravity * np.asarray(up) / np.linalg.norm(up)
        for k, axis in enumerate(("ax", "ay", "az")):
            noise = N[1] * math.sqrt(RATE_HZ / count)
            assert sd[axis] < 5e-3, axis  # a square of the scale of 0.5 mg at 1 g stands in it
            assert abs(mean[axis] - force[k]) < 5.0 * math.hypot(noise, sd[axis]), (axis, up)
        for axis in ("gx", "gy", "gz"):
            noise, turned = N[0] * math.sqrt(RATE_HZ / count), 2.0 * 2.0 * N[0] / math.sqrt(60.0)
            assert abs(mean[axis]) < 5.0 * math.sqrt(noise**2 + sd[axis] ** 2 + turned**2), (axis, up)


def test_a_part_is_calibrated_in_the_hand() -> None:
    """Twelve positions by telemetry; the result is saved, corrects, and outlives a power cut. A damaged one is refused
    with its state, and corrects nothing."""
    user = User(turned(5))
    user.wait(1.0)
    assert user.order("tumble", 1) == RESULT["done"]
    assert user.told == "0 of 12: now +z up"
    sides = []
    while "now" in user.told:
        count, side = user.told.split(": now ")
        assert count == f"{len(sides)} of 12"
        sides.append(side)
        user.place(side)
        if len(sides) == 2:
            assert user.order("write_offsets", 0) == RESULT["not_now"]
    assert user.told == "12 of 12: send tumble stop"
    assert {side.count(" ") for side in sides[:6]} == {1} and len(set(sides[:6])) == 6  # the six faces first
    assert user.order("tumble", 0, 4.0) == RESULT["done"]
    told, part = user.decoder.tumble, user.part
    T, K = part.matrix / np.diag(part.matrix), np.diag(part.matrix)
    truth = {f"bias_{axis}": part.bias[k] for k, axis in enumerate("xyz")}
    truth |= {f"scale_{axis}": K[k] - 1.0 for k, axis in enumerate("xyz")}
    truth |= {"angle_xy": T[0, 1], "angle_xz": T[0, 2], "angle_yz": T[1, 2]}
    for name, value in truth.items():  # nine at once: 5 sd of each
        assert abs(told[name] - value) < 5.0 * told[f"{name}_sd"], name
    # G: the sd of a row is N / sqrt(10 s) over the root of the rests' sum of squares along an axis, some 4 g^2
    for i, j in np.ndindex(3, 3):
        assert abs(told[f"g_{'xyz'[i]}{'xyz'[j]}"] - 9.80665 * part.G[i, j]) < 5.0 * N[0] / math.sqrt(10.0 * 4.0)
    assert (told["applied"], told["result"], user.told) == (1, 0, "")
    last, board = tuple(part.up), user.board
    user.wait(14.0)
    user.learn()
    compare(user)
    kept = board.retained()
    part.to(last)
    board.power_cycle(kept)
    user.wait(10.0)
    user.learn()
    assert user.decoder.tumble["applied"] == 1
    assert user.decoder.tumble["bias_x"] == told["bias_x"]
    compare(user)
    # a bit of the one saved state's calibration, with which it ends
    damaged = bytearray(kept)
    (start,) = (slot * board.STRIDE for slot in range(2) if kept[slot * board.STRIDE] != 0xFF)
    damaged[start + HEADER + int.from_bytes(kept[start + 8 :][:4], "little") - 100] ^= 4
    board.power_cycle(bytes(damaged))
    user.wait(12.0)
    assert (user.decoder.status["state_found"], user.decoder.status["state_refused"]) == (REFUSED, DAMAGED)
    assert user.decoder.tumble["applied"] == 0 and "bias_x" not in user.decoder.tumble
    assert not board.machine.violations and not board.machine.faults


def test_what_comes_to_nothing() -> None:
    """A stop without a start, one after two positions, and a power cut in between: each with its word, and nothing is
    applied or saved."""
    user = User(turned(6))
    user.wait(1.0)
    assert user.order("tumble", 0) == RESULT["not_now"]
    assert user.order("tumble", 2) == RESULT["out_of_range"]
    assert user.order("tumble", 1) == RESULT["done"]
    for side in ("+z up", "+x up"):
        user.place(side)
    assert user.decoder.tumble["rests"] == 2
    assert user.order("tumble", 0) == RESULT["failed"]
    assert user.told == "no calibration, too few: send tumble start"
    assert user.order("tumble", 1) == RESULT["done"]
    user.place("+y up")
    assert user.told.startswith("1 of 12: now ")
    user.board.power_cycle()
    user.wait(2.0)
    assert (user.told, user.decoder.tumble["applied"], user.decoder.tumble["rests"]) == ("", 0, 0)
    assert user.board.value("app.told.state_saves") == 0
    assert user.order("tumble", 0) == RESULT["not_now"]
    assert not user.board.machine.violations and not user.board.machine.faults


def test_an_image_without_it() -> None:
    """The command is unknown to an image that was not built with it, and no message speaks of it."""
    user = User(turned(7), "tumble-without", FLAGS.replace("-DSELFCAL_MODEL_TUMBLED=1 ", ""))
    user.wait(1.0)
    assert user.order("tumble", 1) == RESULT["unknown"]
    assert not user.decoder.tumble
    assert not [symbol for symbol in user.board.machine.symbols if "tumble" in symbol and symbol.startswith("selfcal")]
