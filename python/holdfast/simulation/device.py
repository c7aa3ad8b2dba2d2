"""A simulated device: a memory whose registers hold values of tags that change."""

from __future__ import annotations

import itertools
from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast._core import Memory, Rule
from holdfast.simulation import usual_values
from holdfast.simulation.capacity import nearest
from holdfast.simulation.scale_registers import RowDoesNotFit, Scales
from holdfast.tags.scale import RegisterScale
from holdfast.types import AREAS
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from holdfast.simulation.generators import Generator, Series
    from holdfast.tags import Tag, TagList
    from holdfast.tags.scale import Form
    from holdfast.types import Area


class Refused(ValueError):
    """Values that a tag can't have."""

    def __init__(self, tag: str, message: str, row: int | None = None) -> None:
        super().__init__(tag, message, row)
        self.tag, self.message = tag, message
        self.row = row
        """The row of a value that is played, from 0."""

    def __str__(self) -> str:
        return self.message


class SimulatedDevice:
    """A device with the addresses of its tags. `step` gives them their next values.

    A writable tag keeps what is written to it, as do tags in the same registers: they only have a
    first value. `chosen` are generators by name, `played` are whole series of values, which take
    precedence; other tags have a usual generator. Registers of scales exist even if no tag names
    them, and values are written with the scale that they contain. The same
    seed gives the same values. Raises `Refused`, also for values that the registers can't hold.

    A client that writes a scale can make values too large for their registers, which then hold the
    nearest: `warn` is called with a message when this begins, and when a counter begins again at 0.
    """

    def __init__(
        self,
        tags: TagList,
        *,
        step: float = 1.0,
        seed: str = "",
        chosen: Mapping[str, Generator] | None = None,
        played: Mapping[str, Sequence[Any]] | None = None,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        chosen, played = chosen or {}, played or {}
        everything = [*tags, *_unnamed(tags)]
        chosen = {**_of_scales(everything), **chosen}
        writable = [tag for tag in tags if tag.writable]
        kept = {place for tag in writable for place in _places(tag)}
        self.memory = Memory(**_extents(everything))
        self._registers: dict[Area, dict[int, int]] = {area: {} for area in AREAS}
        self._written = _spans((tag.area, range(tag.address, tag.end)) for tag in writable)
        self._readable = _spans((tag.area, tag.span) for tag in everything)
        self._warn = warn or (lambda _: None)
        self._counted: dict[str, float] = {}
        """The last value of each counter."""
        self._scales = Scales(self._content, self._warn)
        self._series: list[tuple[Tag, list[Series]]] = []
        sources = {(tag.source.area, tag.source.address) for tag in tags if tag.source is not None}
        scaled = [tag for tag in everything if tag.source is not None]
        for some in ([tag for tag in everything if tag.source is None], scaled):
            begun = len(self._series)
            for tag in some:
                of, values = chosen.get(tag.name), played.get(tag.name)
                if not kept.isdisjoint(_places(tag)):
                    self._keep(tag, of, values)
                    continue
                generator = self._generator(tag, of, values, step)
                self._series.append((tag, _all_series(tag, generator, values, step, seed)))
                if (tag.area, tag.address) in sources:
                    self._scales.note(tag, generator, values)
            self._write()
            self._advance(self._series[begun:])

    def rule(self, unit: int, sources: Sequence[str]) -> Rule:
        """The rights of clients: to read what tags have, and to write what is writable."""
        return Rule(
            {unit: self.memory},
            sources=list(sources),
            access="read-write",
            narrowed={unit: ("read-write", None, None, (self._readable, self._written))},
        )

    def step(self) -> None:
        """Gives all tags that are not writable their next values, in one step."""
        self._advance(self._series)

    def _advance(self, all_series: Iterable[tuple[Tag, list[Series]]]) -> None:
        self._registers = {area: {} for area in AREAS}
        for tag, series in all_series:  # Those that contain scales come before those with them.
            numbers = [next(each) for each in series]
            self._note_turn(tag, numbers[0])
            self._put(tag, numbers if tag.of_type.count is not None else numbers[0])
        self._write()

    def _note_turn(self, tag: Tag, number: Any) -> None:
        """Warns when a counter begins again, the first time."""
        before = self._counted.get(tag.name)
        if before is None:
            return
        self._counted[tag.name] = number
        if abs(number) < abs(before):
            del self._counted[tag.name]
            self._warn(f"{tag.name} has counted to the end of {tag.type}, and begins again at 0")

    def _generator(
        self, tag: Tag, of: Generator | None, played: Sequence[Any] | None, step: float
    ) -> Generator:
        """What the values of a tag do. Raises `Refused` if they, or those played, do not fit."""
        within = self._scales.within(tag) if tag.is_number else (0.0, 0.0)
        try:
            if played is not None:
                self._scales.check_played(tag, played)
                return usual_values.still(tag)  # Not used: what is played takes precedence.
            found = of or usual_values.usual(self._scales.now(tag), *within)
            if found.kind == "counter":
                least_step = self._scales.least_step(tag)
                self._scales.check(tag, [0, found.first_count(step, least_step)])
                found = found.turning(*within, least_step)
                self._counted[tag.name] = 0
            else:
                self._scales.check(tag, found.ends)
        except RowDoesNotFit as error:
            raise Refused(tag.name, str(error), error.row) from None
        except DoesNotFit as error:
            raise Refused(tag.name, str(error)) from None
        except ValueError as error:
            raise Refused(tag.name, f"{tag.name}: {error}") from None
        return found

    def _content(self, source: Tag) -> Any:
        """What a register contains that has the scale of other tags."""
        changed = self._registers[source.area]
        now = self.memory.read(source.area, source.address, source.count)
        registers = [changed.get(at, old) for at, old in enumerate(now, source.address)]
        return values.decode(registers, source.type, source.order)

    def _keep(self, tag: Tag, generator: Generator | None, played: Sequence[Any] | None) -> None:
        """Gives a tag its first value."""
        if generator is not None and generator.kind != "constant":
            raise Refused(
                tag.name,
                f"{tag.name} keeps what is written to its registers, allowed: constant:VALUE",
            )
        value = (generator or usual_values.still(tag)).items[0] if played is None else played[0]
        if generator is not None or played is not None:
            try:
                self._scales.check(tag, [value])
            except DoesNotFit as error:
                row = None if played is None else 0
                raise Refused(tag.name, str(error), row) from None
        whole = tag.of_type.count is None or isinstance(value, list)
        self._put(tag, value if whole else [value] * (tag.of_type.count or 1))

    def _put(self, tag: Tag, value: Any) -> None:
        """Puts a value into registers that `_write` writes; without a scale, they do not change."""
        try:
            tag = self._scales.for_value(tag, value)
        except ValueError:
            return
        registers = self._registers[tag.area]
        raw: Any = (
            [nearest(tag, each) for each in value]
            if isinstance(value, list)
            else nearest(tag, value)
        )
        bits = raw if isinstance(raw, list) else [raw]
        if tag.of_type.base == "bit":
            [mask] = values.encode(True, tag.of_type.element, tag.order)
            for at, bit in enumerate(bits, tag.address):
                old = registers.get(at, 0)
                registers[at] = old | mask if bit else old & ~mask
        elif tag.of_bits:
            registers.update(enumerate(map(int, bits), tag.address))
        else:
            made = values.encode(raw, tag.type, tag.order, encoding=tag.encoding)
            registers.update(enumerate(made, tag.address))

    def _write(self) -> None:
        writes = [
            (area, address, [value])
            for area, registers in self._registers.items()
            for address, value in registers.items()
        ]
        if writes:
            self.memory.write_many(writes)


def _all_series(
    tag: Tag, generator: Generator, played: Sequence[Any] | None, step: float, seed: str
) -> list[Series]:
    """A series for each element of an array, or one."""
    if played is not None:
        count = tag.of_type.count
        return [_played(played, None if count is None else at) for at in range(count or 1)]
    if generator.kind == "constant" and isinstance(generator.items[0], list):
        return [itertools.repeat(each) for each in generator.items[0]]
    return [
        generator.series(step, Random(f"{seed}:{tag.name}:{at}"))
        for at in range(tag.of_type.count or 1)
    ]


def _played(values: Sequence[Any], at: int | None) -> Iterator[Any]:
    while True:
        for value in values:
            yield value if at is None or value is None else value[at]


def _unnamed(tags: TagList) -> Iterator[Tag]:
    """The registers of scales that no tag has."""
    named = {place for tag in tags for place in _places(tag)}
    for source in dict.fromkeys(tag.source for tag in tags if tag.source is not None):
        if named.isdisjoint(_places(source)):
            yield replace(source, name=f"{source.area} {source.address}")


def _of_scales(tags: Sequence[Tag]) -> dict[str, Generator]:
    """The generators of registers that contain the scales of other tags, by name."""
    forms: dict[tuple[Area, int], Form] = {}
    for tag in tags:
        if tag.source is not None and isinstance(tag.scale, RegisterScale):
            forms[tag.source.area, tag.source.address] = tag.scale.form
    places = {tag: (tag.area, tag.address) for tag in tags if tag.is_number}
    return {
        tag.name: usual_values.scale(tag, forms[place])
        for tag, place in places.items()
        if place in forms and tag.source is None
    }


def _places(tag: Tag) -> set[tuple[Area, int]]:
    return {(tag.area, address) for address in range(tag.address, tag.end)}


def _extents(tags: Sequence[Tag]) -> dict[str, Any]:
    """Start and size of each area."""
    found: dict[str, Any] = {}
    for area in AREAS:
        own = [tag for tag in tags if tag.area == area]
        if own:
            start = min(tag.address for tag in own)
            found[area] = start, max(tag.end for tag in own) - start
    return found


def _spans(places: Iterable[tuple[Area, range]]) -> list[tuple[Area, int, int]]:
    """Addresses as areas, first addresses and counts."""
    spans: list[tuple[Area, int, int]] = []
    for of, span in sorted(places, key=lambda place: (place[0], place[1].start)):
        if spans and spans[-1][0] == of and span.start <= sum(spans[-1][1:]):
            area, start, count = spans[-1]
            spans[-1] = area, start, max(count, span.stop - start)
        else:
            spans.append((of, span.start, len(span)))
    return spans
