"""`holdfast describe identify`: prints the identification of a device."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, TypeVar

import click

from holdfast.cli import device_errors, terminal_text
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device
from holdfast.cli.options.option import json_option
from holdfast.cli.options.url import url_argument
from holdfast.cli.terminal_text import print_json
from holdfast.client.identification import OBJECT_NAMES
from holdfast.errors import ModbusError

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.client.identification import Identification
    from holdfast.client.requests import ServerId

Answer = TypeVar("Answer")

LEVELS = {1: "basic", 2: "regular", 3: "extended"}


@click.command(epilog="Example: holdfast describe identify tcp://192.168.0.10 --unit 3")
@url_argument
@device.device_options
@json_option
def identify(url: str, unit: int, timeout: float, as_json: bool) -> None:
    """Print the identification of the device at URL.

    Requests the device identification (function 43/14) and the server id (function 17). Many
    devices support only one of them, or neither.

    Exit codes: 0 the device supports at least one, 1 neither, 2 wrong usage.
    """
    with device.connect(url, unit, timeout) as client:
        identification = result_or_error(client.identify)
        server_id = result_or_error(client.report_server_id)
    answered = [each for each in (identification, server_id) if not isinstance(each, ModbusError)]
    if as_json:
        answer = {
            "ok": bool(answered),
            "target": url,
            "unit": unit,
            **(device_errors.problem(identification) if not answered else {}),
            "identification": answer_to_json(identification, _identification_json),
            "server_id": answer_to_json(server_id, _server_id_json),
        }
        print_json(answer, indent=2)
    elif isinstance(identification, ModbusError) and isinstance(server_id, ModbusError):
        click.echo(f"holdfast: {url}: function 43/14: {identification}", err=True)
        click.echo(f"holdfast: {url}: function 17: {server_id}", err=True)
    else:
        sections = (
            section("Device identification (function 43/14)", identification, _identification_rows),
            section("Server id (function 17)", server_id, _server_id_rows),
        )
        click.echo("\n\n".join(sections))
    if not answered:
        sys.exit(ExitCode.FAILED)


def result_or_error(call: Callable[[], Answer]) -> Answer | ModbusError:
    """The result of a call, or its error."""
    try:
        return call()
    except ModbusError as error:
        return error


def answer_to_json(
    answer: Answer | ModbusError, to_json: Callable[[Answer], dict[str, object]]
) -> dict[str, object]:
    """An answer, or its error, for JSON."""
    if isinstance(answer, ModbusError):
        return {"ok": False, **device_errors.problem(answer)}
    return {"ok": True, **to_json(answer)}


def section(
    head: str, answer: Answer | ModbusError, to_rows: Callable[[Answer], list[tuple[str, str]]]
) -> str:
    """A heading, and an answer as indented lines of names and texts, or its error."""
    bold = terminal_text.styled(head, bold=True)
    if isinstance(answer, ModbusError):
        return f"{bold}\n  {terminal_text.styled(str(answer), fg='red')}"
    rows = to_rows(answer)
    width = max(len(name) for name, _ in rows)
    return "\n".join([bold, *(f"  {name:{width}}  {text}".rstrip() for name, text in rows)])


def _identification_json(answer: Identification) -> dict[str, object]:
    names = {name: getattr(answer, name) for name in OBJECT_NAMES}
    objects = {str(number): data.hex() for number, data in sorted(answer.objects.items())}
    return {**names, "conformity_level": answer.conformity_level, "objects": objects}


def _server_id_json(answer: ServerId) -> dict[str, object]:
    return {
        "server_id": answer.server_id,
        "running": answer.running,
        "additional": answer.additional.hex(),
        "data": answer.data.hex(),
    }


def _identification_rows(answer: Identification) -> list[tuple[str, str]]:
    level = LEVELS.get(answer.conformity_level & 0x7F)
    rows = [
        (_name(number), _text(data) if number < 0x80 or _is_text(data) else data.hex(" "))
        for number, data in sorted(answer.objects.items())
    ]
    code = f"0x{answer.conformity_level:02X}"
    return [*rows, ("conformity level", f"{code}, {level}" if level else code)]


def _server_id_rows(answer: ServerId) -> list[tuple[str, str]]:
    rows = []
    if answer.server_id is not None:
        rows.append(("server id", str(answer.server_id)))
    if answer.running is not None:
        rows.append(("running", "yes" if answer.running else "no"))
        if answer.additional and _is_text(answer.additional):
            rows.append(("text", _text(answer.additional)))
    return [*rows, ("bytes", answer.data.hex(" "))]


def _name(number: int) -> str:
    return (
        terminal_text.words(OBJECT_NAMES[number])
        if number < len(OBJECT_NAMES)
        else f"object {number}"
    )


def _is_text(data: bytes) -> bool:
    try:
        return data.decode().rstrip("\0").isprintable()
    except UnicodeDecodeError:
        return False


def _text(data: bytes) -> str:
    return terminal_text.plain(data.decode("utf-8", "replace").rstrip("\0"))
