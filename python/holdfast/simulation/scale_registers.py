"""The scales that simulated tags have and will have, and whether values fit with them."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast.simulation.capacity import Capacity, extremes, nearest
from holdfast.tags.scale import RegisterScale
from holdfast.values import DoesNotFit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from holdfast.simulation.generators import Generator
    from holdfast.tags import Tag
    from holdfast.types import Area

AROUND_ZERO = (-1, 0, 1)
"""The whole numbers with which a scale is smallest, or the value is none."""


class RowDoesNotFit(DoesNotFit):
    """A value that is played. The first row is 0."""

    def __init__(self, message: str, row: int) -> None:
        super().__init__(message)
        self.row = row


class Scales:
    """What registers that contain scales will contain. `content` decodes what one contains now.

    That is all that is known of a register that clients write. Values that do not fit with its
    scale are the nearest that do, and `warn` says so.
    """

    def __init__(self, content: Callable[[Tag], Any], warn: Callable[[str], None]) -> None:
        self._content = content
        self._warn = warn
        self._misfits: set[str] = set()
        """Tags whose value does not fit with the scale that a client has written."""
        self._contents: dict[tuple[Area, int], list[Any]] = {}
        self._rows: dict[tuple[Area, int], list[Any]] = {}
        """Those that are played: one for each row."""

    def note(self, register: Tag, generator: Generator, played: Sequence[Any] | None) -> None:
        """Notes what a register will contain. The generator's series stays between its ends."""
        place = register.area, register.address
        if played is not None:
            self._rows[place] = [_decoded(register, value) for value in played]
            return
        found = [_decoded(register, value) for value in generator.ends]
        if not register.is_float and len(found) > 1:
            found += [each for each in AROUND_ZERO if min(found) < each < max(found)]
        self._contents[place] = found

    def check(self, tag: Tag, values: Iterable[Any]) -> None:
        """Raises `DoesNotFit` if one of these values does not fit with one of the scales."""
        capacities = self._capacities(self._all_contents(tag), tag)
        for value, capacity in itertools.product(values, capacities):
            capacity.check(value)

    def check_played(self, tag: Tag, values: Sequence[Any]) -> None:
        """The same for values that are played. A scale that is played belongs to one row.

        Raises `RowDoesNotFit`.
        """
        source = tag.source
        rows = None if source is None else self._rows.get((source.area, source.address))
        if rows is None or len(rows) != len(values):
            of_rows = [self._capacities(self._all_contents(tag), tag)] * len(values)
        else:
            by_content = {each: self._capacities([each], tag) for each in dict.fromkeys(rows)}
            of_rows = [by_content[content] for content in rows]
        for row, (value, capacities) in enumerate(zip(values, of_rows, strict=True)):
            for capacity in capacities:
                try:
                    capacity.check(value)
                except DoesNotFit as error:
                    raise RowDoesNotFit(str(error), row) from None

    def within(self, tag: Tag) -> tuple[float, float]:
        """The range that registers of a number can hold with all of the scales."""
        ranges = [extremes(each) for each in _scaled(self._all_contents(tag), tag)]
        least = max((low for low, _ in ranges), default=-math.inf)
        return least, min((high for _, high in ranges), default=math.inf)

    def least_step(self, tag: Tag) -> float:
        """The smallest difference between two values with one of the scales."""
        if tag.is_float:
            return 0
        scaled = _scaled(self._all_contents(tag), tag)
        return min(
            (abs(each.scale) for each in scaled if isinstance(each.scale, int | float)), default=1
        )

    def now(self, tag: Tag) -> Tag:
        """The tag with the scale that its register contains. Raises `ValueError` without one."""
        return tag if tag.source is None else tag.with_scale(self._content(tag.source))

    def for_value(self, tag: Tag, value: Any) -> Tag:
        """The same for a value that is written. Warns when values begin not to fit."""
        scaled = self.now(tag)
        if isinstance(tag.scale, RegisterScale):
            try:
                Capacity(scaled, tag.scale.where).check(value)
            except DoesNotFit as error:
                if tag.name not in self._misfits:
                    self._misfits.add(tag.name)
                    self._warn(str(error))
            else:
                self._misfits.discard(tag.name)
        return scaled

    def _all_contents(self, tag: Tag) -> list[Any]:
        """Without a register for the scale, one content that is not used."""
        source = tag.source
        if source is None:
            return [None]
        place = source.area, source.address
        if place in self._rows:
            return list(dict.fromkeys(self._rows[place]))
        return self._contents.get(place) or [self._content(source)]

    def _capacities(self, contents: Iterable[Any], tag: Tag) -> list[Capacity]:
        place = tag.scale.where if isinstance(tag.scale, RegisterScale) else ""
        return [Capacity(each, place) for each in _scaled(contents, tag)]


def _scaled(contents: Iterable[Any], tag: Tag) -> list[Tag]:
    """The tag with each of its scales. Contents that are no scale are left out: nothing is written
    then.
    """
    if tag.source is None:
        return [tag]
    found = []
    for content in contents:
        try:
            found.append(tag.with_scale(content))
        except ValueError:
            continue
    return found


def _decoded(register: Tag, value: Any) -> Any:
    """What the register contains for a value, as it is read."""
    made = values.encode(nearest(register, value), register.type, register.order)
    return values.decode(made, register.type, register.order)
