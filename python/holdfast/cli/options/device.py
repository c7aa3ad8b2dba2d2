"""The options `--unit`, `--timeout`, `--trace`, and the device that commands talk to with them."""

from __future__ import annotations

import contextlib
import struct
from typing import TYPE_CHECKING

import click

from holdfast.cli.device_errors import hint_at_late_replies
from holdfast.cli.options.duration import timeout_option
from holdfast.cli.options.option import Command, number_option, option_group
from holdfast.cli.options.units import refuse_broadcast
from holdfast.client import SyncClient
from holdfast.client.base import is_broadcast
from holdfast.client.url import parse
from holdfast.errors import (
    ModbusError,
    ModbusException,
)
from holdfast.protocol import ILLEGAL_ADDRESS, LAST_ADDRESS, MAX_UNIT
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from holdfast._core import Request
    from holdfast.cli.options.plc_addresses import Place
    from holdfast.types import Area

TRACE = f"{__name__}.trace"
"""The place in the context of a command of what shows the bytes."""

UNIT = f"Unit id, 0 to {MAX_UNIT}."


def unit_option(default: int | None = 1, help: str = UNIT) -> Callable[[Command], Command]:
    """Adds `--unit`."""
    return number_option("--unit", help, 0, MAX_UNIT, default)


def _print_bytes(direction: str, data: bytes) -> None:
    from datetime import datetime

    click.echo(f"{datetime.now():%H:%M:%S.%f} {direction:8} {data.hex(' ')}", err=True)


def _trace_option() -> Callable[[Command], Command]:
    """Adds `--trace`, which `connect` looks up: no command has anything else to do with it."""

    def keep(context: click.Context, _option: click.Parameter, is_given: bool) -> None:
        context.meta[TRACE] = _print_bytes if is_given else None

    help = "Print the bytes sent and received, with the time, to standard error."
    return click.option("--trace", is_flag=True, expose_value=False, callback=keep, help=help)


device_options = option_group(unit_option(), timeout_option(), _trace_option())
"""Adds `--unit`, `--timeout` and `--trace`."""


def sent_pdus(url: str, requests: Sequence[Request]) -> list[str]:
    """The requests as a device at this URL gets them, in hex."""
    with usable():
        is_multiple = parse(url).tolerance.write_multiple
    multiples = [each.as_multiple() if is_multiple else None for each in requests]
    sent = zip(requests, multiples, strict=True)
    return [(each if multiple is None else multiple).pdu.hex() for each, multiple in sent]


def connect(url: str, unit: int, timeout: float, *, only_writes: bool = False) -> SyncClient:
    """A client. It connects on its first request. The command ends with a hint at late replies.

    Raises `click.UsageError` for the broadcast of a serial line, unless the command `only_writes`.
    """
    context = click.get_current_context()
    with usable():
        client = SyncClient(url, unit=unit, timeout=timeout, trace=context.meta.get(TRACE))
    if not only_writes and is_broadcast(client.target, unit):
        refuse_broadcast([unit])
    context.call_on_close(lambda: hint_at_late_replies(client.longest_late, timeout))
    return client


def await_late_reply(client: SyncClient, area: Area, address: int) -> None:
    """Asks once more after a timeout, so that `hint_at_late_replies` knows of a late reply."""
    with contextlib.suppress(ModbusError):
        read_raw(client, area, address, 1)


@contextlib.contextmanager
def usable() -> Iterator[None]:
    """Turns errors of a client's arguments, or of files in its URL, into usage errors."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise click.UsageError(str(error)) from error


def read_raw(
    client: SyncClient,
    area: Area,
    address: int,
    count: int,
    *,
    element: int = 1,
    unit: int | None = None,
) -> list[int]:
    """Reads bits or registers, in several requests if necessary.

    These end where an element ends, of `element` registers.
    """
    if element > 1:
        kind = f"bytes:{2 * element}[{count // element}]"
        data = b"".join(client.read(area, address, kind, unit=unit))
        return list(struct.unpack(f">{count}H", data))
    kind = "bool" if area in BIT_AREAS else "uint16"
    raw: list[int] = client.read(area, address, f"{kind}[{count}]", unit=unit)
    return raw


def existing(client: SyncClient, place: Place, most: int) -> int:
    """How many addresses exist from a place on, up to `most`. Raises `ModbusError` if none does."""
    size = min(most, LAST_ADDRESS + 1 - place.address)
    while True:
        try:
            read_raw(client, place.area, place.address, size)
        except ModbusException as error:
            if error.code != ILLEGAL_ADDRESS or size == 1:
                raise
            size -= 1
        else:
            return size
