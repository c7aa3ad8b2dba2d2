"""Plans the requests that read a device, and explains why each request ends.

The native poller uses the same plan. Nothing is sent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias, TypedDict

from holdfast._core import UNMEASURED_COST_MS, plan_blocks
from holdfast.protocol import READ_BITS, READ_REGISTERS
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.config.models.devices import DeviceConfig, RangeConfig
    from holdfast.types import Area

Field: TypeAlias = "tuple[Area, int, int]"
"""An area, an address and a count."""

Preset: TypeAlias = Literal["none", "max_insert"]

BITS = 16
"""Bits that count as one register."""


class Rules(TypedDict, total=False):
    """The rules of a plan; a range is an area, its first address and the end, exclusive."""

    max_gap: int | None
    cost: tuple[float, float] | None
    max_registers: int
    max_bits: int
    readable: Sequence[tuple[Area, int, int]]
    forbidden: Sequence[tuple[Area, int, int]]


@dataclass(frozen=True)
class Block:
    """One request."""

    area: Area
    address: int
    count: int
    reads: tuple[int, ...]
    """The numbers, from 0, of the reads that it covers completely or in part."""
    holes: tuple[tuple[int, int], ...]
    """Gaps that are also read: addresses and counts."""
    cost: float | None
    """Milliseconds; `None` if the rules have no cost."""
    ends: str
    """Why the request ends."""


@dataclass(frozen=True)
class Plan:
    """The requests of one poll."""

    reads: tuple[Field, ...]
    blocks: tuple[Block, ...]

    @property
    def cost(self) -> float | None:
        """Milliseconds of all requests, `None` if the rules have no cost."""
        known = [block.cost for block in self.blocks if block.cost is not None]
        return sum(known) if len(known) == len(self.blocks) else None

    @property
    def unwanted(self) -> int:
        """Bits and registers in gaps that are also read."""
        return sum(count for block in self.blocks for _, count in block.holes)


def rules(settings: DeviceConfig) -> Rules:
    """The rules of a configured device."""
    measured = settings.max_gap == "auto"
    return {
        "max_gap": None if settings.max_gap == "auto" else settings.max_gap,
        "cost": UNMEASURED_COST_MS if measured else None,
        "max_registers": settings.max_registers,
        "max_bits": settings.max_bits,
        "readable": _stretches(settings.readable),
        "forbidden": _stretches(settings.forbidden),
    }


def plan(reads: Sequence[Field], rules: Rules) -> Plan:
    """Plans reads. Raises `ValueError` for a read that the rules do not allow."""
    for area, address, count in reads:
        for start, stop in _of_area(rules.get("forbidden", ()), area):
            if address < stop and start < address + count:
                raise ValueError(
                    f"{area} {_span(address, address + count)} overlaps the forbidden range "
                    f"{_span(start, stop)}"
                )
    parts = [(part, number) for number, read in enumerate(reads) for part in _parts(read, rules)]
    fields = [part for part, _ in parts]
    planned = plan_blocks(fields, **rules)
    blocks = []
    for index, (area, address, count, inside, _) in enumerate(planned):
        following = planned[index + 1] if index + 1 < len(planned) else None
        behind = None if following is None else _first(fields, following)
        blocks.append(
            Block(
                area,
                address,
                count,
                tuple(dict.fromkeys(parts[each][1] for each in inside)),
                tuple(_holes([fields[each] for each in inside])),
                _cost(area, count, rules),
                _ends((area, address, count), behind, rules),
            )
        )
    return Plan(tuple(reads), tuple(blocks))


def preset(reads: Sequence[Field], rules: Rules, name: Preset, fill: int) -> int:
    """The number of requests by another rule, with the same limits.

    `none` joins only adjacent reads. `max_insert` also reads gaps of up to `fill`. Both ignore
    forbidden and readable ranges.
    """
    requests = 0
    for area in AREAS:
        parts = [part for read in reads if read[0] == area for part in _parts(read, rules)]
        most, start, end = _most(area, rules), 0, -1
        for _, address, count in sorted(parts, key=lambda part: (part[1], -part[2])):
            near = address == end if name == "none" else address - end <= fill
            if end < 0 or not near or max(end, address + count) - start > most:
                requests, start, end = requests + 1, address, address
            end = max(end, address + count)
    return requests


def _stretches(ranges: Sequence[RangeConfig]) -> list[tuple[Area, int, int]]:
    return [(each.area, each.addresses.start, each.addresses.stop) for each in ranges]


def _most(area: Area, rules: Rules) -> int:
    if area in BIT_AREAS:
        return rules.get("max_bits", READ_BITS)
    return rules.get("max_registers", READ_REGISTERS)


def _parts(read: Field, rules: Rules) -> Iterator[Field]:
    """Splits a read into parts that fit into one request."""
    area, address, count = read
    most = _most(area, rules)
    for at in range(0, count, most):
        yield area, address + at, min(most, count - at)


def _first(fields: Sequence[Field], block: tuple[Area, int, int, list[int], int]) -> Field:
    """The first field of a block."""
    return min((fields[each] for each in block[3]), key=lambda field: field[1:])


def _holes(fields: Sequence[Field]) -> Iterator[tuple[int, int]]:
    end = None
    for _, address, count in sorted(fields, key=lambda field: field[1]):
        if end is not None and address > end:
            yield end, address - end
        end = max(end or 0, address + count)


def _cost(area: Area, count: int, rules: Rules) -> float | None:
    cost = rules.get("cost")
    if cost is None:
        return None
    request, register = cost
    return request + register * (count / BITS if area in BIT_AREAS else count)


def _ends(block: Field, behind: Field | None, rules: Rules) -> str:
    """Why a block does not include the next field."""
    area, address, count = block
    if behind is None:
        return "nothing more to read"
    if behind[0] != area:
        return "another area"
    end = address + count
    hole = behind[1] - end
    if hole > 0:
        for start, stop in _of_area(rules.get("forbidden", ()), area):
            if start < behind[1] and end < stop:
                return f"forbidden: {_span(max(start, end), min(stop, behind[1]))}"
    joined = behind[1] + behind[2] - address
    cost, most = rules.get("cost"), _most(area, rules)
    max_gap = (rules.get("max_gap") or 0) if cost is None else None
    if hole > 0 and max_gap is not None and hole > max_gap:
        return f"gap: {hole}, max_gap is {max_gap}"
    readable = list(_of_area(rules.get("readable", ()), area))
    if (
        hole > 0
        and readable
        and not any(start <= end and behind[1] <= stop for start, stop in readable)
    ):
        return f"not readable: {_span(end, behind[1])}"
    if joined > most:
        return f"limit: {joined} with the next read, allowed: {most}"
    return f"gap: {hole}, which costs more than a request"


def _of_area(stretches: Sequence[tuple[Area, int, int]], area: Area) -> Iterator[tuple[int, int]]:
    return ((start, stop) for of, start, stop in stretches if of == area)


def _span(start: int, stop: int) -> str:
    return str(start) if stop - start == 1 else f"{start} to {stop - 1}"
