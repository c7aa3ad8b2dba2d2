"""The description of a device as text and for JSON."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from holdfast.cli import terminal_text
from holdfast.cli.devices import coverage
from holdfast.cli.devices.search_report import ignored_text, ignored_to_json
from holdfast.cli.terminal_text import number_ranges
from holdfast.config.tag_files.write import scale_as_data
from holdfast.discovery.description import undescribed
from holdfast.discovery.device_search import devices
from holdfast.discovery.segments import FILL_REASONS
from holdfast.tags.scale import RegisterScale
from holdfast.values.json import jsonable

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.discovery.described_tag import DescribedTag
    from holdfast.discovery.description import Description
    from holdfast.discovery.device_search import Unit
    from holdfast.discovery.sunspec import SunSpec

FILL_REASON_TEXTS = tuple(FILL_REASONS.values())
MAX_BITS_SHOWN = 16
"""The most bits in a cell."""


def units_lines(
    url: str, asked: Sequence[int], seen: Sequence[Unit], alike: Sequence[Unit]
) -> Iterator[str]:
    """Which unit ids answer, as text."""
    answering = [each.unit for each in seen if each.answers]
    silent, garbled = _without_answer(seen)
    unasked = set(asked) - {each.unit for each in seen}
    yield (
        f"{url}: unit ids that answer: {number_ranges(answering)}"
        + (f"; no device: {number_ranges(silent)}" if silent else "")
        + (f"; invalid replies: {number_ranges(garbled)}" if garbled else "")
        + f"; not asked: {number_ranges(unasked) + ' and ' if unasked else ''}all others"
    )
    if alike:
        is_one = any(each in alike for each in devices(seen, alike))
        yield f"{ignored_text(seen, alike)} {'One is' if is_one else 'None of them is'} described."


def _without_answer(seen: Sequence[Unit]) -> tuple[list[int], list[int]]:
    """The unit ids without any reply, and those whose replies are invalid."""
    others = [each for each in seen if not each.answers]
    silent = [each.unit for each in others if not each.is_garbled]
    return silent, [each.unit for each in others if each.is_garbled]


def head_lines(found: Description) -> list[str]:
    """The identification of a unit id, and its SunSpec models."""
    about = terminal_text.plain(str(found.identity)) or "no identification"
    lines = [terminal_text.styled(f"Unit {found.unit}: {about}", bold=True)]
    if found.sunspec is not None:
        models = ", ".join(
            f"{each.id} {each.label or '(unknown here)'}" for each in found.sunspec.models
        )
        flaw = found.sunspec.flaw
        end = "" if flaw is None else f"; the end of the models was not found: {flaw}"
        lines.append(f"SunSpec at {found.sunspec.base}: models {models or 'none'}{end}")
        left = [
            f"{each.without_value} of model {each.id}"
            for each in found.sunspec.models
            if each.without_value
        ]
        if left:
            lines.append(
                f"Points without a value now have no tag: {', '.join(left)}. "
                "Describe the device while it works."
            )
    return lines


def described_lines(found: Description, most: int | None) -> list[str]:
    """A description as text, with at most so many lines of tags."""
    orders = []
    if found.orders:
        order, share = max(found.orders.items(), key=lambda each: each[1])
        orders.append(f"Byte order: probably {order} ({share:.2f})")
    rows = list(_rows(found.tags))
    head = ("name", "area", "address", "type", "order", "value", "unit", "confidence", "why")
    tags = terminal_text.table(head, rows[:most], "<<><<><>") if rows else []
    if most is not None and len(rows) > most:
        tags.append(f"and {len(rows) - most} more lines; --all shows them")
    for (area, error), ranges in found.unread.items():
        tags.append(f"{area}: {error} when read again, at {coverage.shown(ranges)}")
    counts = [*coverage.counts(found.survey), *coverage.incomplete(found.survey)]
    left = [f"{area} {span.start}-{span.stop - 1}" for area, span in undescribed(found)]
    if left:
        counts.append(f"Incomplete. Not described: {', '.join(left)}.")
    failures = coverage.failures(found.survey)
    limits = () if found.survey.exact else coverage.unknown(found.survey)
    parts = (orders, tags, counts, failures, limits)
    return [line for part in parts if part for line in ("", *part)]


def _rows(tags: Sequence[DescribedTag]) -> Iterator[tuple[str, ...]]:
    """A row for each tag. Neighbouring bits share one, and neighbours that contain nothing."""
    for kind, group in itertools.groupby(_runs(tags), key=lambda each: each[0]):
        own = [tag for _, tag in group]
        first, last = own[0], own[-1]
        if kind[1] is None or len(own) == 1:
            yield from map(_row, own)
            continue
        is_bit = first.tag.type == "bool"
        count = sum(each.tag.count for each in own)
        changed = is_bit and any(each.reasons for each in own)
        yield (
            f"{first.tag.name} … {last.tag.name}" if terminal_text.fits("…") else first.tag.name,
            first.tag.area,
            f"{first.tag.address}-{last.tag.end - 1}",
            f"bool[{count}]" if is_bit else f"uint16[{count}]",
            "",
            _bits([bool(each.values[-1]) for each in own]) if is_bit else _value(first),
            "",
            f"{first.confidence:.2f}",
            "some change" if changed else ", ".join(first.reasons),
        )


def _runs(tags: Sequence[DescribedTag]) -> Iterator[tuple[tuple[int, str | None], DescribedTag]]:
    """Tags, each with the number and kind of its run; the kind is `None` for a run of one."""
    number, before, kind_before = 0, None, None
    for each in tags:
        kind = _kind(each)
        follows = before is not None and (before.area, before.end) == (
            each.tag.area,
            each.tag.address,
        )
        if kind is None or kind != kind_before or not follows:
            number += 1
        yield (number, kind), each
        before, kind_before = each.tag, kind


def _kind(each: DescribedTag) -> str | None:
    """The kind of a tag: neighbours of one kind share a row; `None`: a row for the tag alone."""
    if each.tag.type == "bool":
        return "bits"
    return each.reasons[0] if each.reasons and each.reasons[0] in FILL_REASON_TEXTS else None


def _bits(bits: Sequence[bool]) -> str:
    return "".join("1" if bit else "0" for bit in bits[:MAX_BITS_SHOWN]) + (
        "…" if len(bits) > MAX_BITS_SHOWN else ""
    )


def _row(each: DescribedTag) -> tuple[str, ...]:
    tag = each.tag
    return (
        tag.name,
        tag.area,
        str(tag.address) if tag.count == 1 else f"{tag.address}-{tag.end - 1}",
        tag.type,
        terminal_text.order_shown(tag),
        _value(each),
        tag.unit,
        f"{each.confidence:.2f}",
        ", ".join(each.reasons),
    )


def _value(each: DescribedTag) -> str:
    """The value of the last read, after that of the first read if it changed."""
    first, last = (_shown(each, each.values[at]) for at in (0, -1))
    return last if first == last else f"{first} … {last}"


def _shown(each: DescribedTag, raw: object) -> str:
    tag = each.tag
    if tag.of_type.count is not None and not isinstance(raw, list):
        return terminal_text.shown(raw, tag.of_type.base)
    if isinstance(raw, list):
        return _bits(raw)
    value = (each.shown or tag).value(raw)
    name = tag.state(value)
    text = terminal_text.shown(value, tag.of_type.base)
    return f"{text} ({name})" if name else text


def units_to_json(
    asked: Sequence[int], seen: Sequence[Unit], alike: Sequence[Unit]
) -> dict[str, object]:
    """Which unit ids answer, for JSON."""
    done = [each.unit for each in seen]
    silent, garbled = _without_answer(seen)
    return {
        "answering": [each.unit for each in seen if each.answers],
        "silent": silent,
        "garbled": garbled,
        "not_asked": [unit for unit in asked if unit not in done],
        **ignored_to_json(seen, alike),
    }


def sunspec_to_json(found: SunSpec) -> dict[str, object]:
    """The SunSpec models of a unit id for JSON."""
    return {
        "base": found.base,
        "complete": found.is_complete,
        "flaw": found.flaw,
        "models": [
            {
                "id": each.id,
                "name": each.name,
                "address": each.address,
                "length": each.length,
                "without_value": each.without_value,
            }
            for each in found.models
        ],
    }


def unit_to_json(found: Description) -> dict[str, object]:
    """The description of a unit id for JSON."""
    left = [
        {"area": area, "address": span.start, "count": len(span)}
        for area, span in undescribed(found)
    ]
    return {
        "unit": found.unit,
        "complete": found.survey.is_done and not left,
        "identification": dict(found.identity.objects),
        "sunspec": None if found.sunspec is None else sunspec_to_json(found.sunspec),
        "orders": {order: round(share, 4) for order, share in found.orders.items()},
        "areas": {
            each.area: {
                "state": each.state,
                "exist": each.addresses,
                "absent": sum(map(len, each.absent)),
                "not_asked": len(found.survey.span) - each.asked,
                "not_searched_from": found.survey.not_searched_from(each),
                **coverage.failures_to_json(found.survey, each),
            }
            for each in found.survey.areas
        },
        "not_described": left,
        "tags": [_tag(each) for each in found.tags],
    }


def _tag(each: DescribedTag) -> dict[str, object]:
    tag = each.tag
    return {
        "name": tag.name,
        "area": tag.area,
        "address": tag.address,
        "type": tag.type,
        "order": tag.order,
        "scale": scale_as_data(tag.scale) if isinstance(tag.scale, RegisterScale) else tag.scale,
        "unit": tag.unit,
        "confidence": round(each.confidence, 4),
        "values": [jsonable(value) for value in each.values],
        "reasons": list(each.reasons),
    }
