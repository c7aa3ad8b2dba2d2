"""`holdfast read`: reads values of a device, once or repeatedly."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import device, pace, places, showing, tag_options, tag_source, tagged_read
from holdfast.cli.tag_options import TagFiles
from holdfast.cli.typed import typed, typed_options
from holdfast.errors import ModbusError, ModbusException, RequestTimeout
from holdfast.protocol import ADDRESSES, ILLEGAL_ADDRESS, LAST_ADDRESS
from holdfast.types import BIT_AREAS
from holdfast.values import ConversionError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from holdfast.cli.places import Place
    from holdfast.cli.typed import Typed
    from holdfast.client import SyncClient

BITS_A_LINE = 16
WIDEST = 14
"""The minimum width of a column of typed values with `--every`."""


@click.command(
    epilog="Example: holdfast read tcp://192.168.0.10 hr 100 4 --type float32 --order CDAB"
)
@tag_options.url_argument
@click.argument(
    "words",
    nargs=-1,
    metavar="[AREA ADDRESS [COUNT] | AREA:ADDRESS[:TYPE[:ORDER]]...]",
    shell_complete=places.complete,
)
@typed_options
@click.option(
    "--count",
    type=click.IntRange(1, ADDRESSES),
    metavar="N",
    help="Same as COUNT; with AREA:ADDRESS and tags, same as --times.",
)
@click.option(
    "--every", type=device.seconds, metavar="SECONDS", help="Repeat the read until Ctrl-C."
)
@click.option(
    "--times", type=click.IntRange(1), metavar="N", help="With --every: stop after N reads."
)
@tag_options.tag_options
@tag_options.output_options
@click.option("--modicon", is_flag=True, help="ADDRESS is a Modicon number, as in 40001 or 4x0001.")
@device.device_options
@device.json_option
def read(
    url: str,
    words: tuple[str, ...],
    kind: str | None,
    order: str,
    encoding: str | None,
    count: int | None,
    every: float | None,
    times: int | None,
    tag_file: Path | None,
    profile: str | None,
    config_file: Path | None,
    only: tuple[str, ...],
    max_gap: int,
    as_csv: bool,
    record: Path | None,
    modicon: bool,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Read COUNT values (default: 1) from AREA of the device at URL, starting at ADDRESS.

    With AREA:ADDRESS, reads several values, each with a type and order of its own, as in
    hr:0:float32 hr:10:uint32:CDAB coil:3. With --tags, reads the tags of a list.

    AREA is coils, discrete_inputs, holding_registers or input_registers; co, di, hr, ir, or any
    unambiguous prefix. ADDRESS counts from 0, decimal or 0x. With --modicon, it is 40001, 400001 or
    4x0001, which counts from 1 and includes the area (0, 1, 3, 4), so AREA is optional.

    URL is tcp://host:502, tls://host:802?ca=ca.pem, udp://host:502, rtu+tcp://host:502,
    rtu+udp://host:502, ascii+tcp://host:502, rtu:///dev/ttyUSB0?baud=19200 or
    ascii:///dev/ttyUSB0.

    Exit codes: 0 all values read, 1 some values not read, 2 wrong usage.
    """
    if times is not None and every is None:
        raise click.UsageError("--times requires --every.")
    files = TagFiles(tag_file, profile, config_file)
    of = tag_options.device_of(
        files, url, words, only, (kind, order, encoding), modicon, unit, timeout
    )
    if of is not None:
        form = tagged_read.form_of(as_json, as_csv)
        if count is not None and times is not None:
            raise click.UsageError("--count and --times are the same: give only one.")
        if count is not None and count > 1 and every is None:
            raise click.UsageError("--count requires --every.")
        with tag_source.opened(of, max_gap, record) as source:
            sys.exit(tagged_read.read_tags(source, form, every, times or count))
    tag_options.require_tags(as_csv=as_csv, record=record, only=only, max_gap=max_gap)
    if not words:
        raise click.UsageError("Missing argument 'AREA ADDRESS [COUNT]', AREA:ADDRESS or --tags.")
    place, left = places.taken(words, modicon=modicon)
    query = _query(place, _count(left, count), kind, order, encoding)
    told = {"url": url, "unit": unit, **query.told()}
    with device.connect(url, unit, timeout) as client:
        if every is not None:
            sys.exit(_again(client, query, told if as_json else None, every, times))
        try:
            raw = query.read(client)
        except ModbusError as error:
            device.tell(error, url, told if as_json else None, _hint(error, query))
            if isinstance(error, RequestTimeout):
                device.listen(client, place.area, place.address)
            sys.exit(device.FAILED)
    if as_json:
        click.echo(json.dumps({"ok": True, **told, **query.found(raw)}))
    else:
        click.echo("\n".join(query.lines(raw)))
    if query.undecodable(raw):
        sys.exit(device.FAILED)


def _count(words: Sequence[str], count: int | None) -> int:
    """The number of requested values."""
    if count is None or len(words) > 1:
        return places.counted(words)
    if words:
        raise click.UsageError("COUNT and --count are the same: give only one.")
    return count


def _query(place: Place, count: int, kind: str | None, order: str, encoding: str | None) -> _Query:
    asked = typed(kind, order, encoding, place.area, count)
    query = _Query(place, count if asked is None else asked.registers, asked)
    if place.address + query.size > ADDRESSES:
        items = showing.counted(query.size, query.noun)
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
        return device.read_raw(client, self.place.area, self.place.address, self.size)

    def told(self) -> dict[str, object]:
        """The query for JSON."""
        told: dict[str, object] = {
            "area": self.place.area,
            "address": self.place.address,
            "count": self.size,
        }
        if self.typed is not None:
            told |= {"type": self.typed.element, "order": self.typed.order}
        return told

    def found(self, raw: Sequence[int]) -> dict[str, object]:
        """The values for JSON."""
        items: dict[str, object] = {f"{self.noun}s": list(raw)}
        if self.typed is not None:
            found = self.typed.decode(raw)
            items["values"] = [
                None if isinstance(each, ConversionError) else showing.jsonable(each)
                for each in found
            ]
            wrong = {
                index: str(each)
                for index, each in enumerate(found)
                if isinstance(each, ConversionError)
            }
            if wrong:
                items["undecodable"] = wrong
        return items

    def undecodable(self, raw: Sequence[int]) -> bool:
        """Whether some registers are not a valid value of the type."""
        if self.typed is None:
            return False
        return any(isinstance(each, ConversionError) for each in self.typed.decode(raw))

    def lines(self, raw: Sequence[int]) -> list[str]:
        """The values as a table."""
        if self.typed is not None:
            return self._values(raw)
        return self._bits(raw) if self.of_bits else self._registers(raw)

    def _registers(self, raw: Sequence[int]) -> list[str]:
        rows = [
            (str(self.place.address + index), str(each), f"0x{each:04X}", _binary(each))
            for index, each in enumerate(raw)
        ]
        return showing.table(("address", "decimal", "hex", "binary"), rows, ">>>>")

    def _bits(self, raw: Sequence[int]) -> list[str]:
        width = min(BITS_A_LINE, len(raw))
        head = ["address", *(f"+{offset}" for offset in range(width))]
        rows = []
        for start in range(0, len(raw), width):
            bits = [str(int(bit)) for bit in raw[start : start + width]]
            rows.append(
                [str(self.place.address + start), *bits, *[""] * (width - len(bits))],
            )
        return showing.table(head, rows, ">" * (width + 1))

    def _values(self, raw: Sequence[int]) -> list[str]:
        assert self.typed is not None
        if self.of_bits:
            rows = [
                (str(self.place.address + index), _said(each, "bool"))
                for index, each in enumerate(self.typed.decode(raw))
            ]
            return showing.table(("address", "bool"), rows, "><")
        lines = []
        width = self.typed.width
        for index, value in enumerate(self.typed.decode(raw)):
            at = index * width
            own = " ".join(f"{each:04X}" for each in raw[at : at + width])
            lines.append((self._where(at, width), own, _said(value, self.typed.element)))
        return showing.table(("address", "registers", self.typed.element), lines, ">")

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
            "?" if isinstance(each, ConversionError) else showing.shown(each, self.typed.element)
            for each in self.typed.decode(raw)
        ]


def _again(
    client: SyncClient,
    query: _Query,
    told: dict[str, object] | None,
    every: float,
    times: int | None,
) -> int:
    """Reads at every tick and returns the exit code. Prints errors and continues."""
    code = 0
    lines = _Lines(query)
    try:
        for _ in pace.ticks(every, times):
            now = {"time": showing.timestamp()}
            try:
                raw = query.read(client)
            except ModbusError as error:
                code = device.FAILED
                if told is None:
                    lines.wrong(error)
                else:
                    click.echo(json.dumps(now | {"ok": False} | told | device.problem(error)))
                continue
            if told is None:
                lines.reading(raw)
            else:
                click.echo(json.dumps(now | {"ok": True} | told | query.found(raw)))
    except KeyboardInterrupt:
        if told is None and sys.stdout.isatty():
            click.echo()
    return code


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
            showing.styled(text, fg="yellow", bold=True) if cell != was else text
            for cell, was, text in zip(cells, before, self._filled(cells), strict=True)
        ]
        self._before = cells
        click.echo("  ".join([showing.clock(), *columns]).rstrip())

    def wrong(self, error: ModbusError) -> None:
        """Prints a failed reading."""
        click.echo(f"{showing.clock()}  {showing.styled(str(error), fg='red')}")

    def _begin(self, cells: Sequence[str]) -> None:
        heads = self._query.columns()
        least = 1 if self._query.of_bits else 5 if self._query.typed is None else WIDEST
        self._widths = [
            max(least, len(head), len(cell)) for head, cell in zip(heads, cells, strict=True)
        ]
        filled = self._filled(heads)
        click.echo(showing.styled("  ".join([f"{'time':<12}", *filled]).rstrip(), bold=True))

    def _filled(self, cells: Sequence[str]) -> list[str]:
        return [cell.rjust(width) for cell, width in zip(cells, self._widths, strict=True)]


def _hint(error: ModbusError, query: _Query) -> str | None:
    if isinstance(error, ModbusException) and error.code == ILLEGAL_ADDRESS:
        return places.modicon_hint(query.place)
    return None


def _binary(register: int) -> str:
    text = f"{register:016b}"
    return " ".join(text[at : at + 4] for at in range(0, 16, 4))


def _said(value: Any, kind: str) -> str:
    if isinstance(value, ConversionError):
        return showing.styled(f"? {value}", fg="red")
    return showing.shown(value, kind)
