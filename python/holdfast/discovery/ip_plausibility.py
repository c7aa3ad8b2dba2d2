"""How plausible 32 bits are as an IPv4 address or netmask of a plant, in bits (`plausibility`)."""

from __future__ import annotations

RARE = 6.0
"""How rare addresses are among unsigned integers of 32 bits: about one in thirty."""

NETWORKS = (
    (0xFFFF0000, 0xC0A80000, 1.5),
    (0xFF000000, 0x0A000000, 3.0),
    (0xFFF00000, 0xAC100000, 3.0),
    (0xFFFF0000, 0xA9FE0000, 4.0),
)
"""The private networks and the one of addresses that nobody gave: mask, network, rarity in bits."""

LOW = 32
LOW_PART = 6.0
ANY_PART = 9.5
"""The bits of a part of an address: those below `LOW` are as common as all others together."""

SHORTEST_MASK = 8
MASK = 6.0
"""The least ones of a netmask, and its bits: 255.255.255.0 and 255.255.0.0 are most of them."""


def description(value: int) -> float:
    """The bits that describe an unsigned integer of 32 bits as an address; infinity for others."""
    ones = value.bit_count()
    if ones >= SHORTEST_MASK and value == (0xFFFFFFFF << (32 - ones)) & 0xFFFFFFFF:
        return RARE + MASK + (0 if ones % 8 == 0 else 4)
    for mask, network, rare in NETWORKS:
        if value & mask == network:
            free = (32 - mask.bit_count()) // 8
            parts = [value >> 8 * at & 0xFF for at in range(1, free)]
            near = sum(LOW_PART if part < LOW else ANY_PART for part in parts)
            return RARE + rare + near + 8 + (4 if mask == 0xFFF00000 else 0)
    return float("inf")
