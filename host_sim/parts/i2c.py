"""An I2C bus at its two lines: what the master drives, what a device makes of it, and what can be wrong (UM10204)."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from .machine import Machine


@runtime_checkable
class Device(Protocol):
    """A device of 7 bits address."""

    address: int

    def begin(self, reading: bool) -> bool:
        """Its address came; False: not acknowledged."""

    def put(self, byte: int) -> bool:
        """A byte for it; False: not acknowledged."""

    def get(self) -> int:
        """A byte of it."""

    def end(self) -> None:
        """A stop."""


class I2cBus:
    """One device. A line is high where neither side pulls it."""

    def __init__(self, machine: Machine, device: Device) -> None:
        self.machine = machine
        self.device = device
        self.master = [True, True]  # SCL, SDA as the master has them: released
        self.mine = True  # SDA as the device has it
        self.held_until = 0.0  # SCL as the device has it, us
        self.shortest_us = float("inf")  # of the clock's low and high times
        self.changed_us = 0.0
        self.clocks = self.stops = 0
        # what can be wrong
        self.stretch_us = 0.0  # after each byte
        self.flip = 0.0  # chance that a bit is read wrong on either side
        self.flipped = 0
        self.held_clocks = 0  # the device holds SDA for so many clocks more
        self._idle()

    def _idle(self) -> None:
        self.active = self.addressed = self.reading = self.first = False
        self.bits: list[bool] = []
        self.byte = 0
        self.mine = True

    @property
    def scl(self) -> bool:
        """The clock's level."""
        return self.master[0] and self.machine.time_us >= self.held_until

    @property
    def sda(self) -> bool:
        """The data line's level."""
        return self.master[1] and self.mine and self.held_clocks == 0

    def release(self) -> None:
        """The master's pins are inputs, after a reset."""
        self.drive(0, True)
        self.drive(1, True)

    def power_on(self) -> None:
        """The device's supply has come."""
        self._idle()
        self.held_clocks = 0

    def drive(self, line: int, released: bool) -> None:
        """The master lets a line (0 SCL, 1 SDA) go, or pulls it."""
        if self.master[line] == released:
            return
        if line == 0:
            self._note_time()
        data = self.sda
        self.master[line] = released
        if line == 1:
            if self.master[0] and self.sda != data:
                self._start() if data else self._stop()
        elif released:
            self._rise()
        else:
            self._fall()

    def _note_time(self) -> None:
        now = self.machine.time_us
        self.shortest_us = min(self.shortest_us, now - self.changed_us)
        self.changed_us = now

    def _start(self) -> None:
        self._idle()
        self.active = self.first = True

    def _stop(self) -> None:
        self.stops += 1
        if self.addressed:
            self.device.end()
        self._idle()

    def _wrong(self, bit: bool) -> bool:
        if self.flip > 0.0 and self.machine.random.random() < self.flip:
            self.flipped += 1
            return not bit
        return bit

    def _rise(self) -> None:
        """Either side takes the bit."""
        self.clocks += 1
        if self.held_clocks > 0:
            self.held_clocks -= 1
        if self.active and (len(self.bits) < 8 or self.addressed):
            self.bits.append(self._wrong(self.sda))

    def _fall(self) -> None:
        """The device sets its line for the next bit: after eight its acknowledge, or what it sends."""
        if not self.active:
            return
        if len(self.bits) == 8:
            self.byte = sum(bit << 7 - i for i, bit in enumerate(self.bits))
            taken = self._take() if self.first or not self.reading else False  # the master acknowledges what it reads
            self.mine = not taken
            if not self.addressed:
                self.active = False
                self.mine = True
            self.held_until = self.machine.time_us + self.stretch_us if taken else 0.0
            return
        if len(self.bits) == 9:
            more = not self.bits[8]
            self.bits = []
            self.first = False
            self.mine = True
            if self.reading and more:
                self.byte = self.device.get()
            elif self.reading:
                self.active = False
        if self.reading and self.active and not self.first:
            self.mine = self._wrong(bool(self.byte >> 7 - len(self.bits) & 1))

    def _take(self) -> bool:
        if self.first:
            self.reading = bool(self.byte & 1)
            self.addressed = self.byte >> 1 == self.device.address and self.device.begin(self.reading)
            return self.addressed
        return self.device.put(self.byte)
