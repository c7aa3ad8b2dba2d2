"""`holdfast raw-send`: sends one Raw Ingest packet."""

from __future__ import annotations

import sys

import click

from holdfast import raw_ingest
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.duration import timeout_option
from holdfast.cli.options.item import take, words_argument
from holdfast.cli.options.option import flag, json_option, option, whole_number
from holdfast.cli.terminal_text import print_json
from holdfast.client.url import Receiver, parse_receiver
from holdfast.protocol import MAX_WORD


def _integer(text: str) -> int:
    found = whole_number(text)
    if found is None:
        raise click.UsageError(f"{text!r} is not an integer, decimal or 0x.")
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
            raise click.BadParameter(str(error)) from None
    host, _, digits = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise click.BadParameter(f"{text!r}: an IPv6 address requires brackets, as in [::1]:9000.")
    port = whole_number(digits)
    if not host or port is None:
        raise click.BadParameter(f"{text!r} is not HOST:PORT, as in 127.0.0.1:9000.")
    if not 1 <= port <= MAX_WORD:
        raise click.BadParameter(f"{text!r}: port {port} is outside 1 to {MAX_WORD}.")
    return Receiver(host, port)


@click.command(
    epilog="Example: holdfast raw-send 127.0.0.1:9000 input_registers 0 100 200 0x12C --unit 1"
)
@click.argument("receiver", metavar="HOST:PORT", type=_receiver)
@words_argument("ITEM VALUE...", required=True)
@option("--unit", "N", "Unit id; selects format v1.", _word)
@option("--memory-id", "N", "Memory id; selects format crc.", _word)
@flag("--no-crc", "With --memory-id: omit the CRC, for a listener with `compat: {crc: none}`.")
@timeout_option(
    f"{raw_ingest.TIMEOUT_S:g}",
    "Time limit for connection, packet and reply together.",
)
@flag("--dry-run", "Print the packet in hex and send nothing.")
@json_option
def raw_send(
    receiver: Receiver,
    words: tuple[str, ...],
    unit: int | None,
    memory_id: int | None,
    no_crc: bool,
    timeout: float,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write VALUEs from ITEM on, in one step with one Raw Ingest packet.

    Instead of HOST:PORT, for TLS: raw+tls://host:port?ca=ca.pem&cert=own.pem&key=own.key

    ITEM is hr:0, hr 0, 40001, 4x0001 or %MW0, in any area. Numbers are decimal or 0x.

    Exit codes: 0 written, 1 refused or possibly not written, 2 wrong usage.
    """
    item, texts = take(words)
    if item.type is not None or item.count is not None:
        raise click.UsageError(f"{item.text!r}: only an area and an address can be used here.")
    area, address, values = item.place.area, item.place.address, [_integer(each) for each in texts]
    if (unit is None) == (memory_id is None):
        raise click.UsageError("Give either --unit (format v1) or --memory-id (format crc).")
    if no_crc and memory_id is None:
        raise click.UsageError("--no-crc requires --memory-id.")
    try:
        packet = raw_ingest.encode(
            area,
            address,
            values,
            unit=unit,
            memory_id=memory_id,
            crc="none" if no_crc else None,
        )
    except (ValueError, TypeError) as error:
        raise click.UsageError(str(error)) from error
    answer: dict[str, object] = {
        "target": str(receiver),
        "area": area,
        "address": address,
        "bytes": len(packet),
    }
    if dry_run:
        if as_json:
            print_json({"ok": True, **answer, "packet": packet.hex()})
        else:
            click.echo(packet.hex())
        return
    try:
        raw_ingest.send_packet_sync(
            receiver.host, receiver.port, packet, timeout=timeout, tls=receiver.tls
        )
    except raw_ingest.RawError as error:
        if not as_json:
            fail(error)
        answer["reason"] = _reason(error)
        if isinstance(error, raw_ingest.RawTlsFailed):
            answer["tls"] = error.reason
        answer |= {"detail": str(error), "maybe_written": error.maybe_written}
        print_json({"ok": False} | answer)
        sys.exit(ExitCode.FAILED)
    except (OSError, ValueError) as error:
        raise click.UsageError(str(error)) from error
    if as_json:
        print_json({"ok": True} | answer)
    else:
        click.echo(f"Written: {area} from address {address}, one packet of {len(packet)} bytes.")


def _reason(error: raw_ingest.RawError) -> str:
    if isinstance(error, raw_ingest.RawRefused):
        return "refused"
    if isinstance(error, raw_ingest.RawTimeout):
        return "timeout"
    return "connection" if isinstance(error.__cause__, OSError) else "failed"
