"""`holdfast describe guess`: guesses the type and byte order of registers."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import click

from holdfast.cli import device_errors, terminal_text
from holdfast.cli.live import schedule
from holdfast.cli.options import device, item
from holdfast.cli.options.duration import every_option
from holdfast.cli.options.item import words_argument
from holdfast.cli.options.option import flag, json_option, number_option, option
from holdfast.cli.options.url import url_argument
from holdfast.cli.terminal_text import print_json
from holdfast.discovery import type_guess
from holdfast.errors import ModbusError
from holdfast.types import BIT_AREAS
from holdfast.values.json import jsonable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.options.plc_addresses import Place
    from holdfast.discovery.type_guess import Guess

REGISTERS = 4
"""Registers to read by default: enough for the largest number."""

MAX_GUESSES = 10
MAX_REGISTERS_SHOWN = 12


@click.command(epilog="Example: holdfast describe guess tcp://192.168.0.10 hr 100 --like 21.5")
@url_argument
@words_argument(item.RANGE, required=True)
@flag("--anywhere", "Also try values that start at any later register.")
@option("--like", "NUMBER", "Expected value.", float)
@number_option("--times", "Number of readings, to observe changes.", 1, 1000, 5)
@every_option("0.5", "Interval between readings.")
@flag("--all everything", f"Show all guesses, not only the best {MAX_GUESSES}.")
@device.device_options
@json_option
def guess(
    url: str,
    words: tuple[str, ...],
    anywhere: bool,
    like: float | None,
    times: int,
    every: float,
    everything: bool,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Guess the type and the byte order of the value at ITEM of the device at URL.

    ITEM is in holding_registers or input_registers, as hr:100, hr 100 or 40101. Reads COUNT
    registers (default: 4, fewer if they do not exist) several times and ranks every type in every
    order. The score is the probability, from how common a type is, how
    plausible its values are, and how they change. Compare the values with what you expect.

    With --like 21.5, ranks guesses by their distance to that value and omits those that are more
    than 10 % off. Integers are also scaled by 0.1, 0.01, 0.001 and 10.

    Exit codes: 0 done, 1 can't read the registers, 2 wrong usage.
    """
    place, count = item.single(words)
    if place.area in BIT_AREAS:
        raise click.UsageError(f"{place.area} contain bits; guess requires registers.")
    if like is not None and not math.isfinite(like):
        raise click.UsageError("--like requires a finite number.")
    fields: dict[str, object] = {
        "target": url,
        "unit": unit,
        "area": place.area,
        "address": place.address,
    }
    found: list[list[int]] = []
    with device.connect(url, unit, timeout) as client:
        try:
            size = count or device.existing(client, place, REGISTERS)
            for _ in schedule.ticks(every, times):
                found.append(device.read_raw(client, place.area, place.address, size))
        except ModbusError as error:
            device_errors.fail(error, url, fields)
        except ValueError as error:
            raise click.UsageError(str(error)) from error
    guesses = type_guess.guess(found, like=like, anywhere=anywhere, now=time.time())
    if as_json:
        answer = {
            "ok": True,
            **fields,
            "count": size,
            "reads": found,
            "guesses": [_to_json(each, place.address) for each in guesses],
        }
        print_json(answer)
    else:
        shown = guesses if everything else guesses[:MAX_GUESSES]
        click.echo("\n".join(_lines(place, found, shown)))


def _lines(place: Place, found: Sequence[Sequence[int]], guesses: Sequence[Guess]) -> list[str]:
    last = " ".join(f"{register:04X}" for register in found[-1][:MAX_REGISTERS_SHOWN])
    last += " …" if len(found[-1]) > MAX_REGISTERS_SHOWN else ""
    same = sum(read == found[0] for read in found) == len(found)
    times = terminal_text.counted(len(found), "read")
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
    return lines + terminal_text.table(head, rows, ">>")


def _values(guess: Guess) -> str:
    """The value of the last read, after the value of the first read if it changed."""
    first, last = (_scaled(guess, value) for value in (guess.values[0], guess.values[-1]))
    return last if len(set(guess.values)) == 1 else f"{first} … {last}"


def _scaled(guess: Guess, value: object) -> str:
    if guess.scale == 1 or not isinstance(value, int):
        return terminal_text.shown(value, guess.type)
    return f"{value * guess.scale:.10g}"


def _to_json(guess: Guess, address: int) -> dict[str, object]:
    return {
        "type": guess.type,
        "order": guess.order,
        "address": address + guess.offset,
        "offset": guess.offset,
        "scale": guess.scale,
        "also": guess.also,
        "score": round(guess.score, 4),
        "reasons": guess.reasons,
        "values": [jsonable(value) for value in guess.values],
    }
