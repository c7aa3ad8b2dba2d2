"""The options `--unit` and `--timeout`, and the device that commands talk to with them."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING, NoReturn

import click

from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options.duration import timeout_option
from holdfast.cli.options.option import Command, number_option, option_group
from holdfast.cli.terminal_text import print_json
from holdfast.client import SyncClient
from holdfast.client.base import MAX_TIMEOUT_S
from holdfast.errors import (
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from holdfast.protocol import ILLEGAL_ADDRESS, LAST_ADDRESS, MAX_UNIT, TARGET_SILENT
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from holdfast.cli.options.item import Place
    from holdfast.types import Area

UNIT = f"Unit id, 0 to {MAX_UNIT}."

TIMEOUTS_S = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, MAX_TIMEOUT_S)
"""Timeouts to suggest."""

MEASURED_TIMEOUTS = 4
"""A late reply is measured up to this many times the timeout, as long as it may raise that."""

REASONS: tuple[tuple[type[ModbusError], str], ...] = (
    (ModbusException, "exception"),
    (RequestTimeout, "timeout"),
    (ConnectionLost, "connection"),
    (InvalidResponse, "invalid"),
)


def unit_option(default: int | None = 1, help: str = UNIT) -> Callable[[Command], Command]:
    """Adds `--unit`."""
    return number_option("--unit", help, 0, MAX_UNIT, default)


device_options = option_group(unit_option(), timeout_option())
"""Adds `--unit` and `--timeout`."""


def connect(url: str, unit: int, timeout: float) -> SyncClient:
    """A client. It connects on its first request. The command ends with a hint at late replies."""
    with usable():
        client = SyncClient(url, unit=unit, timeout=timeout)
    context = click.get_current_context()
    context.call_on_close(lambda: hint_at_late_replies(client.longest_late, timeout))
    return client


def hint_at_late_replies(longest: float, timeout: float) -> None:
    """Suggests a longer timeout; the slowest late reply took `longest` seconds, 0 without one."""
    if not longest:
        return
    # The timeout includes connecting: a reply that missed it may be sooner after its request.
    longest = max(longest, timeout)
    least = next(each for each in TIMEOUTS_S if each >= longest * 1.5 or each == TIMEOUTS_S[-1])
    found = (
        f"up to {longest:.2g} s"
        if longest < MEASURED_TIMEOUTS * timeout
        else f"{longest:.2g} s or more"
    )
    click.echo(
        f"hint: replies take {found}, longer than --timeout {timeout:g} s: use --timeout {least:g}",
        err=True,
    )


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
    client: SyncClient, area: Area, address: int, count: int, unit: int | None = None
) -> list[int]:
    """Reads bits or registers, in several requests if necessary."""
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


def problem(error: object) -> dict[str, object]:
    """An error for JSON."""
    reasons = (word for kind, word in REASONS if isinstance(error, kind))
    reason = next(reasons, "connection" if isinstance(error, OSError) else "failed")
    code = {"code": error.code} if isinstance(error, ModbusException) else {}
    return {"reason": reason, **code, "detail": str(error)}


def differs(wrong: Sequence[str]) -> dict[str, object]:
    """The error of values that were read back otherwise than written, for JSON."""
    return {"reason": "differs", "detail": "; ".join(wrong)} if wrong else {}


HINTS = {
    ILLEGAL_ADDRESS: "'holdfast describe map {}' finds the addresses that exist",
    TARGET_SILENT: "'holdfast find {}' finds the unit ids that answer",
}
"""What to do after an exception of a device at a URL, by its code."""


def hint(error: object, url: str) -> None:
    """Prints what to do after an error, or the code of an exception, once in a command."""
    code = error.code if isinstance(error, ModbusException) else error
    if not isinstance(code, int) or code not in HINTS:
        return
    told: set[int] = click.get_current_context().meta.setdefault(f"{__name__}.told", set())
    if code not in told:
        told.add(code)
        click.echo(f"hint: {HINTS[code].format(url)}", err=True)


def fail(error: ModbusError, url: str, answer: Mapping[str, object] | None) -> NoReturn:
    """Prints an error and exits with 1; with `answer`, as JSON on standard output."""
    print_error(error, url, answer)
    sys.exit(ExitCode.FAILED)


def print_error(
    error: ModbusError, url: str, answer: Mapping[str, object] | None, first: str | None = None
) -> None:
    """Prints an error and hints; with `answer`, as JSON on standard output."""
    if answer is not None:
        print_json({"ok": False, **answer, **problem(error)})
        return
    click.echo(f"holdfast: {url}: {error}", err=True)
    if first is not None:
        click.echo(f"hint: {first}", err=True)
    hint(error, url)
