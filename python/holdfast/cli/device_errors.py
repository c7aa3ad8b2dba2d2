"""How commands end after an error of a device: its text, its JSON, a hint, and the exit code."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, NoReturn

import click

from holdfast.cli import answers
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.terminal_text import print_json
from holdfast.client.base import MAX_TIMEOUT_S
from holdfast.errors import (
    NOT_EXECUTED,
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from holdfast.protocol import ILLEGAL_ADDRESS, ILLEGAL_FUNCTION, TARGET_SILENT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.discovery.device_search import Host, Unit


class WriteInterrupted(ModbusError):
    """Ctrl-C has ended a write, which the device may carry out all the same, or its check."""

    def __str__(self) -> str:
        return "interrupted"


REASONS: tuple[tuple[type[ModbusError], str], ...] = (
    (ModbusException, "exception"),
    (RequestTimeout, "timeout"),
    (ConnectionLost, "connection"),
    (InvalidResponse, "invalid"),
    (WriteInterrupted, "interrupted"),
)


def problem(error: object) -> dict[str, object]:
    """An error for JSON."""
    reasons = (word for kind, word in REASONS if isinstance(error, kind))
    other = "connection" if isinstance(error, OSError) else getattr(error, "reason", "failed")
    reason = next(reasons, other)
    code = {"code": error.code} if isinstance(error, ModbusException) else {}
    return {"reason": reason, **code, "detail": str(error)}


def of_write(found: ModbusError | KeyboardInterrupt) -> ModbusError:
    """The error of a write that has failed or was interrupted."""
    return WriteInterrupted() if isinstance(found, KeyboardInterrupt) else found


def maybe_written(error: ModbusError) -> bool:
    """Whether the device may have carried out the request that ended with this error.

    Earlier requests of a split write, which are written, don't count.
    """
    if isinstance(error, ModbusException):
        return error.code not in NOT_EXECUTED
    return not isinstance(error, ConnectFailed) and getattr(error, "maybe_sent", True)


def differs(wrong: Sequence[str]) -> dict[str, object]:
    """The error of values that were read back otherwise than written, for JSON."""
    return {"reason": "differs", "detail": "; ".join(wrong)} if wrong else {}


TIMEOUTS_S = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, MAX_TIMEOUT_S)
"""Timeouts to suggest."""

MEASURED_TIMEOUTS = 4
"""A late reply is measured up to this many times the timeout, as long as it may raise that."""


HINTS = {
    ILLEGAL_ADDRESS: "'holdfast describe map {}' finds the addresses that exist",
    TARGET_SILENT: "'holdfast find {}' finds the unit ids that answer",
}
"""What to do after an exception of a device at a URL, by its code."""

WRITE_HINTS = {
    **HINTS,
    ILLEGAL_FUNCTION: (
        "the device lacks the function, or lets this client only read: some write one coil or "
        "register with write_multiple=1 in the URL; if Holdfast serves it, see "
        "'holdfast check FILE --as ADDRESS'"
    ),
    ILLEGAL_ADDRESS: (
        "the address does not exist, or may not be written; if Holdfast serves it, see "
        "'holdfast check FILE --as ADDRESS', and 'writes' of the device in FILE"
    ),
}
"""The same after a write."""


def hint(error: object, url: str, absent: str | None = None, *, is_write: bool = False) -> None:
    """Prints what to do after an error, or the code of an exception, once in a command.

    `absent` is what to say first of an address that does not exist.
    """
    hints = WRITE_HINTS if is_write else HINTS
    code = error.code if isinstance(error, ModbusException) else error
    if not isinstance(code, int) or code not in hints:
        return
    told: set[int] = click.get_current_context().meta.setdefault(f"{__name__}.told", set())
    if code not in told:
        told.add(code)
        if code == ILLEGAL_ADDRESS and absent is not None:
            click.echo(f"hint: {absent}", err=True)
        click.echo(f"hint: {hints[code].format(url)}", err=True)


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


def hint_at_silence(url: str, asked: Sequence[Unit | Host], longest_late: float) -> None:
    """Says what may help if what was asked at a URL accepts connections and replies to nothing."""
    is_mute = asked and not longest_late and all(each.is_mute for each in asked)
    if is_mute and "pause_after_connect" not in url and not answers.wanted():
        click.echo(
            "hint: some devices ignore what comes in the first seconds after connecting: "
            f"'{url}{'&' if '?' in url else '?'}pause_after_connect=2' waits for them",
            err=True,
        )


def fail(
    error: object,
    url: str,
    answer: Mapping[str, object] | None = None,
    first: str | None = None,
    *,
    where: str | None = None,
    is_in_area: bool = True,
    is_write: bool = False,
) -> NoReturn:
    """Prints an error and hints, `first` before others, and exits with 1.

    `answer`: what JSON has besides, by default the URL. `where`: what to name in place of the URL.
    `is_in_area`: whether the error concerns an area, not records of a file or a queue.
    """
    if answers.wanted():
        print_json({"ok": False, **(answer or {"target": url}), **problem(error)})
        sys.exit(ExitCode.FAILED)
    click.echo(f"holdfast: {where or url}: {error}", err=True)
    if first is not None:
        click.echo(f"hint: {first}", err=True)
    is_absent = isinstance(error, ModbusException) and error.code == ILLEGAL_ADDRESS
    if is_in_area or not is_absent:  # A search of addresses finds no files and queues.
        hint(error, url, is_write=is_write)
    sys.exit(ExitCode.FAILED)
