"""The tags of SunSpec points: their names, and the scales that registers contain."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from holdfast.discovery.described_tag import DescribedTag
from holdfast.tags import Tag
from holdfast.tags.scale import RegisterScale
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.discovery.sunspec import Model, Point, SunSpec


def tags_of(found: SunSpec, limit: int) -> Iterator[DescribedTag]:
    """The points of all models that have a value, and their scale factors. One request may be for
    `limit` registers.
    """
    names: set[str] = set()
    for model in found.models:
        factors: dict[int, str] = {}
        for point in model.points:
            if point.value is None:
                continue
            if point.scaled_at is not None and point.scaled_at not in factors:
                factors[point.scaled_at] = _unique(f"{model.name}_{point.scaled_by}", names)
                yield _factor(model, point, factors[point.scaled_at], point.scaled_at)
            for part in _parts(point, limit):
                yield _of_point(model, part, names, limit, factors)


def _factor(model: Model, point: Point, name: str, address: int) -> DescribedTag:
    """The tag of a scale factor: a recording without it can't be played back."""
    text = f"SunSpec model {model.id}, scale factor"
    tag = Tag(name, "holding_registers", address, "int16", description=text)
    return DescribedTag(tag, 1.0, (round(math.log10(point.scale)),), (text,))


def _parts(point: Point, limit: int) -> Iterator[Point]:
    """A point, in parts that the device returns in one request. Only texts have any; one that would
    be cut inside of a character has none.
    """
    size = parsed(point.type).registers
    if point.encoding is None or size <= limit:
        yield point
        return
    content = point.value.encode(point.encoding)
    starts = range(0, len(content), 2 * limit)  # What follows the text is padding.
    try:
        texts = [content[at : at + 2 * limit].decode(point.encoding) for at in starts]
    except UnicodeDecodeError:
        return
    for number, text in enumerate(texts):
        first = number * limit
        yield replace(
            point,
            name=f"{point.name}_{number + 1}",
            address=point.address + first,
            type=f"string:{2 * min(limit, size - first)}",
            value=text,
        )


def _of_point(
    model: Model, point: Point, names: set[str], limit: int, factors: Mapping[int, str]
) -> DescribedTag:
    scale, flaw = _scale_of(point, limit, factors)
    name = _unique(f"{model.name}_{point.name}{'_raw' if flaw else ''}", names)
    text = f"SunSpec model {model.id}"
    if point.label:
        text += f", {point.label}"
    if point.scaled_by is not None:
        text += f"; {'no ' if flaw else ''}scale from {point.scaled_by}"
    if flaw:
        text += f", {flaw}"
    if point.can_be_written:
        text += "; can be written"
    tag = Tag(
        name,
        "holding_registers",
        point.address,
        point.type,
        encoding=point.encoding,
        scale=1 if flaw else point.scale,
        unit="" if flaw else point.unit,
        states=point.states,
        null=frozenset(() if point.missing is None else (point.missing,)),
        description=text,
    )
    if scale is None:
        return DescribedTag(tag, 1.0, (point.value,), (text,))
    return DescribedTag(replace(tag, scale=scale), 1.0, (point.value,), (text,), shown=tag)


def _scale_of(
    point: Point, limit: int, factors: Mapping[int, str]
) -> tuple[RegisterScale | None, str]:
    """The register that contains the scale of a point, or why no tag can have it."""
    if point.scaled_at is None:
        return None, ""
    size = parsed(point.type).registers
    first, last = (
        min(point.address, point.scaled_at),
        max(point.address + size, point.scaled_at + 1),
    )
    if last - first > limit:
        return None, f"which is at {point.scaled_at}, too far to be read with it"
    name = factors[point.scaled_at]
    source = Tag(name, "holding_registers", point.scaled_at, "int16")
    return RegisterScale("exponent", name, source), ""


def _unique(name: str, names: set[str]) -> str:
    """The name, with a number if another tag has it, of at most 64 characters."""
    chosen, number = name[:64], 1
    while chosen in names:
        number += 1
        chosen = f"{name[:60]}_{number}"
    names.add(chosen)
    return chosen
