"""`holdfast write`: writes coils and holding registers of a device."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from holdfast import values
from holdfast._core import Request
from holdfast.cli import device_errors, terminal_text
from holdfast.cli.devices import device_items
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device, item
from holdfast.cli.options.item import words_argument
from holdfast.cli.options.option import flag, json_option
from holdfast.cli.options.value_type import typed, typed_options
from holdfast.cli.signals import stops_as_ctrl_c
from holdfast.cli.tags import options as tag_options
from holdfast.cli.tags.options import TagFiles
from holdfast.cli.terminal_text import print_json
from holdfast.client import requests
from holdfast.errors import ModbusError
from holdfast.protocol import WRITE_LIMITS
from holdfast.runtime.text import would_be_zero
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.options.plc_addresses import Place
    from holdfast.cli.options.value_type import Typed
    from holdfast.client import SyncClient

TRUTHS = {"true": True, "on": True, "1": True, "false": False, "off": False, "0": False}
WHOLE = re.compile(r"([+-]?)(0[xX][0-9a-fA-F]{1,20}|[0-9]{1,20})")
NUMBER = re.compile(
    r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|inf(inity)?|nan)", re.I | re.ASCII
)
"""A float. Python's own spelling has `21_5` for 215, and digits of other scripts."""
NEGATIVE = re.compile(r"-(\.?[0-9]|inf|nan)", re.I)


AS_THEY_ARE = f"{__name__}.as_they_are"
"""The place in the context of how many words are behind `--`."""


class _Write(click.Command):
    """A command whose words may look like options."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments. -h is an option as a word of its own only: -5h contains none."""
        end = args.index("--") if "--" in args else len(args)
        ctx.meta[AS_THEY_ARE] = len(args[end + 1 :])
        options = ["--help" if each == "-h" else each for each in args[:end]]
        return super().parse_args(ctx, [*options, *args[end:]])


@click.command(
    cls=_Write,
    epilog="Example: holdfast write tcp://192.168.0.10 hr 100 21.5 --type float32 --order CDAB",
    # Otherwise -5 would be an unknown option, and -5h would print the help.
    context_settings={"ignore_unknown_options": True, "help_option_names": ["--help"]},
)
@tag_options.url_argument
@words_argument("[ITEM VALUE... | NAME=VALUE...]")
@typed_options
@tag_options.tag_file_options
@flag("--split", "Allow several requests if one is not enough.")
@flag("--verify", "Read the values back and compare.")
@flag("--dry-run", "Print the requests (PDU) in hex and send nothing.")
@device.device_options
@json_option
def write(
    url: str,
    words: tuple[str, ...],
    kind: str | None,
    order: str,
    encoding: str | None,
    files: TagFiles,
    split: bool,
    verify: bool,
    dry_run: bool,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Write VALUEs to the device at URL, from ITEM on.

    ITEM is hr:0, hr 0, 40001, 4x0001 or %MW0, with a type and an order as in hr:0:float32:CDAB.
    Its area is coils or holding_registers; co, hr or any prefix. Beside an area, ADDRESS counts
    from 0, decimal or 0x. file:4:7 is record 7 of file 4.

    Coils take true, false, on, off, 1, 0; registers take 0 to 65535, decimal or 0x. With --type,
    VALUEs are of that type: text for a string, hex for bytes. bit:N writes one bit of a register
    with function 22, which keeps the other bits. Behind --, words that begin with - are VALUEs too.

    With --tags, writes NAME=VALUE: values are scaled, states have names, and only tags that are
    writable are written. If a value does not fit, nothing is sent.

    One coil or register is written with function 5 or 6, several with 15 or 16.

    Exit codes: 0 written, 1 not written, possibly not written or read back different, 2 wrong
    usage.
    """
    click.get_current_context().with_resource(stops_as_ctrl_c())
    in_no_area = device_items.is_named(words)
    is_changed = kind is not None or order != "ABCD" or encoding is not None or split
    if is_changed and (files.given or in_no_area):
        what = "tags" if files.given else words[0]
        raise click.UsageError(
            f"--type, --order, --encoding and --split can't be used with {what}."
        )
    if files.given:
        from holdfast.cli.tags import write as tagged_write

        of = files.device(url, unit, timeout)
        tagged_write.write_tags(of, words, verify=verify, dry_run=dry_run, as_json=as_json)
        return
    if not words:
        raise click.UsageError("Missing argument 'ITEM VALUE...'.")
    if in_no_area:
        _carry_out(
            _file_job(words), url, unit, timeout, verify=verify, dry_run=dry_run, as_json=as_json
        )
        return
    if "=" in words[0]:
        raise click.UsageError(f"{words[0]!r}: NAME=VALUE requires --tags or --config.")
    first, left = item.take(words)
    place = first.place
    as_they_are = click.get_current_context().meta[AS_THEY_ARE]
    for word in left[: max(0, len(left) - as_they_are)]:
        if word.startswith("--") or (word.startswith("-") and not NEGATIVE.match(word)):
            raise click.NoSuchOption(word)
    if place.area not in WRITE_LIMITS:
        raise click.UsageError(f"{place.area} can't be written, only read.")
    if not left:
        raise click.UsageError("Missing argument 'VALUE...'.")
    if first.type is not None:
        if kind is not None or order != "ABCD":
            raise click.UsageError("--type and --order can't be used with AREA:ADDRESS:TYPE.")
        kind, order = first.type, first.order
    job = _job(place, left, kind, order, encoding, split)
    if first.count is not None and first.count != job.typed.registers:
        noun = "bit" if place.area in BIT_AREAS else "register"
        named = terminal_text.counted(first.count, noun)
        raise click.UsageError(f"{first.text!r} is {named}, the values are {job.typed.registers}.")
    _carry_out(job, url, unit, timeout, verify=verify, dry_run=dry_run, as_json=as_json)


def _carry_out(
    job: _Job | _FileJob,
    url: str,
    unit: int,
    timeout: float,
    *,
    verify: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Writes, or prints the requests of a dry run."""
    fields: dict[str, object] = {"target": url, "unit": unit, **job.to_json()}
    if dry_run:
        pdus = device.sent_pdus(url, job.requests)
        if as_json:
            print_json({"ok": True, **fields, "pdus": pdus})
        else:
            click.echo("\n".join(pdus))
        return
    differing: dict[int, tuple[int, int]] = {}
    with device.connect(url, unit, timeout, only_writes=not verify) as client:
        try:
            job.write(client)
        except (ModbusError, KeyboardInterrupt) as found:
            error = device_errors.of_write(found)
            maybe = device_errors.maybe_written(error)
            # It is not known how much of a split write Ctrl-C has left.
            written = {"written": found.written} if isinstance(found, ModbusError) else {}
            shown = {**fields, **written, "maybe_written": maybe}
            done = written.get("written", 0)
            verb = "was" if fields["count"] == done + 1 else "were"
            first = f"{job.places(done)} {verb} possibly written" if maybe else None
            device_errors.fail(
                error, url, shown, first, is_in_area=isinstance(job, _Job), is_write=True
            )
        try:
            differing = job.differing(client) if verify else {}
        except (ModbusError, KeyboardInterrupt) as found:
            error = device_errors.of_write(found)
            if not as_json:
                click.echo(f"{job.summary}; could not be read back", err=True)
            shown = {**fields, "written": fields["count"], "maybe_written": False}
            device_errors.fail(error, url, shown, is_in_area=isinstance(job, _Job))
    try:
        if as_json:
            verified = {"verified": not differing} if verify else {}
            wrong = [f"{at}: wrote {was}, read back {now}" for at, (was, now) in differing.items()]
            print_json({"ok": not differing, **fields, **verified, **device_errors.differs(wrong)})
        else:
            click.echo(job.summary + ("" if not verify or differing else "; read back alike") + ".")
    except OSError:
        click.echo(f"{job.summary}.", err=True)
        raise
    if not as_json:
        for address, (was, now) in differing.items():
            click.echo(f"holdfast: {job.where} {address}: wrote {was}, read back {now}", err=True)
    if differing:
        sys.exit(ExitCode.FAILED)


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
        takes = terminal_text.counted(asked.count, "value")
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
    except requests.TooManyValues as error:
        raise click.UsageError(
            f"{error.count} values, one request writes at most {error.limit}; use --split for "
            "several requests, which the device does not execute in one step."
        ) from error
    except ValueError as error:
        is_negative = kind is None and any(value < 0 for value in found)
        signed = "; negative numbers require --type, as in --type int16" if is_negative else ""
        raise click.UsageError(f"{error}{signed}") from error


def _file_job(words: Sequence[str]) -> _FileJob:
    """Checks which records to write. Raises `click.UsageError`."""
    file, record, left = device_items.to_write(words)
    found = [_value(word, "uint16") for word in left]
    with device.usable():
        return _FileJob(file, record, found, [Request.write_files([(file, record, found)])])


@dataclass(frozen=True)
class _FileJob:
    """Records of a file to write, and the request that writes them."""

    file: int
    record: int
    values: list[int]
    requests: list[Request]

    @property
    def where(self) -> str:
        """What is numbered."""
        return f"file {self.file} record"

    def places(self, done: int = 0) -> str:
        """The records as text, without the first `done`."""
        first, last = self.record + done, self.record + len(self.values) - 1
        return f"{self.where} {last}" if first == last else f"{self.where}s {first} to {last}"

    @property
    def summary(self) -> str:
        """The result as text."""
        return f"Written: {self.places()}, 1 request"

    def to_json(self) -> dict[str, object]:
        """The job for JSON."""
        return {"file": self.file, "record": self.record, "count": len(self.values)}

    def write(self, client: SyncClient) -> None:
        """Writes the records."""
        client.write_file_record(self.file, self.record, self.values)

    def differing(self, client: SyncClient) -> dict[int, tuple[int, int]]:
        """Written and read-back values that differ, by record."""
        now = client.read_file_record(self.file, self.record, len(self.values))
        pairs = enumerate(zip(self.values, now, strict=True), self.record)
        return {record: pair for record, pair in pairs if pair[0] != pair[1]}


@dataclass(frozen=True)
class _Job:
    """Values to write, and the requests that write them."""

    place: Place
    typed: Typed
    value: Any
    split: bool
    requests: list[Request]

    @property
    def where(self) -> str:
        """What is numbered."""
        return self.place.area

    def places(self, done: int = 0) -> str:
        """The addresses as text, without the first `done`."""
        first = self.place.address + done
        last = self.place.address + self.typed.registers - 1
        return f"{self.where} {first}" if first == last else f"{self.where} {first} to {last}"

    @property
    def summary(self) -> str:
        """The result as text."""
        requests = terminal_text.counted(len(self.requests), "request")
        return f"Written: {self.places()}, {requests}"

    def to_json(self) -> dict[str, object]:
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
        if NUMBER.fullmatch(text.strip()) is None:
            point = f"; did you mean {text.replace(',', '.')!r}?" if "," in text else ""
            raise click.UsageError(f"{text!r} is not a number{point}")
        number = float(text)
        if math.isinf(number) and "inf" not in text.lower():
            raise click.UsageError(f"{text!r} is outside the range of {kind}.")
        if would_be_zero(text):
            raise click.UsageError(f"{text!r} is too small for {kind}, which would hold 0.")
        return number
    match = WHOLE.fullmatch(text)
    if match is None:
        raise click.UsageError(
            f"{text!r} is not an integer, decimal or 0x; other values require --type."
        )
    return int(match[1] + match[2], 0 if match[2][:2] in ("0x", "0X") else 10)
