"""Writes a tag list as text that `load_tags` reads: YAML or CSV."""

from __future__ import annotations

import csv
import io
from collections import Counter
from typing import TYPE_CHECKING, Any

from holdfast.config.dump import on_one_line
from holdfast.config.tag_files.read import COLUMNS, MORE_COLUMNS
from holdfast.tags import Tag
from holdfast.tags.scale import RegisterScale
from holdfast.tags.tag import default_type
from holdfast.values.orders import DEFAULT_ORDER, SWAPPED_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterable


_PLAIN = (
    *("encoding", "scale", "offset", "unit", "writable", "min", "max", "deadband", "round"),
    *("device_class", "state_class"),
)
"""Keys that are written if they are not the default."""


def tags_as_yaml(tags: Iterable[Tag]) -> str:
    """Tags as the YAML of a profile, with the most common order as default."""
    tags = list(tags)
    wide = Counter(tag.order for tag in tags if tag.count > 1 and tag.of_type.base != "string")
    order = wide.most_common(1)[0][0] if wide else DEFAULT_ORDER
    lines = [f"  {tag.name}: {on_one_line(_settings(tag, order))}" for tag in tags]
    return "\n".join([f"order: {order}", "tags:", *lines, ""])


def tags_as_csv(tags: Iterable[Tag]) -> str:
    """Tags as CSV with a line of column names. Names of states go into the description."""
    rows: list[dict[str, Any]] = []
    for tag in tags:
        row = {"name": tag.name, "type": tag.type, **_settings(tag, DEFAULT_ORDER)}
        states = ", ".join(f"{value} {name}" for value, name in row.pop("states", {}).items())
        if states:
            row["description"] = "; ".join(filter(None, (tag.description, f"states: {states}")))
        row["null"] = "|".join(str(each) for each in row.get("null", ()))
        if isinstance(tag.scale, RegisterScale):
            row["scale"] = _scale_cell(tag.scale)
        if row.get("writable"):
            row["writable"] = "true"
        rows.append(row)
    more = [name for name in MORE_COLUMNS if name == "null" or any(name in row for row in rows)]
    out = io.StringIO()
    table = csv.DictWriter(out, [*COLUMNS, *more], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return out.getvalue()


def scale_as_data(scale: RegisterScale) -> dict[str, Any]:
    """The register of a scale as in a tag list."""
    if scale.name is not None:
        return {"from": scale.name, "as": scale.form}
    source = scale.source
    assert source is not None, "a scale has a name or a register"
    place = {"area": source.area, "address": source.address, "type": source.type}
    return {"from": place, "as": scale.form}


def _scale_cell(scale: RegisterScale) -> str:
    """The register of a scale as a cell of CSV, such as `exponent W_SF`."""
    source = scale_as_data(scale)["from"]
    words = [source] if isinstance(source, str) else map(str, source.values())
    return " ".join([scale.form, *words])


def _settings(tag: Tag, order: str) -> dict[str, Any]:
    """The keys of a tag that differ from their defaults."""
    data: dict[str, Any] = {"area": tag.area, "address": tag.address}
    if tag.type != default_type(tag.area):
        data["type"] = tag.type
    if _has_other_order(tag, order):
        data["order"] = tag.order
    for key in _PLAIN:
        value = getattr(tag, key)
        if value != getattr(Tag, key):
            data[key] = scale_as_data(value) if isinstance(value, RegisterScale) else value
    if tag.states:
        data["states"] = dict(tag.states)
    if tag.null:
        data["null"] = sorted(tag.null, key=str)
    if tag.description:
        data["description"] = tag.description
    return data


def _has_other_order(tag: Tag, order: str) -> bool:
    """Whether the order of a tag means something else than the default order."""
    if tag.of_type.base == "bool":
        return False
    if tag.count > 1 or (tag.source is not None and tag.source.count > 1):
        return tag.order != order
    return (tag.order in SWAPPED_BYTES) != (order in SWAPPED_BYTES)
