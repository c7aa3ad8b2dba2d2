"""`holdfast check plan`: prints the requests that read a device."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from holdfast.cli import terminal_text
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.old_spellings import hint
from holdfast.cli.options import item
from holdfast.cli.options.duration import Duration
from holdfast.cli.options.item import range_of, words_argument
from holdfast.cli.options.option import (
    choice,
    json_option,
    number_option,
    option,
    require_known,
    whole_number,
)
from holdfast.cli.options.url import checked_url, is_url
from holdfast.cli.options.value_type import typed
from holdfast.cli.terminal_text import print_json
from holdfast.config import read_plans
from holdfast.config.read_plans import Preset
from holdfast.polling.readings import Reader
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, READ_BITS, READ_REGISTERS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.config.models.devices import DeviceConfig
    from holdfast.config.read_plans import Block, Field, Plan, Rules
    from holdfast.types import Area

FILL = 50
"""The default of `--fill`."""

MAX_NAMED = 6
"""The most reads and tags that the text names for one request. JSON names all."""


def _cost(text: str) -> tuple[float, float]:
    words = text.split(":")
    if len(words) != 2:
        raise click.BadParameter(f"{text!r} is not REQUEST:REGISTER, as in 12ms:0.1ms.")
    if all(re.fullmatch(r"[0-9]*\.?[0-9]+", word) for word in words):
        # Earlier versions had numbers only, in milliseconds. Everywhere else, these are seconds.
        hint(f"--cost {text}", f"--cost {words[0]}ms:{words[1]}ms")
        words = [f"{word}ms" for word in words]
    request, register = (Duration(zero=True).convert(word, None, None) * 1e3 for word in words)
    return request, register


@click.command(epilog="Example: holdfast check plan plant.yaml --preset max_insert --fill 10")
@click.argument("target", metavar="FILE|URL")
@words_argument("[ITEM [COUNT]]...")
@option("--device names", "NAME", "With FILE: only this device; repeatable.", multiple=True)
@number_option("--max-gap", "Read gaps of up to N.", 0, LAST_ADDRESS)
@option("--cost", "REQUEST:REGISTER", "Read gaps if that takes less, as in 12ms:0.1ms.", _cost)
@number_option("--max-registers", "Limit of one request.", 1, READ_REGISTERS)
@number_option("--max-bits", "Limit of one request.", 1, READ_BITS)
@option(
    "--readable",
    "AREA:FIRST-LAST",
    "Read gaps only inside these ranges.",
    range_of,
    multiple=True,
)
@option("--forbidden", "AREA:FIRST-LAST", "Never read these ranges.", range_of, multiple=True)
@choice("--preset", "Also count the requests of this rule.", get_args(Preset))
@number_option("--fill", f"Largest gap that max_insert reads.  [default: {FILL}]", 0)
@json_option
def plan(
    target: str,
    words: tuple[str, ...],
    names: tuple[str, ...],
    preset: Preset | None,
    fill: int | None,
    as_json: bool,
    **rules: Any,
) -> None:
    """Print the requests of one poll, and why each request ends; nothing is sent.

    With a configuration FILE, prints the requests of its devices; options override the file. With
    the URL of a device, prints the requests for ITEMs: hr:100 20, hr:100-119, hr:0:float32, 40001.

    Exit codes: 0 done, 2 wrong usage or an invalid configuration.
    """
    if rules["max_gap"] is not None and rules["cost"] is not None:
        raise click.UsageError("--max-gap and --cost can't be used together.")
    if fill is not None and preset != "max_insert":
        raise click.UsageError("--fill requires --preset max_insert.")
    reads = _reads(words)
    given = {key: value for key, value in rules.items() if value not in (None, ())}
    try:
        if is_url(target):
            shown = [_of_url(target, names, reads, given)]
        else:
            shown = list(_of_file(Path(target), names, reads, given))
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    compared = [_compared(preset, fill, each) for each in shown]
    if as_json:
        plans = [_to_json(*both) for both in zip(shown, compared, strict=True)]
        print_json({"ok": True, "target": target, "plans": plans}, indent=2)
        return
    for number, (each, other) in enumerate(zip(shown, compared, strict=True)):
        if number:
            click.echo()
        click.echo("\n".join(_lines(each, other)))


def _reads(words: Sequence[str]) -> list[Field]:
    """Area, address and count of items."""
    reads: list[Field] = []
    left = list(words)
    while left:
        each, rest = item.take(left)
        size = each.count or 1
        if each.type is not None:
            of = typed(each.type, each.order, None, each.place.area, 1)
            size = of.registers if of else 0
        elif each.count is None and rest and whole_number(rest[0]) is not None:
            item.are_several(left)
            size = whole_number(rest.pop(0)) or 0
        if not 1 <= size <= ADDRESSES - each.place.address:
            raise click.UsageError(
                f"{each.text!r}: {size} addresses; the last address is {LAST_ADDRESS}."
            )
        reads.append((each.place.area, each.place.address, size))
        left = rest
    return reads


@dataclass(frozen=True)
class _Shown:
    """A plan and its device."""

    plan: Plan
    rules: Rules
    url: str
    tags: Sequence[Sequence[str]]
    """For each read the names of its tags."""
    name: str | None = None
    of: DeviceConfig | None = None

    @property
    def title(self) -> str:
        if self.of is None:
            return self.url
        interval = self.of.interval if self.of.enabled else None
        how = "not polled" if interval is None else f"every {interval:g} s"
        return f"{self.name}: {self.url} unit {self.of.unit}, {how}"


def _of_url(
    url: str, names: Sequence[str], reads: Sequence[Field], given: dict[str, Any]
) -> _Shown:
    url = checked_url(url)
    if names:
        raise click.UsageError("--device requires FILE.")
    if not reads:
        raise click.UsageError("URL requires at least one ITEM, as in hr:100 20.")
    rules: Rules = {**given}  # type: ignore[typeddict-item]
    return _Shown(read_plans.plan(reads, rules), rules, url, [()] * len(reads))


def _of_file(
    file: Path, names: Sequence[str], reads: Sequence[Field], given: dict[str, Any]
) -> Iterator[_Shown]:
    if reads:
        raise click.UsageError("ITEM requires URL: FILE has its own reads.")
    config = load_or_exit(file)
    devices = {name: device for name, device in config.devices.items() if device.has_readings}
    if not devices:
        what = "no devices with reads or tags" if config.devices else "no devices"
        raise click.UsageError(f"{file} has {what}.")
    for name in names or devices:
        require_known(name, devices, f"{file} has no device", "devices")
        settings = devices[name]
        rules = read_plans.rules(settings)
        if given.keys() & {"max_gap", "cost"}:
            rules["max_gap"] = rules["cost"] = None
        rules |= given  # type: ignore[typeddict-item]
        asked = [(read.area, read.address, read.count) for read in settings.reads]
        limits = rules["max_registers"], rules["max_bits"]
        fields = Reader(name, config.tags(name), *limits).fields
        planned = read_plans.plan([*asked, *fields], rules)
        tags = [*[()] * len(asked), *fields.values()]
        yield _Shown(planned, rules, settings.url, tags, name, settings)


def _compared(preset: Preset | None, fill: int | None, shown: _Shown) -> dict[str, Any] | None:
    """The number of requests by another rule."""
    if preset is None:
        return None
    holes = {"fill": FILL if fill is None else fill} if preset == "max_insert" else {}
    requests = read_plans.preset(shown.plan.reads, shown.rules, preset, holes.get("fill", 0))
    return {"preset": preset, **holes, "requests": requests}


def _to_json(shown: _Shown, compared: dict[str, Any] | None) -> dict[str, Any]:
    """A plan for JSON."""
    plan = shown.plan
    whose: dict[str, Any] = {"target": shown.url}
    if shown.of is not None:
        of = shown.of
        more = {"unit": of.unit, "enabled": of.enabled, "interval": of.interval}
        whose = {"device": shown.name, **whose, **more}
    return {
        **whose,
        "requests": len(plan.blocks),
        "unwanted": plan.unwanted,
        "cost_ms": plan.cost,
        "reads": [
            {**_place(*field), **({"tags": list(tags)} if tags else {})}
            for field, tags in zip(plan.reads, shown.tags, strict=True)
        ],
        "blocks": [
            {
                **_place(block.area, block.address, block.count),
                "reads": list(block.reads),
                "holes": [{"address": at, "count": count} for at, count in block.holes],
                "cost_ms": block.cost,
                "ends": block.ends,
            }
            for block in plan.blocks
        ],
        "compared": compared,
    }


def _place(area: Area, address: int, count: int) -> dict[str, Any]:
    return {"area": area, "address": address, "count": count}


def _lines(shown: _Shown, compared: dict[str, Any] | None) -> list[str]:
    """A plan as text."""
    plan = shown.plan
    head = ["area", "address", "count", "reads", "gaps"]
    has_cost = plan.cost is not None
    rows = [
        [*_cells(block, shown), *([f"{block.cost:g}"] if has_cost else []), block.ends]
        for block in plan.blocks
    ]
    lines = [
        terminal_text.styled(shown.title, bold=True),
        "",
        *terminal_text.table(
            [*head, *(["ms"] if has_cost else []), "why it ends"],
            rows,
            "<>><<>" if has_cost else "<>>",
        ),
        "",
        _summary(plan),
    ]
    if compared is not None:
        fill = f" with fill {compared['fill']}" if "fill" in compared else ""
        lines.append(
            f"{compared['preset']}{fill}: {terminal_text.counted(compared['requests'], 'request')}"
        )
    return lines


def _cells(block: Block, shown: _Shown) -> list[str]:
    named = [name for number in block.reads for name in shown.tags[number] or (str(number),)]
    more = len(named) - MAX_NAMED
    holes = [_span(at, count) for at, count in block.holes]
    return [
        block.area,
        str(block.address),
        str(block.count),
        ", ".join(named[:MAX_NAMED]) + (f", {more} more" if more > 0 else ""),
        ", ".join(holes),
    ]


def _span(at: int, count: int) -> str:
    return str(at) if count == 1 else f"{at}-{at + count - 1}"


def _summary(plan: Plan) -> str:
    parts = [terminal_text.counted(len(plan.blocks), "request")]
    if plan.unwanted:
        parts.append(f"{terminal_text.counted(plan.unwanted, 'extra address')} read")
    if plan.cost is not None:
        parts.append(f"{plan.cost:g} ms")
    return ", ".join(parts)
