"""A simulated device: a memory whose registers hold values of tags that change."""

from __future__ import annotations

import itertools
from random import Random
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast._core import Memory, Rule
from holdfast.simulation import generators
from holdfast.simulation.raw import nearest
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from holdfast.simulation.generators import Generator, Series
    from holdfast.tags import Tag, TagList
    from holdfast.types import Area


class Refused(ValueError):
    """A generator that a tag can't have."""


class SimulatedDevice:
    """A device with the addresses of its tags. `step` gives them their next values.

    A writable tag keeps what is written to it, as do tags in the same registers: they only have a
    first value. `chosen` are generators by name, `played` are whole series of values, which take
    precedence; other tags have a usual generator. The same
    seed gives the same values. Raises `Refused`.
    """

    def __init__(
        self,
        tags: TagList,
        *,
        step: float = 1.0,
        seed: str = "",
        chosen: Mapping[str, Generator] | None = None,
        played: Mapping[str, Sequence[Any]] | None = None,
    ) -> None:
        chosen, played = chosen or {}, played or {}
        writable = [tag for tag in tags if tag.writable]
        kept = {place for tag in writable for place in _places(tag)}
        extents = _extents(tags)
        self.memory = Memory(
            coils=extents.get("coils"),
            discrete_inputs=extents.get("discrete_inputs"),
            holding_registers=extents.get("holding_registers"),
            input_registers=extents.get("input_registers"),
        )
        self._registers: dict[Area, dict[int, int]] = {area: {} for area in AREAS}
        self._written = _spans(writable)
        self._readable = _spans(tags)
        self._series: list[tuple[Tag, list[Series]]] = []
        for tag in tags:
            if not kept.isdisjoint(_places(tag)):
                self._keep(tag, chosen.get(tag.name), played.get(tag.name))
            else:
                generator = chosen.get(tag.name) or generators.usual(tag)
                self._series.append(
                    (tag, _all_series(tag, generator, played.get(tag.name), step, seed))
                )
        self._write()
        self.step()

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
        self._registers = {area: {} for area in AREAS}
        for tag, series in self._series:
            numbers = [next(each) for each in series]
            self._put(tag, numbers if tag.of_type.count is not None else numbers[0])
        self._write()

    def _keep(self, tag: Tag, generator: Generator | None, played: Sequence[Any] | None) -> None:
        """Gives a tag its first value."""
        if generator is not None and generator.kind != "constant":
            raise Refused(
                f"{tag.name} keeps what is written to its registers, allowed: constant:VALUE"
            )
        value = (generator or generators.still(tag)).items[0] if played is None else played[0]
        whole = tag.of_type.count is None or isinstance(value, list)
        self._put(tag, value if whole else [value] * (tag.of_type.count or 1))

    def _put(self, tag: Tag, value: Any) -> None:
        """Puts a value into registers that `_write` writes."""
        registers = self._registers[tag.area]
        raw: Any = (
            [nearest(tag, each) for each in value]
            if isinstance(value, list)
            else nearest(tag, value)
        )
        if tag.of_type.base == "bit":
            bits = raw if isinstance(raw, list) else [raw]
            [mask] = values.encode(True, tag.of_type.element, tag.order)
            for at, bit in enumerate(bits, tag.address):
                old = registers.get(at, 0)
                registers[at] = old | mask if bit else old & ~mask
        elif tag.of_bits:
            bits = raw if isinstance(raw, list) else [raw]
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


def _places(tag: Tag) -> set[tuple[Area, int]]:
    return {(tag.area, address) for address in range(tag.address, tag.end)}


def _extents(tags: TagList) -> dict[Area, tuple[int, int]]:
    """Start and size of each area."""
    found = {}
    for area in AREAS:
        own = [tag for tag in tags if tag.area == area]
        if own:
            start = min(tag.address for tag in own)
            found[area] = start, max(tag.end for tag in own) - start
    return found


def _spans(tags: Sequence[Tag] | TagList) -> list[tuple[Area, int, int]]:
    """The addresses of tags, as areas, first addresses and counts."""
    spans: list[tuple[Area, int, int]] = []
    for tag in sorted(tags, key=lambda tag: (tag.area, tag.address)):
        if spans and spans[-1][0] == tag.area and tag.address <= sum(spans[-1][1:]):
            area, start, count = spans[-1]
            spans[-1] = area, start, max(count, tag.end - start)
        else:
            spans.append((tag.area, tag.address, tag.count))
    return spans
