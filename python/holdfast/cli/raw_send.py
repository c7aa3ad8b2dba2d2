"""`holdfast raw-send`: sends one Raw Ingest packet."""

from __future__ import annotations

import json
import re
import sys
from typing import IO

import click

from holdfast import raw_ingest
from holdfast.cli.places import number
from holdfast.client.receiver import Receiver, parse_receiver
from holdfast.protocol import MAX_WORD
from holdfast.types import AREAS, Area

# Separators between values in a file.
SEPARATORS = re.compile(r"[\s,;]+")


def _integer(text: str) -> int:
    found = number(text)
    if found is None:
        raise click.BadParameter(f"{text!r} is not an integer, decimal or 0x.")
    return found


def _word(text: str) -> int:
    found = _integer(text)
    if found > MAX_WORD:
        raise click.BadParameter(f"{text} is outside 0 to {MAX_WORD}.")
    return found


def _receiver(text: str) -> Receiver:
    """Parses HOST:PORT or a URL."""
    if "://" in text:
        try:
            return parse_receiver(text)
        except ValueError as error:
            raise click.BadParameter(f"{error}.") from None
    host, _, digits = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise click.BadParameter(f"{text!r}: an IPv6 address requires brackets, as in [::1]:9000.")
    port = number(digits)
    if not host or port is None:
        raise click.BadParameter(f"{text!r} is not HOST:PORT, as in 127.0.0.1:9000.")
    if not 1 <= port <= MAX_WORD:
        raise click.BadParameter(f"{text!r}: port {port} is outside 1 to {MAX_WORD}.")
    return Receiver(host, port)


@click.command(
    epilog="Example: holdfast raw-send 127.0.0.1:9000 input_registers 0 100 200 0x12C --unit 1"
)
@click.argument("receiver", metavar="HOST:PORT", type=_receiver)
@click.argument("area", type=click.Choice(AREAS), metavar="AREA")
@click.argument("address", type=_word)
@click.argument("values", metavar="[VALUE]...", nargs=-1, type=_integer)
@click.option("--unit", type=_word, metavar="N", help="Unit id; selects format v1.")
@click.option("--memory-id", type=_word, metavar="N", help="Memory id; selects format crc.")
@click.option(
    "--no-crc",
    is_flag=True,
    help="With --memory-id: omit the CRC, for a listener with `compat: {crc: none}`.",
)
@click.option(
    "--file",
    type=click.File(encoding="utf-8"),
    help="Read the values from a file; -: standard input.",
)
@click.option("--hex", "payload", metavar="BYTES", help="Payload as on the wire, in hex.")
@click.option("--count", type=_word, metavar="N", help="Number of bits in --hex.")
@click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    default=raw_ingest.TIMEOUT,
    show_default=True,
    metavar="SECONDS",
    help="Time limit for connection, packet and reply together.",
)
@click.option("--dry-run", is_flag=True, help="Print the packet in hex and send nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
def raw_send(
    receiver: Receiver,
    area: Area,
    address: int,
    values: tuple[int, ...],
    unit: int | None,
    memory_id: int | None,
    no_crc: bool,
    file: IO[str] | None,
    payload: str | None,
    count: int | None,
    timeout: float,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write VALUEs to AREA, starting at ADDRESS, in one step with one Raw Ingest packet.

    Instead of HOST:PORT, for TLS: raw+tls://host:port?ca=ca.pem&cert=own.pem&key=own.key

    AREA is coils, discrete_inputs, holding_registers or input_registers. Numbers are decimal or 0x.
    Values in a file are separated by line ends, spaces, commas or semicolons.

    Exit codes: 0 written, 1 refused or possibly not written, 2 wrong usage.
    """
    if (unit is None) == (memory_id is None):
        raise click.UsageError("Give either --unit (format v1) or --memory-id (format crc).")
    if no_crc and memory_id is None:
        raise click.UsageError("--no-crc requires --memory-id.")
    if bool(values) + (file is not None) + (payload is not None) != 1:
        raise click.UsageError("Give exactly one of VALUEs, --file and --hex.")
    if count is not None and payload is None:
        raise click.UsageError("--count requires --hex.")
    try:
        packet = raw_ingest.encode(
            area,
            address,
            None if payload is not None else values if file is None else _values(file),
            data=None if payload is None else _bytes(payload),
            count=count,
            unit=unit,
            memory_id=memory_id,
            crc="none" if no_crc else None,
        )
    except (ValueError, TypeError) as error:
        raise click.UsageError(f"{error}.") from error
    if dry_run:
        click.echo(json.dumps({"packet": packet.hex()}) if as_json else packet.hex())
        return
    answer: dict[str, object] = {"area": area, "address": address, "bytes": len(packet)}
    try:
        raw_ingest.send_packet_sync(
            receiver.host, receiver.port, packet, timeout=timeout, tls=receiver.tls
        )
    except raw_ingest.RawError as error:
        if not as_json:
            click.echo(f"holdfast: {error}", err=True)
            sys.exit(1)
        answer["reason"] = _reason(error)
        if isinstance(error, raw_ingest.RawTlsFailed):
            answer["tls"] = error.reason
        answer |= {"detail": str(error), "maybe_written": error.maybe_written}
        click.echo(json.dumps({"ok": False} | answer))
        sys.exit(1)
    except (OSError, ValueError) as error:
        raise click.UsageError(f"{error}.") from error
    if as_json:
        click.echo(json.dumps({"ok": True} | answer))
    else:
        click.echo(f"Written: {area} from address {address}, one packet of {len(packet)} bytes.")


def _reason(error: raw_ingest.RawError) -> str:
    if isinstance(error, raw_ingest.RawRefused):
        return "refused"
    return "timeout" if isinstance(error, raw_ingest.RawTimeout) else "failed"


def _values(file: IO[str]) -> list[int]:
    """Reads values from a file. Raises `ValueError` with the line of the first invalid value."""
    values: list[int] = []
    try:
        for line, text in enumerate(file, 1):
            for item in SEPARATORS.split(text.strip()):
                if not item:
                    continue
                value = number(item)
                if value is None:
                    found = f"{file.name}:{line}: {item[:40]!r} is not an integer"
                    raise ValueError(f"{found}, decimal or 0x")
                values.append(value)
            if len(values) > MAX_WORD:
                raise ValueError(f"{file.name} has more than {MAX_WORD} values")
    except UnicodeDecodeError:
        raise ValueError(f"{file.name} is not UTF-8 text") from None
    return values


def _bytes(payload: str) -> bytes:
    try:
        return bytes.fromhex(payload)
    except ValueError:
        raise ValueError(f"--hex is {payload[:40]!r}, allowed: pairs of hex digits") from None
