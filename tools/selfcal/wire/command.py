"""`selfcal command`: an order to a module whose image takes commands (port/app/command.h)."""

from __future__ import annotations

import secrets
import shlex
import struct
import time
from pathlib import Path
from typing import TYPE_CHECKING

from selfcal import _firmware
from selfcal.base.errors import UserError, called
from selfcal.base.limits import MOST_META_BYTES, read_text
from selfcal.wire.dbc_file import NODE_IDS
from selfcal.wire.frames import ANSWER, AXES, COMMAND, Decoder, Link, choices, load_dbc, node_of

if TYPE_CHECKING:
    import can

CHALLENGE = "challenge"
#: Timeout of a challenge, and of an answer, s: a module obeys between reports, and a Cortex-M0's report takes 200 s.
CHALLENGE_S, ANSWER_S = 5.0, 400.0
#: Pause of a module after a challenge or a wrong tag, s.
PAUSE_S = 1.0
#: Limits of the telemetry's period, ms.
PERIODS_MS = (100, 2**24 - 1)
#: A key: two numbers of 64 bits.
KEY = struct.Struct("<2Q")
#: Note on every answer: whoever is on the wire can give it.
UNVERIFIED = "unverified: an answer has a checksum, but no tag"
#: Orders that go to no module.
OWN_ORDERS = ("new-key", "build-flag")


def siphash(key: bytes, message: int) -> int:
    """SipHash-2-4 of 8 bytes under a key of 16 (Aumasson & Bernstein, INDOCRYPT 2012), as the module has it."""
    return int(_firmware.siphash(*KEY.unpack(key), message))


def codes(signal: str) -> dict[str, int]:
    """Names of an answer's `command` or `result`, with their numbers in the DBC."""
    return {name: number for number, name in choices(ANSWER, signal).items()}


def payload(command: str, argument: int = 0, *, key: bytes | None = None, challenge: int = 0) -> bytes:
    """The 8 bytes of a command; `key` and `challenge` make its tag, the request for a challenge has none."""
    said = struct.pack("<I", codes("command")[command] | argument << 8)
    tag = siphash(key, challenge | int.from_bytes(said, "little") << 32) & 0xFFFFFFFF if key is not None else 0
    return said + struct.pack("<I", tag)


def frame(data: bytes, node: int = 0) -> can.Message:
    """A message COMMAND to a node."""
    import can

    identifier = load_dbc().get_message_by_name(COMMAND).frame_id + NODE_IDS * node
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def read_key(path: Path | str) -> bytes:
    """A key file: 32 hexadecimal digits. Raises UserError for anything else."""
    try:
        key = bytes.fromhex(read_text(Path(path), MOST_META_BYTES, "no key").strip())
        KEY.unpack(key)
    except FileNotFoundError as error:
        make = f"{called()} command new-key --key {shlex.quote(str(path))}"
        raise UserError(f"{path}: there is no such key; --key names the module's, `{make}` makes one") from error
    except OSError as error:
        raise UserError(f"{path}: cannot read the key: {error.strerror}") from error
    except (ValueError, struct.error) as error:
        raise UserError(f"{path}: a key is {2 * KEY.size} hexadecimal digits") from error
    return key


def new_key(path: Path | str) -> None:
    """Write a random key, for the owner alone to read. Raises UserError if the file is there or cannot be written."""
    try:
        Path(path).touch(mode=0o600, exist_ok=False)
        Path(path).write_text(secrets.token_hex(KEY.size) + "\n", encoding="ascii")
    except OSError as error:
        raise UserError(f"{path}: cannot write the key: {error.strerror}") from error


def build_flag(key: bytes) -> str:
    """The entry of CFLAGS that gives an image this key."""
    low, high = KEY.unpack(key)
    return f"-DAPP_COMMAND_KEY=0x{low:016X}ULL,0x{high:016X}ULL"


def argument_of(order: str, value: str | None) -> int:
    """The number that goes with an order: ms, axes (`gx,gz`; `none` takes offsets back), a start, or nothing."""
    if order == "telemetry_period":
        least, most = PERIODS_MS
        if value is None or not value.isdecimal() or not least <= int(value) <= most:
            raise UserError(f"telemetry_period wants a number of ms from {least} to {most}")
        return int(value)
    if order == "write_offsets":
        names = [] if value == "none" else (value or "").split(",")
        unknown = [name for name in names if name not in AXES]
        if unknown:
            raise UserError(f"write_offsets wants axes ({','.join(AXES)}) or none, not '{value or ''}'")
        return sum(1 << AXES.index(name) for name in set(names))
    if order == "tumble":
        if value not in ("start", "stop"):
            raise UserError(f"tumble wants start or stop, not '{value or ''}'")
        return int(value == "start")
    if order == "reset" and value == "forget":
        return 1
    if value is not None:
        raise UserError(f"{order} takes {'no word but forget' if order == 'reset' else 'nothing'} after it")
    return 0


def answer_in(link: Link, signal: str, timeout_s: float, about: int, node: int) -> int | None:
    """A signal of the answer, None if it is another; raises UserError if none comes within `timeout_s`."""
    decoder = Decoder(node=node)
    end = time.monotonic() + timeout_s
    while (left := end - time.monotonic()) > 0 and not link.closed:
        message = link.recv(left)
        if message is None:
            break
        if node_of(message.arbitration_id) == node:
            decoder.feed(message)
        if decoder.foreign:
            raise UserError(decoder.foreign)
        if signal in decoder.answer:
            return int(decoder.answer[signal])
        if decoder.answer.get("command") == about:
            return None
        decoder.answer.clear()
    if signal == "result":
        raise UserError(f"the module gave a challenge, but no word within {timeout_s:g} s of what came of the command")
    raise UserError("the module does not answer: is its image built with a command key?")
