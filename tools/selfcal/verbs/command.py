"""Have a module do something, if its image was built with a command key."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option


def command(
    order: Annotated[
        str,
        argument(
            "To a module: reset [forget], save, telemetry_period MS, write_offsets AXES|none, tumble start|stop. "
            "Of a key: new-key makes one, build-flag prints what an image is built with",
            "ORDER",
        ),
    ],
    value: Annotated[str | None, argument("As the order wants it", "VALUE")] = None,
    *,
    key_file: Annotated[Path | str, option("The module's key", "--key", metavar="FILE")] = "selfcal.key",
    interface: Annotated[str, option("python-can interface", metavar="NAME")] = "slcan",
    channel: Annotated[str, option("Channel: a serial port for slcan", metavar="NAME")] = "",
    bitrate: Annotated[int | None, option("Of the CAN bus, if it needs one", metavar="BIT/S")] = None,
    node: Annotated[int, option("The module's number on its bus, 0 to 11", metavar="N")] = 0,
) -> str:
    """Have the module of a node do `order`; returns its answer, the name of a result in the DBC. Nothing proves who
    gave it.

    Raises UserError for an order or argument that does not exist, a key that cannot be read, a channel that is not
    named or cannot be opened, or no answer.
    """
    from selfcal.wire import command as wire
    from selfcal.wire.dbc_file import check_node
    from selfcal.wire.frames import open_bus, serial_ports

    if order == "new-key":
        wire.new_key(key_file)
        return ""
    if order == "build-flag":
        return wire.build_flag(wire.read_key(key_file))
    orders = [name for name in wire.codes("command") if name != wire.CHALLENGE]
    if order not in orders:
        raise UserError(f"no such command: {order} (there are {', '.join((*orders, *wire.OWN_ORDERS))})")
    argument = wire.argument_of(order, value)
    check_node(node)
    if not channel:
        raise UserError(
            f"to which module? --channel names its serial port ({serial_ports()}), or the --interface's channel"
        )
    key = wire.read_key(key_file)
    with open_bus(interface, channel, **({"bitrate": bitrate} if bitrate else {})) as link:
        for wait in (wire.PAUSE_S, wire.PAUSE_S, 0.0):
            link.bus.send(wire.frame(wire.payload(wire.CHALLENGE), node))
            challenge = wire.answer_in(link, "challenge", wire.CHALLENGE_S, wire.codes("command")[wire.CHALLENGE], node)
            if challenge is not None:
                break
            time.sleep(wait)
        else:
            raise UserError("the module gives no challenge now: a wrong tag before, or no random numbers; try again")
        link.bus.send(wire.frame(wire.payload(order, argument, key=key, challenge=challenge), node))
        result = wire.answer_in(link, "result", wire.ANSWER_S, wire.codes("command")[order], node)
    return next((name for name, number in wire.codes("result").items() if number == result), str(result))


def show(answer: str, given: Mapping[str, Any]) -> int:
    """Print the answer; exit code 0 where the module did it."""
    from selfcal.wire.command import OWN_ORDERS, UNVERIFIED

    if given["order"] in OWN_ORDERS:
        print(answer, end="\n" if answer else "")
        return 0
    print(f"{given['order']}: {answer} ({UNVERIFIED})")
    return 0 if answer == "done" else 2
