"""`holdfast write`: writes coils and holding registers of a device."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from holdfast import values
from holdfast.cli import device, places, showing, tag_options, tagged_write
from holdfast.cli.tag_options import TagFiles
from holdfast.cli.typed import typed, typed_options
from holdfast.client import requests
from holdfast.errors import ModbusError, ModbusException
from holdfast.protocol import WRITE_LIMITS
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from holdfast._core import Request
    from holdfast.cli.places import Place
    from holdfast.cli.typed import Typed
    from holdfast.client import SyncClient

TRUTHS = {"true": True, "on": True, "1": True, "false": False, "off": False, "0": False}
WHOLE = re.compile(r"([+-]?)(0[xX][0-9a-fA-F]{1,20}|[0-9]{1,20})")
NEGATIVE = re.compile(r"-(\.?[0-9]|inf|nan)", re.I)


@click.command(
    epilog="Example: holdfast write tcp://192.168.0.10 hr 100 21.5 --type float32 --order CDAB",
    # Otherwise -5 would be an unknown option.
    context_settings={"ignore_unknown_options": True},
)
@tag_options.url_argument
@click.argument(
    "words",
    nargs=-1,
    metavar="[AREA ADDRESS VALUE... | NAME=VALUE...]",
    shell_complete=places.complete,
)
@typed_options
@tag_options.tag_file_options
@click.option("--split", is_flag=True, help="Allow several requests if one is not enough.")
@click.option("--verify", is_flag=True, help="Read the values back and compare.")
@click.option("--dry-run", is_flag=True, help="Print the requests (PDU) in hex and send nothing.")
@click.option("--modicon", is_flag=True, help="ADDRESS is a Modicon number, as in 40001 or 4x0001.")
@device.device_options
@device.json_option
def write(
    url: str,
    words: tuple[str, ...],
    kind: str | None,
    order: str,
    encoding: str | None,
    tag_file: Path | None,
    profile: str | None,
    config_file: Path | None,
    split: bool,
    verify: bool,
    dry_run: bool,
    modicon: bool,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Write VALUEs to AREA of the device at URL, starting at ADDRESS.

    AREA is coils or holding_registers; co, hr or any prefix. ADDRESS counts from 0, decimal or 0x.
    With --modicon, it is 40001, 400001 or 4x0001, which counts from 1 and includes the area, so
    AREA is optional.

    Coils take true, false, on, off, 1, 0; registers take 0 to 65535, decimal or 0x. With --type,
    VALUEs are of that type: text for a string, hex for bytes. bit:N writes one bit of a register
    with function 22, which keeps the other bits.

    With --tags, writes NAME=VALUE: values are scaled, states have names, and only tags that are
    writable are written. If a value does not fit, nothing is sent.

    One coil or register is written with function 5 or 6, several with 15 or 16.

    Exit codes: 0 written, 1 not written, possibly not written or read back different, 2 wrong
    usage.
    """
    files = TagFiles(tag_file, profile, config_file)
    if files.given:
        if kind is not None or order != "ABCD" or encoding is not None or split or modicon:
            raise click.UsageError(
                "--type, --order, --encoding, --split and --modicon can't be used with tags."
            )
        of = files.device(url, unit, timeout)
        tagged_write.write_tags(of, words, verify=verify, dry_run=dry_run, as_json=as_json)
        return
    if not words:
        raise click.UsageError("Missing argument 'AREA ADDRESS VALUE...'.")
    place, left = places.taken(words, modicon=modicon)
    for word in left:
        if word.startswith("--") or (word.startswith("-") and not NEGATIVE.match(word)):
            raise click.NoSuchOption(word)
    if place.area not in WRITE_LIMITS:
        raise click.UsageError(f"{place.area} can't be written, only read.")
    if not left:
        raise click.UsageError("Missing argument 'VALUE...'.")
    job = _job(place, left, kind, order, encoding, split)
    told: dict[str, object] = {"url": url, "unit": unit, **job.told()}
    if dry_run:
        pdus = [request.pdu.hex() for request in job.requests]
        click.echo(json.dumps({"requests": pdus}) if as_json else "\n".join(pdus))
        return
    differing: dict[int, tuple[int, int]] = {}
    with device.connect(url, unit, timeout) as client:
        try:
            job.write(client)
        except ModbusError as error:
            refused = isinstance(error, ModbusException) and len(job.requests) == 1
            device.fail(error, url, told | {"maybe_written": not refused} if as_json else None)
        try:
            differing = job.differing(client) if verify else {}
        except ModbusError as error:
            if not as_json:
                click.echo(f"{job.said}; could not be read back", err=True)
            device.fail(error, url, told | {"maybe_written": True} if as_json else None)
    if as_json:
        verified = {"verified": not differing} if verify else {}
        click.echo(json.dumps({"ok": not differing, **told, **verified}))
    else:
        click.echo(job.said + ("" if not verify or differing else "; read back alike") + ".")
        for address, (was, now) in differing.items():
            click.echo(f"holdfast: {place.area} {address}: wrote {was}, read back {now}", err=True)
    if differing:
        sys.exit(device.FAILED)


def _job(
    place: Place,
    words: Sequence[str],
    kind: str | None,
    order: str,
    encoding: str | None,
    split: bool,
) -> _Job:
    """Checks what to write. Raises `click.UsageError`."""
    asked = typed(kind, order, encoding, place.area, 1)
    if asked is None:
        own = "bool" if place.area in BIT_AREAS else "uint16"
        asked = typed(own, "ABCD", None, place.area, len(words))
        assert asked is not None
    elif kind == asked.element:
        asked = typed(f"{kind}[{len(words)}]", order, encoding, place.area, 1) or asked
    if len(words) != asked.count:
        takes = showing.counted(asked.count, "value")
        raise click.UsageError(f"{kind} takes {takes}, found {len(words)}.")
    found = [_value(word, asked.element) for word in words]
    try:
        if asked.element.startswith("bit:") and len(found) > 1:
            raise ValueError(f"{asked.element} takes one value, found {len(found)}")
        value = found[0] if asked.count == 1 else found
        steps = requests.write_typed(
            place.area, place.address, value, asked.name, order, encoding, split=split
        )
        return _Job(place, asked, value, split, list(steps))
    except ValueError as error:
        raise click.UsageError(f"{error}.".replace("split=True", "--split")) from error


@dataclass(frozen=True)
class _Job:
    """Values to write, and the requests that write them."""

    place: Place
    typed: Typed
    value: Any
    split: bool
    requests: list[Request]

    @property
    def said(self) -> str:
        """The result as text."""
        first, count = self.place.address, self.typed.registers
        where = f"{first}" if count == 1 else f"{first} to {first + count - 1}"
        return (
            f"Written: {self.place.area} {where}, {showing.counted(len(self.requests), 'request')}"
        )

    def told(self) -> dict[str, object]:
        """The job for JSON."""
        return {
            "area": self.place.area,
            "address": self.place.address,
            "count": self.typed.registers,
        }

    def write(self, client: SyncClient) -> None:
        """Writes the values."""
        place, kind = self.place, self.typed
        client.write(
            place.area,
            place.address,
            self.value,
            kind.name,
            kind.order,
            encoding=kind.encoding,
            split=self.split,
        )

    def differing(self, client: SyncClient) -> dict[int, tuple[int, int]]:
        """Written and read-back values that differ, by address."""
        place, kind = self.place, self.typed
        now = device.read_raw(client, place.area, place.address, kind.registers)
        if kind.element.startswith("bit:"):
            [mask] = values.encode(self.value, kind.element, kind.order)
            wrote = [now[0] | mask if self.value else now[0] & mask]
        else:
            wrote = values.encode(self.value, kind.name, kind.order, encoding=kind.encoding)
        pairs = enumerate(zip(wrote, now, strict=True), place.address)
        return {address: (int(a), int(b)) for address, (a, b) in pairs if a != b}


def _value(text: str, kind: str) -> Any:
    """Parses a value of a type from the command line."""
    base = kind.partition(":")[0].rstrip("0123456789")
    if base == "string":
        return text
    if base in ("bool", "bit"):
        if text.lower() not in TRUTHS:
            raise click.UsageError(f"{text!r} is not true, false, on, off, 1 or 0.")
        return TRUTHS[text.lower()]
    if base == "bytes":
        try:
            return bytes.fromhex(text.removeprefix("0x"))
        except ValueError:
            raise click.UsageError(f"{text!r} is not hex, allowed: pairs of hex digits.") from None
    if base == "float":
        try:
            return float(text)
        except ValueError:
            raise click.UsageError(f"{text!r} is not a number.") from None
    match = WHOLE.fullmatch(text)
    if match is None:
        raise click.UsageError(
            f"{text!r} is not an integer, decimal or 0x; other values require --type."
        )
    return int(match[1] + match[2], 0 if match[2][:2] in ("0x", "0X") else 10)
