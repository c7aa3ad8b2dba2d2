"""Shared parts of the commands that talk to a device: its URL, options and error output."""

from __future__ import annotations

import contextlib
import json
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from holdfast.client import SyncClient
from holdfast.client.base import MAX_TIMEOUT
from holdfast.client.url import FORMS, parse
from holdfast.errors import (
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from holdfast.net.addresses import address_in, bracketed
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from holdfast.types import Area

Command = TypeVar("Command", bound="Callable[..., Any]")

FAILED = 1

SERIAL_DEVICE = re.compile(r"(/dev/.+|COM[0-9]+|\\\\\.\\.+)")
HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?(:[0-9]{1,5})?")
ADDRESS_6 = re.compile(r"[0-9a-fA-F:.]*:[0-9a-fA-F.]*:[0-9a-fA-F:.]*")
FILES = (".yaml", ".yml", ".json", ".csv")
"""How names of files end that are no hosts."""

TIMEOUTS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, MAX_TIMEOUT)
"""Timeouts to suggest."""

MAX_LATENESS = 4
"""What comes later than this many times the timeout counts as that."""

REASONS: tuple[tuple[type[ModbusError], str], ...] = (
    (ModbusException, "exception"),
    (RequestTimeout, "timeout"),
    (ConnectionLost, "connection"),
    (InvalidResponse, "invalid"),
)


def seconds(text: str) -> float:
    """Parses the seconds of an option."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number <= MAX_TIMEOUT:
        raise click.BadParameter(f"{text!r} is not a number of seconds, more than 0, up to 86400.")
    return number


def pause(text: str) -> float:
    """Parses the seconds of an option that may be 0."""
    return 0.0 if text in ("0", "0.0") else seconds(text)


def is_url(text: str) -> bool:
    """Whether an argument is a URL or an IP address, not a file."""
    return "://" in text or (_is_address(text) and not Path(text).exists())


def checked_url(text: str) -> str:
    """Checks the URL of a device; a host without a scheme is one over TCP.

    Raises `click.BadParameter`.
    """
    url = text if "://" in text else _url_of(text)
    try:
        parse(url)
    except ValueError as error:
        raise click.BadParameter(f"{error}.") from error
    return url


def _url_of(text: str) -> str:
    """The URL of a host without a scheme. Raises `click.BadParameter` for other text."""
    if SERIAL_DEVICE.fullmatch(text):
        raise click.BadParameter(
            f"{text!r} is a serial line: type rtu://{text}?baud=19200&parity=even, with its "
            f"settings. 'holdfast find {text}' finds them."
        )
    name, _, port = text.partition(":")
    is_host = HOST.fullmatch(text) is not None and not text.lower().endswith(FILES)
    if _is_address(text) or (is_host and ("." in name or port or name == "localhost")):
        return f"tcp://{bracketed(text) if ADDRESS_6.fullmatch(text) else text}"
    hint = f"; for a host of that name, type tcp://{text}" if is_host else ""
    raise click.BadParameter(f"{text!r} is not the URL of a device, allowed: {FORMS}{hint}.")


def _is_address(text: str) -> bool:
    """Whether text is an IP address, with or without a port."""
    host, port = text, "0"
    if ":" in text and not ADDRESS_6.fullmatch(text):
        host, _, port = text.rpartition(":")
    return address_in(host) is not None and re.fullmatch("[0-9]{1,5}", port) is not None


url_argument = click.argument("url", type=checked_url, metavar="URL")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")


def device_options(command: Command) -> Command:
    """Adds `--unit` and `--timeout`."""
    unit = click.option(
        "--unit",
        type=click.IntRange(0, 255),
        default=1,
        show_default=True,
        metavar="N",
        help="Unit id, 0 to 255.",
    )
    timeout = click.option(
        "--timeout",
        type=seconds,
        default="1",
        show_default=True,
        metavar="SECONDS",
        help="Time limit for connection, request and reply together.",
    )
    return unit(timeout(command))


def connect(url: str, unit: int, timeout: float) -> SyncClient:
    """A client. It connects on its first request. At its end, the command tells of late replies."""
    with usable():
        client = SyncClient(url, unit=unit, timeout=timeout)
    context = click.get_current_context()
    context.call_on_close(lambda: tell_late(client.longest_late, timeout))
    return client


def tell_late(longest: float, timeout: float) -> None:
    """Hints on standard error that replies took `longest`, more than the timeout; 0 is none."""
    if longest <= timeout:
        return
    least = next(each for each in TIMEOUTS if each >= longest * 1.5 or each == TIMEOUTS[-1])
    found = (
        f"up to {longest:.2g} s" if longest < MAX_LATENESS * timeout else f"{longest:.2g} s or more"
    )
    click.echo(
        f"hint: replies take {found}, longer than --timeout {timeout:g} s: use --timeout {least:g}",
        err=True,
    )


def listen(client: SyncClient, area: Area, address: int) -> None:
    """Asks once more after a timeout, so that a late reply is noticed, which `tell_late` tells."""
    with contextlib.suppress(ModbusError):
        read_raw(client, area, address, 1)


@contextlib.contextmanager
def usable() -> Iterator[None]:
    """Turns errors of a client's arguments, or of files in its URL, into usage errors."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise click.UsageError(f"{error}.") from error


def read_raw(
    client: SyncClient, area: Area, address: int, count: int, unit: int | None = None
) -> list[int]:
    """Reads bits or registers, in several requests if necessary."""
    kind = "bool" if area in BIT_AREAS else "uint16"
    raw: list[int] = client.read(area, address, f"{kind}[{count}]", unit=unit)
    return raw


def problem(error: ModbusError) -> dict[str, object]:
    """An error for JSON."""
    reason = next(word for kind, word in REASONS if isinstance(error, kind))
    code = {"code": error.code} if isinstance(error, ModbusException) else {}
    return {"reason": reason, **code, "detail": str(error)}


def fail(error: ModbusError, url: str, answer: Mapping[str, object] | None) -> NoReturn:
    """Prints an error and exits with 1; with `answer`, as JSON on standard output."""
    tell(error, url, answer)
    sys.exit(FAILED)


def tell(
    error: ModbusError, url: str, answer: Mapping[str, object] | None, hint: str | None = None
) -> None:
    """Prints an error; with `answer`, as JSON on standard output."""
    if answer is not None:
        click.echo(json.dumps({"ok": False, **answer, **problem(error)}))
    else:
        click.echo(f"holdfast: {url}: {error}", err=True)
        if hint is not None:
            click.echo(f"hint: {hint}", err=True)
