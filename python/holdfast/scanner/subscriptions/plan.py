"""The plan of a device: which tags one request may read together. Does no I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast._core import plan_blocks
from holdfast.protocol import READ_BITS, READ_REGISTERS
from holdfast.scanner.errors import Refused
from holdfast.scanner.subscriptions.tag import AREA_OF_CODE
from holdfast.tags.read_gap import DEFAULT_MAX_GAP

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.scanner.messages.types import PlanRequest, Range
    from holdfast.scanner.subscriptions.tag import ScannedTag
    from holdfast.types import Area


@dataclass(frozen=True, slots=True)
class Plan:
    """The rules for combining tags into requests."""

    max_gap: int = DEFAULT_MAX_GAP
    max_registers: int = READ_REGISTERS
    max_bits: int = READ_BITS
    readable: tuple[tuple[Area, int, int], ...] = ()
    """Area, start and end of ranges; the end is exclusive."""
    forbidden: tuple[tuple[Area, int, int], ...] = ()
    request: PlanRequest | None = field(default=None, compare=False)
    """What this plan was made from."""

    @staticmethod
    def of(request: PlanRequest | None) -> Plan:
        """Creates the plan of a request. Raises `Refused`."""
        if request is None:
            return DEFAULT_PLAN
        return Plan(
            DEFAULT_MAX_GAP if request.max_gap is None else request.max_gap,
            request.max_registers or READ_REGISTERS,
            request.max_bits or READ_BITS,
            tuple(_ranges("plan.readable", request.readable or ())),
            tuple(_ranges("plan.forbidden", request.forbidden or ())),
            request,
        )

    def blocks(self, tags: Sequence[ScannedTag]) -> list[tuple[Area, int, int, list[int], int]]:
        """Returns the blocks that read the tags, see `plan_blocks`. Raises `ValueError`."""
        return plan_blocks(
            [(tag.area, tag.span.start, len(tag.span)) for tag in tags],
            max_gap=self.max_gap,
            max_registers=self.max_registers,
            max_bits=self.max_bits,
            readable=self.readable,
            forbidden=self.forbidden,
        )

    def check(self, tags: Sequence[ScannedTag]) -> None:
        """Raises `Refused` for a tag that the plan does not allow to read."""
        for tag in tags:
            most = self.max_bits if tag.of_bits else self.max_registers
            if len(tag.span) > most:
                kind = "bits" if tag.of_bits else "registers"
                scaled = "" if tag.source is None else " with its scale"
                found = f"has {len(tag.span)} {kind}{scaled}, one request reads at most {most}"
                raise Refused(f"tag {tag.id!r}: {tag.type} {found}")
            for area, start, end in self.forbidden:
                if tag.area == area and start < tag.span.stop and tag.span.start < end:
                    found = f"plan.forbidden contains {start} to {end - 1} of {area}"
                    raise Refused(f"tag {tag.id!r} from address {tag.address}: {found}")


DEFAULT_PLAN = Plan()
"""One object for nearly all devices."""


def _ranges(where: str, ranges: Iterable[Range]) -> Iterable[tuple[Area, int, int]]:
    for index, given in enumerate(ranges):
        *area, start, end = given
        is_range = isinstance(start, int) and isinstance(end, int) and start <= end
        if not is_range or any(word not in AREA_OF_CODE for word in area):
            allowed = "allowed: [area,] first, last, with first not above last"
            raise Refused(f"{where}[{index}] is {given}, {allowed}")
        assert isinstance(start, int)
        assert isinstance(end, int)
        for code, name in AREA_OF_CODE.items():
            if not area or code in area:
                yield name, start, end + 1
