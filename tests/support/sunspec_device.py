"""The registers of a SunSpec inverter, built by hand from the published models."""

from __future__ import annotations

from holdfast import values

NOT_THERE = 0xFFFF


def text(content: str, size: int) -> list[int]:
    return list(values.encode(content, f"string:{size}"))


def common() -> list[int]:
    """Model 1, with 66 registers."""
    texts = (("Acme", 32), ("SUN-5000", 32), ("", 16), ("1.2.0", 16), ("SN104923", 32))
    content = [each for name, size in texts for each in text(name, size)]
    return [1, 66, *content, 1, 0x8000]


def inverter() -> list[int]:
    """Model 103, with 50 registers; what is not set is not implemented."""
    content = [0x8000] * 50
    content[0:5] = [215, 72, 71, 72, -1 & 0xFFFF]
    content[5:8] = [NOT_THERE] * 3
    content[8:12] = [2301, 2314, 2298, -1 & 0xFFFF]
    content[12:14] = [-4950 & 0xFFFF, 0]
    content[14:16] = [4998, -2 & 0xFFFF]
    content[22:25] = [0x0012, 0xD687, 1]
    content[36] = 4
    return [103, 50, *content]


def mppt() -> list[int]:
    """Model 160, with two modules."""
    fixed = [-1 & 0xFFFF, -1 & 0xFFFF, 0, 0, 0, 0, 2, 0]
    module = [text("East", 16), text("West", 16)]
    modules = [
        [number, *module[number - 1], 50 + number, 4000 + number, 2000, 0, 9, 0, 0, 25, 4, 0, 0]
        for number in (1, 2)
    ]
    return [160, len(fixed) + 2 * len(modules[0]), *fixed, *modules[0], *modules[1]]


def curves() -> list[int]:
    """Model 705, with two curves of two points each."""
    fixed = [1, 0, 0, 2, 2, 0, 0, 0, 0, 1, -1 & 0xFFFF, -2 & 0xFFFF, 0]
    curve = [2, 1, 1, 1000, 1000, 0, 5, 0, 10, 1, 920, 3000, 1080, -3000 & 0xFFFF]
    return [705, len(fixed) + 2 * len(curve), *fixed, *curve, *curve]


def registers(*models: list[int]) -> list[int]:
    """The registers of a device with these models."""
    return [*text("SunS", 4), *(each for model in models for each in model), 0xFFFF, 0]
