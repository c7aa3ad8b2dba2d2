"""`holdfast plan`: prints the requests that read a device."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from holdfast.cli import device, places, showing
from holdfast.cli.configuration import load_or_exit
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, READ_BITS, READ_REGISTERS
from holdfast.tools import planning
from holdfast.tools.planning import Preset

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.config import DeviceConfig
    from holdfast.tools.planning import Block, Field, Plan, Rules
    from holdfast.types import Area

FILL = 50
"""The default of `--fill`."""


def _read(text: str) -> Field:
    area, _, rest = text.partition(":")
    address, _, count = rest.partition(":")
    first, size = places.number(address), places.number(count or "1")
    if first is None or size is None or not 1 <= size <= ADDRESSES - first:
        raise click.BadParameter(
            f"{text!r} is not AREA:ADDRESS:COUNT, as in hr:100:20, up to {LAST_ADDRESS}."
        )
    return places.area_of(area), first, size


def _stretch(text: str) -> tuple[Area, int, int]:
    area, _, span = text.partition(":")
    first, dash, last = span.partition("-")
    start, end = places.number(first), places.number(last if dash else first)
    if start is None or end is None or not start <= end <= LAST_ADDRESS:
        raise click.BadParameter(
            f"{text!r} is not AREA:FIRST-LAST, as in hr:100-119, up to {LAST_ADDRESS}."
        )
    return places.area_of(area), start, end + 1


def _cost(text: str) -> tuple[float, float]:
    match = re.fullmatch(r"([0-9]*\.?[0-9]+):([0-9]*\.?[0-9]+)", text)
    milliseconds = (float(match[1]), float(match[2])) if match else (math.inf, math.inf)
    if not math.isfinite(sum(milliseconds)):
        raise click.BadParameter(f"{text!r} is not REQUEST:REGISTER in milliseconds, as in 12:0.1.")
    return milliseconds


@click.command(epilog="Example: holdfast plan plant.yaml --preset max_insert --fill 10")
@click.argument("target", metavar="FILE|URL")
@click.option(
    "--device",
    "names",
    multiple=True,
    metavar="NAME",
    help="With FILE: only this device; repeatable.",
)
@click.option(
    "--read",
    "reads",
    multiple=True,
    type=_read,
    metavar="AREA:ADDRESS:COUNT",
    help="With URL: a range to read; repeatable.",
)
@click.option(
    "--max-gap", type=click.IntRange(0, LAST_ADDRESS), metavar="N", help="Read gaps of up to N."
)
@click.option(
    "--cost",
    type=_cost,
    metavar="REQUEST:REGISTER",
    help="Read gaps if that is cheaper, with these costs in milliseconds.",
)
@click.option(
    "--max-registers",
    type=click.IntRange(1, READ_REGISTERS),
    metavar="N",
    help="Limit of one request.",
)
@click.option(
    "--max-bits", type=click.IntRange(1, READ_BITS), metavar="N", help="Limit of one request."
)
@click.option(
    "--readable",
    multiple=True,
    type=_stretch,
    metavar="AREA:FIRST-LAST",
    help="Read gaps only inside these ranges.",
)
@click.option(
    "--forbidden",
    multiple=True,
    type=_stretch,
    metavar="AREA:FIRST-LAST",
    help="Never read these ranges.",
)
@click.option(
    "--preset",
    type=click.Choice(get_args(Preset)),
    help="Also count the requests of this rule.",
)
@click.option(
    "--fill",
    type=click.IntRange(0),
    metavar="N",
    help=f"Largest gap that max_insert reads.  [default: {FILL}]",
)
@device.json_option
def plan(
    target: str,
    names: tuple[str, ...],
    reads: tuple[Field, ...],
    preset: Preset | None,
    fill: int | None,
    as_json: bool,
    **rules: Any,
) -> None:
    """Print the requests of one poll, and why each request ends; nothing is sent.

    With a configuration FILE, prints the requests of its devices; options override the file. With
    the URL of a device, prints the requests for the ranges of --read.

    Exit codes: 0 done, 2 wrong usage or an invalid configuration.
    """
    if rules["max_gap"] is not None and rules["cost"] is not None:
        raise click.UsageError("--max-gap and --cost can't be used together.")
    if fill is not None and preset != "max_insert":
        raise click.UsageError("--fill requires --preset max_insert.")
    given = {key: value for key, value in rules.items() if value not in (None, ())}
    try:
        if device.is_url(target):
            shown = [_of_url(target, names, reads, given)]
        else:
            shown = list(_of_file(Path(target), names, reads, given))
    except ValueError as error:
        raise click.UsageError(f"{error}.") from error
    compared = [_compared(preset, fill, each) for each in shown]
    if as_json:
        told = [_told(*both) for both in zip(shown, compared, strict=True)]
        click.echo(json.dumps({"plans": told}, indent=2))
        return
    for number, (each, other) in enumerate(zip(shown, compared, strict=True)):
        if number:
            click.echo()
        click.echo("\n".join(_lines(each, other)))


class _Shown:
    """A plan and its device."""

    def __init__(
        self, plan: Plan, rules: Rules, url: str, name: str | None, of: DeviceConfig | None
    ) -> None:
        self.plan = plan
        self.rules = rules
        self.url = url
        self.name = name
        self.of = of

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
    url = device.checked_url(url)
    if names:
        raise click.UsageError("--device requires FILE.")
    if not reads:
        raise click.UsageError("URL requires at least one --read.")
    rules: Rules = {**given}  # type: ignore[typeddict-item]
    return _Shown(planning.plan(reads, rules), rules, url, None, None)


def _of_file(
    file: Path, names: Sequence[str], reads: Sequence[Field], given: dict[str, Any]
) -> Iterator[_Shown]:
    if reads:
        raise click.UsageError("--read requires URL: FILE has its own reads.")
    configured = load_or_exit(file).devices
    devices = {name: device for name, device in configured.items() if device.reads}
    if not devices:
        what = "no devices with reads" if configured else "no devices"
        raise click.UsageError(f"{file} has {what}.")
    for name in names or devices:
        if name not in devices:
            known = ", ".join(devices)
            raise click.UsageError(f"{file} has no device {name!r}, allowed: {known}.")
        settings = devices[name]
        rules = planning.rules(settings)
        if given.keys() & {"max_gap", "cost"}:
            rules["max_gap"] = rules["cost"] = None
        rules |= given  # type: ignore[typeddict-item]
        asked = [(read.area, read.address, read.count) for read in settings.reads]
        yield _Shown(planning.plan(asked, rules), rules, settings.url, name, settings)


def _compared(preset: Preset | None, fill: int | None, shown: _Shown) -> dict[str, Any] | None:
    """The number of requests by another rule."""
    if preset is None:
        return None
    holes = {"fill": FILL if fill is None else fill} if preset == "max_insert" else {}
    requests = planning.preset(shown.plan.reads, shown.rules, preset, holes.get("fill", 0))
    return {"preset": preset, **holes, "requests": requests}


def _told(shown: _Shown, compared: dict[str, Any] | None) -> dict[str, Any]:
    """A plan for JSON."""
    plan = shown.plan
    whose: dict[str, Any] = {"url": shown.url}
    if shown.of is not None:
        of = shown.of
        more = {"unit": of.unit, "enabled": of.enabled, "interval": of.interval}
        whose = {"device": shown.name, **whose, **more}
    return {
        **whose,
        "requests": len(plan.blocks),
        "unwanted": plan.unwanted,
        "cost_ms": plan.cost,
        "reads": [_place(*read) for read in plan.reads],
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
        [*_cells(block), *([f"{block.cost:g}"] if has_cost else []), block.ends]
        for block in plan.blocks
    ]
    lines = [
        showing.styled(shown.title, bold=True),
        "",
        *showing.table(
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
            f"{compared['preset']}{fill}: {showing.counted(compared['requests'], 'request')}"
        )
    return lines


def _cells(block: Block) -> list[str]:
    holes = [_span(at, count) for at, count in block.holes]
    return [
        block.area,
        str(block.address),
        str(block.count),
        ", ".join(map(str, block.reads)),
        ", ".join(holes),
    ]


def _span(at: int, count: int) -> str:
    return str(at) if count == 1 else f"{at}-{at + count - 1}"


def _summary(plan: Plan) -> str:
    parts = [showing.counted(len(plan.blocks), "request")]
    if plan.unwanted:
        parts.append(f"{showing.counted(plan.unwanted, 'extra address')} read")
    if plan.cost is not None:
        parts.append(f"{plan.cost:g} ms")
    return ", ".join(parts)
