"""`holdfast read`: reads values of a device, once or repeatedly."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import answers, device_errors, terminal_text
from holdfast.cli.devices import device_items
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.live import schedule
from holdfast.cli.options import device, item
from holdfast.cli.options.duration import every_option
from holdfast.cli.options.item import words_argument
from holdfast.cli.options.option import json_option, number_option
from holdfast.cli.options.plc_addresses import modicon_hint
from holdfast.cli.options.value_type import typed, typed_options
from holdfast.cli.signals import stops_as_ctrl_c
from holdfast.cli.tags import options as tag_options
from holdfast.cli.tags.options import TagFiles
from holdfast.cli.terminal_text import print_json
from holdfast.errors import ModbusError, ModbusException, RequestTimeout
from holdfast.protocol import ADDRESSES, ILLEGAL_ADDRESS, LAST_ADDRESS
from holdfast.types import BIT_AREAS
from holdfast.values import ConversionError
from holdfast.values.json import jsonable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.devices.device_items import Records
    from holdfast.cli.options.plc_addresses import Place
    from holdfast.cli.options.value_type import Typed
    from holdfast.cli.tags.options import Selection, TagFiles
    from holdfast.client import SyncClient

BITS_PER_LINE = 16
MIN_VALUE_COLUMNS = 14
"""The minimum width of a column of typed values with `--every`."""


@click.command(
    epilog="Example: holdfast read tcp://192.168.0.10 hr 100 4 --type float32 --order CDAB"
)
@tag_options.url_argument
@words_argument(item.ITEMS)
@typed_options
@every_option(None, "Repeat the read until Ctrl-C.")
@number_option("--times", "With --every: stop after N readings.")
@tag_options.tag_file_options
@tag_options.selection_options
@device.device_options
@json_option
def read(
    url: str,
    words: tuple[str, ...],
    kind: str | None,
    order: str,
    encoding: str | None,
    every: float | None,
    times: int | None,
    files: TagFiles,
    selection: Selection,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Read COUNT values (default: 1) from ITEM of the device at URL, or several items.

    ITEM is hr:0, hr 0, 40001, 4x0001 or %MW0. AREA:ADDRESS can have a type and an order of its own,
    as in hr:0:float32 hr:10:uint32:CDAB coil:3. file:4:0 is record 0 of file 4, fifo:1246 the
    queue at address 1246. With --tags, reads the tags of a list.

    AREA is coils, discrete_inputs, holding_registers or input_registers; co, di, hr, ir, or any
    unambiguous prefix. Beside it, ADDRESS counts from 0, decimal or 0x. Modicon numbers count from
    1 and include the area (0, 1, 3, 4).

    URL is tcp://host:502, tls://host:802?ca=ca.pem, udp://host:502, rtu+tcp://host:502,
    rtu+udp://host:502, ascii+tcp://host:502, rtu:///dev/ttyUSB0?baud=19200 or
    ascii:///dev/ttyUSB0.

    Exit codes: 0 all values read, 1 some values not read, 2 wrong usage.
    """
    click.get_current_context().with_resource(stops_as_ctrl_c())
    if times is not None and every is None:
        raise click.UsageError("--times requires --every. For 10 values, type hr:0 10.")
    in_no_area = device_items.is_named(words) and not files.given
    of = (
        None
        if in_no_area
        else tag_options.device_of(
            files, url, words, selection.only, (kind, order, encoding), unit, timeout
        )
    )
    if of is not None:
        from holdfast.cli.tags import read as tagged_read
        from holdfast.cli.tags import source as tag_source

        form = tag_options.form_of(as_json, selection.csv)
        with tag_source.opened(of, selection) as source:
            sys.exit(tagged_read.read_tags(source, form, every, times))
    selection.refuse()
    if not words:
        raise click.UsageError("Missing argument 'ITEM' (AREA ADDRESS, AREA:ADDRESS), or --tags.")
    query: _Query | Records
    if in_no_area:
        if kind is not None or order != "ABCD" or encoding is not None or every:
            raise click.UsageError(
                f"--type, --order, --encoding and --every can't be used with {words[0]}."
            )
        query = device_items.to_read(words)
    else:
        query = _query(words, kind, order, encoding)
    fields = {"target": url, "unit": unit, **query.to_json()}
    with device.connect(url, unit, timeout) as client:
        if every is not None and isinstance(query, _Query):
            sys.exit(_again(client, url, query, fields, every, times))
        try:
            raw = query.read(client)
        except ModbusError as error:
            place = query.place if isinstance(query, _Query) else None
            of_modicon = modicon_hint(place) if place and _is_absent(error) else None
            try:
                device_errors.fail(error, url, fields, of_modicon, is_in_area=place is not None)
            finally:  # Its hint follows the others.
                if place and isinstance(error, RequestTimeout) and error.maybe_sent:
                    device.await_late_reply(client, place.area, place.address)
    if as_json:
        print_json({"ok": not query.undecodable(raw), **fields, **query.found(raw)})
    else:
        click.echo("\n".join(query.lines(raw)))
    if query.undecodable(raw):
        sys.exit(ExitCode.FAILED)


def _query(
    words: Sequence[str],
    kind: str | None,
    order: str,
    encoding: str | None,
) -> _Query:
    first, count = item.take_range(words)
    if first.type is not None:
        if kind is not None or order != "ABCD":
            raise click.UsageError("--type and --order can't be used with AREA:ADDRESS:TYPE.")
        kind, order = first.type, first.order
    place = first.place
    asked = typed(kind, order, encoding, place.area, 1)
    size = number = count or 1
    if asked is not None:
        if first.count is not None:
            # FIRST-LAST are addresses also beside a type, as for `write`.
            number, rest = divmod(first.count, asked.registers)
            if rest:
                raise click.UsageError(
                    f"{first.text!r} is {terminal_text.counted(first.count, 'register')}, allowed "
                    f"with {kind}: a multiple of {asked.registers}."
                )
        asked = replace(asked, count=asked.count * number)
        size = asked.registers
    query = _Query(place, size, asked)
    if place.address + query.size > ADDRESSES:
        items = terminal_text.counted(query.size, query.noun)
        raise click.UsageError(
            f"{items} from address {place.address}: the last address is {LAST_ADDRESS}."
        )
    return query


@dataclass(frozen=True)
class _Query:
    """What to read, and how to print it."""

    place: Place
    size: int
    """In bits or registers."""
    typed: Typed | None

    @property
    def of_bits(self) -> bool:
        return self.place.area in BIT_AREAS

    @property
    def noun(self) -> str:
        return "bit" if self.of_bits else "register"

    def read(self, client: SyncClient) -> list[int]:
        element = 1 if self.typed is None else self.typed.width
        place = self.place
        return device.read_raw(client, place.area, place.address, self.size, element=element)

    def to_json(self) -> dict[str, object]:
        """The query for JSON."""
        fields: dict[str, object] = {
            "area": self.place.area,
            "address": self.place.address,
            "count": self.size,
        }
        if self.typed is not None:
            fields |= {"type": self.typed.element, "order": self.typed.order}
        return fields

    def found(self, raw: Sequence[int]) -> dict[str, object]:
        """The values for JSON."""
        items: dict[str, object] = {f"{self.noun}s": list(raw)}
        if self.typed is not None:
            found = self.typed.decode(raw)
            items["values"] = [_json_value(each, self.typed.element) for each in found]
            wrong = {
                str(index): {"reason": "undecodable", "detail": str(each)}
                for index, each in enumerate(found)
                if isinstance(each, ConversionError)
            }
            if wrong:
                items |= {**answers.first_of(wrong), "errors": wrong}
        return items

    def undecodable(self, raw: Sequence[int]) -> bool:
        """Whether some registers are not a valid value of the type."""
        if self.typed is None:
            return False
        return any(isinstance(each, ConversionError) for each in self.typed.decode(raw))

    def lines(self, raw: Sequence[int]) -> list[str]:
        """The values as a table. Its first heading is the area, which a Modicon number hides."""
        if self.typed is not None:
            return self._values(raw)
        return self._bits(raw) if self.of_bits else self._registers(raw)

    def _registers(self, raw: Sequence[int]) -> list[str]:
        return device_items.registers_table(self.place.area, self.place.address, raw)

    def _bits(self, raw: Sequence[int]) -> list[str]:
        width = min(BITS_PER_LINE, len(raw))
        head = [self.place.area, *(f"+{offset}" for offset in range(width))]
        rows = []
        for start in range(0, len(raw), width):
            bits = [str(int(bit)) for bit in raw[start : start + width]]
            rows.append(
                [str(self.place.address + start), *bits, *[""] * (width - len(bits))],
            )
        return terminal_text.table(head, rows, ">" * (width + 1))

    def _values(self, raw: Sequence[int]) -> list[str]:
        assert self.typed is not None
        if self.of_bits:
            rows = [
                (str(self.place.address + index), _value_text(each, "bool"))
                for index, each in enumerate(self.typed.decode(raw))
            ]
            return terminal_text.table((self.place.area, "bool"), rows, "><")
        lines = []
        width = self.typed.width
        for index, value in enumerate(self.typed.decode(raw)):
            at = index * width
            own = " ".join(f"{each:04X}" for each in raw[at : at + width])
            lines.append((self._where(at, width), own, _value_text(value, self.typed.element)))
        return terminal_text.table((self.place.area, "registers", self.typed.element), lines, ">")

    def _where(self, at: int, width: int) -> str:
        first = self.place.address + at
        return str(first) if width == 1 else f"{first}-{first + width - 1}"

    def columns(self) -> list[str]:
        """The column headings, for one line per reading."""
        step = 1 if self.typed is None else self.typed.width
        return [str(self.place.address + at) for at in range(0, self.size, step)]

    def cells(self, raw: Sequence[int]) -> list[str]:
        """The cells of a reading, for one line per reading."""
        if self.typed is None:
            return [str(int(each)) for each in raw]
        return [
            "?"
            if isinstance(each, ConversionError)
            else terminal_text.shown(each, self.typed.element)
            for each in self.typed.decode(raw)
        ]


def _again(
    client: SyncClient,
    url: str,
    query: _Query,
    fields: dict[str, object],
    every: float,
    times: int | None,
) -> int:
    """Reads at every tick and returns the exit code. Prints errors and continues."""
    code, as_json = 0, answers.wanted()
    lines = _Lines(query)
    try:
        for _ in schedule.ticks(every, times):
            try:
                raw = query.read(client)
            except ModbusError as error:
                code = ExitCode.FAILED
                if as_json:
                    print_json({"ok": False, **fields, **_now(), **device_errors.problem(error)})
                else:
                    lines.wrong(error)
                    device_errors.hint(error, url)
                continue
            if as_json:
                is_whole = not query.undecodable(raw)
                print_json({"ok": is_whole, **fields, **_now(), **query.found(raw)})
            else:
                lines.reading(raw)
    except KeyboardInterrupt:
        if not as_json and sys.stdout.isatty():
            click.echo()
    return code


def _now() -> dict[str, object]:
    return {"time": terminal_text.timestamp()}


class _Lines:
    """Prints one line per reading, with changes highlighted."""

    def __init__(self, query: _Query) -> None:
        self._query = query
        self._before: list[str] = []
        self._widths: list[int] = []

    def reading(self, raw: Sequence[int]) -> None:
        """Prints a reading; the column headings come before the first one."""
        cells = self._query.cells(raw)
        if not self._widths:
            self._begin(cells)
        before = self._before or cells
        columns = [
            terminal_text.styled(text, fg="yellow", bold=True) if cell != was else text
            for cell, was, text in zip(cells, before, self._filled(cells), strict=True)
        ]
        self._before = cells
        click.echo("  ".join([terminal_text.clock(), *columns]).rstrip())

    def wrong(self, error: ModbusError) -> None:
        """Prints a failed reading."""
        click.echo(f"{terminal_text.clock()}  {terminal_text.styled(str(error), fg='red')}")

    def _begin(self, cells: Sequence[str]) -> None:
        heads = self._query.columns()
        least = 1 if self._query.of_bits else 5 if self._query.typed is None else MIN_VALUE_COLUMNS
        self._widths = [
            max(least, len(head), len(cell)) for head, cell in zip(heads, cells, strict=True)
        ]
        filled = self._filled(heads)
        click.echo(terminal_text.styled("  ".join([f"{'time':<12}", *filled]).rstrip(), bold=True))

    def _filled(self, cells: Sequence[str]) -> list[str]:
        return [cell.rjust(width) for cell, width in zip(cells, self._widths, strict=True)]


def _is_absent(error: ModbusError) -> bool:
    return isinstance(error, ModbusException) and error.code == ILLEGAL_ADDRESS


def _json_value(value: Any, kind: str) -> Any:
    """A value for JSON: a float has the digits of its type, as in a table."""
    if isinstance(value, float) and math.isfinite(value):
        return float(terminal_text.shown(value, kind))
    return jsonable(value)


def _value_text(value: Any, kind: str) -> str:
    if isinstance(value, ConversionError):
        return terminal_text.styled(f"? {value}", fg="red")
    return terminal_text.shown(value, kind)
