"""Compares the byte interpreter with the conversion of pymodbus and with plain `struct`.

All do the same work. Their order rotates, so that changes of the machine's speed affect all alike.
Ratios compare times of the same round; figures are the medians of all rounds.
"""

from __future__ import annotations

import argparse
import json
import platform
import random
import struct
import time
from array import array
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, TypeAlias

from pymodbus.client.mixin import ModbusClientMixin

from holdfast.values import Layout, decode

FLOATS = 10_000
FIELDS = 100
ORDERS = {"ABCD": (">", ">"), "DCBA": (">", "<"), "BADC": ("<", ">"), "CDAB": ("<", "<")}
"""The `struct` byte orders of registers and of floats that give each order."""
FLOAT32 = ModbusClientMixin.DATATYPE.FLOAT32

Work: TypeAlias = Callable[[], Any]
Times: TypeAlias = dict[str, list[float]]


def main() -> None:
    """Prints a table for each task, and writes all times to the file of `--json`."""
    options = arguments()
    print(f"{platform.machine()}, Python {platform.python_version()}; {options.rounds} rounds.")
    results = {}
    for title, contestants in works(random.Random(20251121)).items():
        results[title] = measure(contestants, options.rounds, options.seconds)
        show(title, results[title])
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, help="default 15")
    parser.add_argument("--seconds", type=float, default=0.05, help="per turn; default 0.05")
    parser.add_argument("--quick", action="store_true", help="2 rounds, as a smoke test")
    parser.add_argument("--json", type=Path, help="file for all times, in seconds")
    options = parser.parse_args()
    options.rounds = options.rounds or (2 if options.quick else 15)
    if options.rounds < 1 or options.seconds <= 0:
        parser.error("--rounds must be at least 1, --seconds greater than 0")
    return options


def works(chance: random.Random) -> dict[str, dict[str, Work]]:
    """Returns the contestants of each task, Holdfast first."""
    numbers = [chance.uniform(-1000, 1000) for _ in range(FLOATS)]
    made: dict[str, dict[str, Work]] = {}
    for order, (of_registers, of_floats) in ORDERS.items():
        data = struct.pack(f"{of_floats}{FLOATS}f", *numbers)
        registers = list(struct.unpack(f"{of_registers}{2 * FLOATS}H", data))
        made[f"{FLOATS:,} float32, {order}"] = arrays(registers, order)
    made["1 float32, CDAB"] = singles(registers[:2], "CDAB")
    for title, orders in {"CDAB": ["CDAB"], "four orders": list(ORDERS)}.items():
        made[f"{FIELDS} fields of float32, {title}"] = blocks(registers[: 2 * FIELDS], orders)
    return made


def arrays(registers: list[int], order: str) -> dict[str, Work]:
    kind = f"float32[{FLOATS}]"
    found = decode(registers, kind, order)
    contestants: dict[str, Work] = {
        "holdfast": partial(decode, registers, kind, order),
        "holdfast, bytes": partial(decode, wire(registers), kind, order),
        "holdfast, uint16 array": partial(decode, array("H", registers), kind, order),
        "pymodbus": partial(by_pymodbus, registers, order),
        "plain struct": partial(by_struct, registers, order),
    }
    assert all(list(work()) == found for work in contestants.values())
    return contestants


def singles(registers: list[int], order: str) -> dict[str, Work]:
    contestants: dict[str, Work] = {
        "holdfast": partial(decode, registers, "float32", order),
        "pymodbus": partial(by_pymodbus, registers, order),
        "plain struct": lambda: by_struct(registers, order)[0],
    }
    assert len({work() for work in contestants.values()}) == 1
    return contestants


def blocks(registers: list[int], orders: list[str]) -> dict[str, Work]:
    fields = [
        (f"field {index}", "float32", 2 * index, orders[index % len(orders)])
        for index in range(FIELDS)
    ]
    layout = Layout(fields)
    names = layout.names

    def one_by_one(convert: Callable[[list[int], str], float]) -> dict[str, float]:
        return {
            name: convert(registers[offset : offset + 2], order)
            for name, _, offset, order in fields
        }

    contestants: dict[str, Work] = {
        "layout": partial(layout.decode, registers),
        "layout, bytes": partial(layout.decode, wire(registers)),
        "layout, tuple": lambda: dict(zip(names, layout.decode_tuple(registers), strict=True)),
        "loop of decode": partial(one_by_one, lambda two, order: decode(two, "float32", order)),
        "loop of pymodbus": partial(one_by_one, by_pymodbus),
        "loop of plain struct": partial(one_by_one, lambda two, order: by_struct(two, order)[0]),
    }
    if len(orders) == 1:
        contestants["plain struct"] = lambda: dict(
            zip(names, by_struct(registers, orders[0]), strict=True)
        )
    assert all(work() == layout.decode(registers) for work in contestants.values())
    contestants["layout, tuple"] = partial(layout.decode_tuple, registers)
    return contestants


def wire(registers: Sequence[int]) -> bytes:
    return struct.pack(f">{len(registers)}H", *registers)


def by_struct(registers: Sequence[int], order: str) -> tuple[float, ...]:
    """The upper limit: two calls of `struct`, without checks of the registers."""
    of_registers, of_floats = ORDERS[order]
    data = struct.pack(f"{of_registers}{len(registers)}H", *registers)
    return struct.unpack(f"{of_floats}{len(registers) // 2}f", data)


def by_pymodbus(registers: list[int], order: str) -> Any:
    """Converts with pymodbus. It has two orders; for others, swaps the bytes of registers first."""
    if order in ("DCBA", "BADC"):
        registers = [register >> 8 | (register & 0xFF) << 8 for register in registers]
    return ModbusClientMixin.convert_from_registers(
        registers, FLOAT32, word_order="little" if order in ("DCBA", "CDAB") else "big"
    )


def measure(contestants: dict[str, Work], rounds: int, seconds: float) -> Times:
    """Returns the seconds of each contestant by round. The order of the contestants rotates."""
    times: Times = {name: [] for name in contestants}
    repeats = {
        name: max(1, int(seconds / max(timed(work, 1), 1e-6))) for name, work in contestants.items()
    }
    names = list(contestants)
    for index in range(rounds):
        first = index % len(names)
        for name in names[first:] + names[:first]:
            times[name].append(timed(contestants[name], repeats[name]))
    return times


def timed(work: Work, repeats: int) -> float:
    start = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - start) / repeats


def show(title: str, times: Times) -> None:
    """Prints one table: the median time, and its ratio to the first contestant's time."""
    first = next(iter(times))
    print(f"\n{title}:\n  {'':22}          us  of {first} (min to max)")
    for name, measured in times.items():
        ratios = [one / other for one, other in zip(measured, times[first], strict=True)]
        against = f"{median(ratios):7.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        print(f"  {name:22}  {median(measured) * 1e6:10,.1f}  {against if name != first else ''}")


if __name__ == "__main__":
    main()
