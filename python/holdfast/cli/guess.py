"""`holdfast guess`: guesses the type and byte order of registers."""

from __future__ import annotations

import json
import math
import time
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, pace, places, showing
from holdfast.errors import ModbusError, ModbusException
from holdfast.protocol import ILLEGAL_ADDRESS, LAST_ADDRESS, READ_REGISTERS
from holdfast.tools import inference
from holdfast.types import BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.places import Place
    from holdfast.client import SyncClient
    from holdfast.tools.inference import Guess

REGISTERS = 4
"""Registers to read by default: enough for the largest number."""

SHOWN = 10
WIDEST = 12


@click.command(epilog="Example: holdfast guess tcp://192.168.0.10 hr 100 --like 21.5")
@device.url_argument
@click.argument(
    "words", nargs=-1, required=True, metavar="AREA ADDRESS", shell_complete=places.complete
)
@click.option(
    "--count",
    type=click.IntRange(1, READ_REGISTERS),
    metavar="N",
    help=f"Registers to read.  [default: {REGISTERS}, fewer if they do not exist]",
)
@click.option("--anywhere", is_flag=True, help="Also try values that start at any later register.")
@click.option("--like", type=float, metavar="NUMBER", help="Expected value.")
@click.option(
    "--reads",
    type=click.IntRange(1, 1000),
    default=5,
    show_default=True,
    metavar="N",
    help="Number of reads, to observe changes.",
)
@click.option(
    "--every",
    type=device.seconds,
    default="0.5",
    show_default=True,
    metavar="SECONDS",
    help="Interval between reads.",
)
@click.option(
    "--all", "everything", is_flag=True, help=f"Show all guesses, not only the best {SHOWN}."
)
@click.option("--modicon", is_flag=True, help="ADDRESS is a Modicon number, as 40001 or 4x0001.")
@device.device_options
@device.json_option
def guess(
    url: str,
    words: tuple[str, ...],
    count: int | None,
    anywhere: bool,
    like: float | None,
    reads: int,
    every: float,
    everything: bool,
    modicon: bool,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Guess the type and the byte order of the value at ADDRESS in AREA of the device at URL.

    AREA is holding_registers or input_registers (hr, ir). Reads the registers several times and
    ranks every type in every order. The score is the probability, from how common a type is, how
    plausible its values are, and how they change. Compare the values with what you expect.

    With --like 21.5, ranks guesses by their distance to that value and omits those that are more
    than 10 % off. Integers are also scaled by 0.1, 0.01, 0.001 and 10.

    Exit codes: 0 done, 1 can't read the registers, 2 wrong usage.
    """
    place, left = places.taken(words, modicon=modicon)
    if left:
        raise click.UsageError(f"Got unexpected extra argument ({' '.join(left)}).")
    if place.area in BIT_AREAS:
        raise click.UsageError(f"{place.area} contain bits; guess requires registers.")
    if like is not None and not math.isfinite(like):
        raise click.UsageError("--like requires a finite number.")
    told: dict[str, object] = {
        "url": url,
        "unit": unit,
        "area": place.area,
        "address": place.address,
    }
    found: list[list[int]] = []
    with device.connect(url, unit, timeout) as client:
        try:
            size = count or _size(client, place)
            for _ in pace.ticks(every, reads):
                found.append(device.read_raw(client, place.area, place.address, size))
        except ModbusError as error:
            device.fail(error, url, told if as_json else None)
        except ValueError as error:
            raise click.UsageError(f"{error}.") from error
    guesses = inference.guess(found, like=like, anywhere=anywhere, now=time.time())
    if as_json:
        answer = {"ok": True, **told, "reads": found, "guesses": [_told(each) for each in guesses]}
        click.echo(json.dumps(answer))
    else:
        shown = guesses if everything else guesses[:SHOWN]
        click.echo("\n".join(_lines(place, found, shown)))


def _size(client: SyncClient, place: Place) -> int:
    """How many registers exist at a place, up to `REGISTERS`."""
    size = min(REGISTERS, LAST_ADDRESS + 1 - place.address)
    while True:
        try:
            device.read_raw(client, place.area, place.address, size)
        except ModbusException as error:
            if error.code != ILLEGAL_ADDRESS or size == 1:
                raise
            size -= 1
        else:
            return size


def _lines(place: Place, found: Sequence[Sequence[int]], guesses: Sequence[Guess]) -> list[str]:
    last = " ".join(f"{register:04X}" for register in found[-1][:WIDEST])
    last += " …" if len(found[-1]) > WIDEST else ""
    same = sum(read == found[0] for read in found) == len(found)
    times = showing.counted(len(found), "read")
    lines = [
        f"{place.area} {place.address} to {place.address + len(found[-1]) - 1}: {last}, "
        f"{'the same in ' if same and len(found) > 1 else ''}{times}",
        "",
    ]
    if not any(map(any, found)):
        return [*lines, "All registers are 0: every type decodes to 0."]
    if not guesses:
        return [*lines, "No type matches that value."]
    scaled = any(each.scale != 1 for each in guesses)
    head = ["score", "address", "type", "order", *(["times"] if scaled else []), "value", "why"]
    rows = [
        [
            f"{each.score:.2f}",
            str(place.address + each.offset),
            each.type if each.also is None else f"{each.type} or {each.also}",
            each.order,
            *([f"{each.scale:g}"] if scaled else []),
            _values(each),
            ", ".join(each.reasons),
        ]
        for each in guesses
    ]
    return lines + showing.table(head, rows, ">>")


def _values(guess: Guess) -> str:
    """The value of the last read, after the value of the first read if it changed."""
    first, last = (_scaled(guess, value) for value in (guess.values[0], guess.values[-1]))
    return last if len(set(guess.values)) == 1 else f"{first} … {last}"


def _scaled(guess: Guess, value: object) -> str:
    if guess.scale == 1 or not isinstance(value, int):
        return showing.shown(value, guess.type)
    return f"{value * guess.scale:.10g}"


def _told(guess: Guess) -> dict[str, object]:
    return {
        "type": guess.type,
        "order": guess.order,
        "offset": guess.offset,
        "scale": guess.scale,
        "also": guess.also,
        "score": round(guess.score, 4),
        "reasons": guess.reasons,
        "values": [showing.jsonable(value) for value in guess.values],
    }
