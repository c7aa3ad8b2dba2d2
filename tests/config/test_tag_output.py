"""A tag list that is written is read as the same tag list."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from holdfast.config.tag_files.read import load_tags
from holdfast.config.tag_files.write import tags_as_csv, tags_as_yaml
from holdfast.tags import Tag, TagList
from holdfast.tags.scale import Form, RegisterScale

if TYPE_CHECKING:
    from pathlib import Path


def place(form: Form, address: int, kind: str, order: str = "ABCD") -> RegisterScale:
    return RegisterScale(form, source=Tag("", "holding_registers", address, kind, order))


RATIO = place("factor", 64, "float32", "CDAB")
TAGS = [
    Tag("on", "coils", 3),
    Tag("voltage", "input_registers", 0, "float32", "CDAB", unit="V", description="a: b, c"),
    Tag("energy", "input_registers", 2, "uint32", "CDAB", scale=0.1, null=frozenset({0xFFFFFFFF})),
    Tag("stock", "input_registers", 4, unit="kWh", device_class="energy_storage"),
    Tag("water", "input_registers", 5, unit="m³", state_class="total_increasing"),
    Tag("name", "holding_registers", 10, "string:16"),
    Tag("mixed", "holding_registers", 40, "uint32", "ABCD", description='"quoted"'),
    Tag("raw", "holding_registers", 50, "uint16[3]", description="confidence 0.30: always 0"),
    Tag("sf", "holding_registers", 60, "int16"),
    Tag("power", "holding_registers", 61, scale=RegisterScale("exponent", "sf")),
    Tag("share", "holding_registers", 62, order="CDAB", scale=RATIO),
    Tag("setpoint", "holding_registers", 30, "int16", offset=-5, unit="°C", writable=True),
    Tag("serial", "holding_registers", 34, "uint64", "CDAB", offset=2**53 + 1, max=2**63 + 1),
]
STATE = Tag("state", "holding_registers", 31, states={0: "off", 1: "running"})


def meaning(tags: TagList) -> list[Tag]:
    """Tags without the order of single registers, in which the usual orders are the same."""
    return [usual(tag) for tag in tags]


def usual(tag: Tag) -> Tag:
    made = replace(tag, order=tag.order if tag.count > 1 else "ABCD")
    if tag.source is None:
        return made
    assert isinstance(tag.scale, RegisterScale)
    return replace(made, scale=replace(tag.scale, source=usual(tag.source)))


@pytest.mark.parametrize("suffix", ["yaml", "csv"])
def test_tags_are_read_as_they_were_written(tmp_path: Path, suffix: str) -> None:
    write = {"yaml": tags_as_yaml, "csv": tags_as_csv}[suffix]
    file = tmp_path / f"device.{suffix}"
    file.write_text(write(TAGS), encoding="utf-8")
    assert meaning(load_tags(file)) == meaning(TagList(TAGS))


def test_yaml_has_a_tag_a_line_and_states() -> None:
    lines = tags_as_yaml([*TAGS, STATE]).splitlines()
    assert lines[:3] == ["order: CDAB", "tags:", "  on: {area: coils, address: 3}"]
    assert len(lines) == 2 + len(TAGS) + 1
    assert lines[-1].endswith("states: {0: off, 1: running}}")


def test_csv_has_the_states_in_the_description() -> None:
    assert "states: 0 off, 1 running" in tags_as_csv([STATE])


def test_swapped_bytes_of_a_single_register_are_kept(tmp_path: Path) -> None:
    tags = [Tag("wide", "holding_registers", 0, "uint32", "BADC"), Tag("n", "holding_registers", 2)]
    file = tmp_path / "device.yaml"
    file.write_text(tags_as_yaml(tags))
    assert [tag.order for tag in load_tags(file)] == ["BADC", "ABCD"]
