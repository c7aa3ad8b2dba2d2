"""The description of a device as text and for JSON."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from holdfast.cli import coverage, showing
from holdfast.cli.unit_ids import listed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.tools.description import Described, Description
    from holdfast.tools.finding import Unit

BITS = 16
"""The most bits in a cell."""


def described_lines(
    url: str,
    asked: Sequence[int],
    seen: Sequence[Unit],
    found: Sequence[Description],
    ignores: bool,
    most: int | None,
) -> list[str]:
    """A description as text, with at most so many lines of tags for each unit id."""
    answering = [each.unit for each in seen if each.answers]
    silent = [each.unit for each in seen if not each.answers]
    unasked = set(asked) - set(answering) - set(silent)
    lines = [f"{url}: unit ids that answer: {listed(answering)}"]
    if silent:
        lines[0] += f"; no device: {listed(silent)}"
    lines[0] += f"; not asked: {listed(unasked) + ' and ' if unasked else ''}all others"
    if ignores:
        lines.append("It also answers a rare unit id: it probably ignores them. One is described.")
    for each in found:
        lines += ["", *_device(each, most)]
    return lines


def _device(found: Description, most: int | None) -> list[str]:
    """One unit id."""
    about = showing.plain(str(found.identity)) or "no identification"
    lines = [showing.styled(f"Unit {found.unit}: {about}", bold=True)]
    if found.sunspec is not None:
        models = ", ".join(
            f"{each.id} {each.label or '(unknown here)'}" for each in found.sunspec.models
        )
        end = "" if found.sunspec.is_complete else "; the end of the models was not found"
        lines.append(f"SunSpec at {found.sunspec.base}: models {models or 'none'}{end}")
    if found.orders:
        order, share = max(found.orders.items(), key=lambda each: each[1])
        lines.append(f"Byte order: probably {order} ({share:.2f})")
    rows = list(_rows(found.tags))
    if rows:
        head = ("name", "area", "address", "type", "order", "value", "unit", "confidence", "why")
        lines += ["", *showing.table(head, rows[:most], "<<><<><>")]
    if most is not None and len(rows) > most:
        lines.append(f"and {len(rows) - most} more lines; --all shows them")
    for (area, extent), error in found.unread.items():
        lines.append(f"{area} {extent.start}-{extent.stop - 1} could not be read again: {error}")
    lines += ["", *coverage.counts(found.survey)]
    if not found.survey.exact:
        lines += ["", *coverage.UNKNOWN]
    return lines


def _rows(tags: Sequence[Described]) -> Iterator[tuple[str, ...]]:
    """A row for each tag; neighbouring bits share one."""
    for of_bits, group in itertools.groupby(enumerate(tags), key=_neighbours):
        own = [tag for _, tag in group]
        if of_bits[0] is None or len(own) == 1:
            yield from map(_row, own)
            continue
        first, last = own[0], own[-1]
        yield (
            f"{first.tag.name} … {last.tag.name}" if showing.fits("…") else first.tag.name,
            first.tag.area,
            f"{first.tag.address}-{last.tag.address}",
            f"{len(own)} bool",
            "",
            _bits([bool(each.values[-1]) for each in own]),
            "",
            "1.00",
            "some change" if any(each.reasons for each in own) else "",
        )


def _neighbours(numbered: tuple[int, Described]) -> tuple[object, int]:
    """A key that is the same for bits with consecutive addresses, and differs for others."""
    index, each = numbered
    is_bit = each.tag.type == "bool"
    return (each.tag.area, each.tag.address - index) if is_bit else (None, index)


def _bits(bits: Sequence[bool]) -> str:
    return "".join("1" if bit else "0" for bit in bits[:BITS]) + ("…" if len(bits) > BITS else "")


def _row(each: Described) -> tuple[str, ...]:
    tag = each.tag
    return (
        tag.name,
        tag.area,
        str(tag.address) if tag.count == 1 else f"{tag.address}-{tag.end - 1}",
        tag.type,
        tag.order if tag.count > 1 else "",
        _value(each),
        tag.unit,
        f"{each.confidence:.2f}",
        ", ".join(each.reasons),
    )


def _value(each: Described) -> str:
    """The value of the last read, after that of the first read if it changed."""
    first, last = (_shown(each, each.values[at]) for at in (0, -1))
    return last if first == last else f"{first} … {last}"


def _shown(each: Described, raw: object) -> str:
    tag = each.tag
    if tag.of_type.count is not None and not isinstance(raw, list):
        return showing.shown(raw, tag.of_type.base)
    if isinstance(raw, list):
        return _bits(raw)
    value = tag.value(raw)
    name = tag.state(value)
    text = showing.shown(value, tag.of_type.base)
    return f"{text} ({name})" if name else text


def described_told(
    url: str,
    asked: Sequence[int],
    seen: Sequence[Unit],
    found: Sequence[Description],
    ignores: bool,
    why: str | None,
    files: Sequence[str],
) -> dict[str, object]:
    """The result for JSON."""
    done = [each.unit for each in seen]
    return {
        "ok": why is None,
        **({} if why is None else {"detail": why}),
        "url": url,
        "answering": [each.unit for each in seen if each.answers],
        "silent": [each.unit for each in seen if not each.answers],
        "not_asked": [unit for unit in asked if unit not in done],
        "ignores_unit": ignores,
        "files": list(files),
        "units": [_unit(each) for each in found],
    }


def _unit(found: Description) -> dict[str, object]:
    models = () if found.sunspec is None else found.sunspec.models
    return {
        "unit": found.unit,
        "complete": found.survey.is_done,
        "identification": dict(found.identity.objects),
        "sunspec": None
        if found.sunspec is None
        else {
            "base": found.sunspec.base,
            "complete": found.sunspec.is_complete,
            "models": [
                {"id": each.id, "name": each.name, "address": each.address, "length": each.length}
                for each in models
            ],
        },
        "orders": {order: round(share, 4) for order, share in found.orders.items()},
        "areas": {
            each.area: {
                "state": each.state,
                "exist": each.addresses,
                "absent": sum(map(len, each.absent)),
                "not_asked": len(found.survey.span) - each.asked,
            }
            for each in found.survey.areas
        },
        "tags": [_tag(each) for each in found.tags],
    }


def _tag(each: Described) -> dict[str, object]:
    tag = each.tag
    return {
        "name": tag.name,
        "area": tag.area,
        "address": tag.address,
        "type": tag.type,
        "order": tag.order,
        "scale": tag.scale,
        "unit": tag.unit,
        "confidence": round(each.confidence, 4),
        "values": [showing.jsonable(value) for value in each.values],
        "reasons": list(each.reasons),
    }
