"""How far apart tags may be to be read with one request."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast._core import plan_blocks
from holdfast.tags.read_gap import DEFAULT_MAX_GAP

if TYPE_CHECKING:
    from holdfast.config.read_plans import Field


def test_tags_up_to_ten_registers_apart_are_read_together() -> None:
    for gap, requests in ((10, 1), (11, 2)):
        fields: list[Field] = [("holding_registers", 0, 1), ("holding_registers", 1 + gap, 1)]
        assert len(plan_blocks(fields, max_gap=DEFAULT_MAX_GAP)) == requests, gap
