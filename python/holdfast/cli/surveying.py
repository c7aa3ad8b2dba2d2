"""Options of commands that search for addresses: where, how, and with how many requests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypedDict, TypeVar

import click

from holdfast.cli import device, places
from holdfast.protocol import LAST_ADDRESS
from holdfast.tools import discovery
from holdfast.tools.discovery import Survey
from holdfast.types import AREAS, Area

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.tools.discovery import LimitReached

Command = TypeVar("Command", bound="Callable[..., Any]")

MAX_REQUESTS = 20_000
"""The default of `--max-requests`, without `--exact`."""


class Settings(TypedDict):
    """The values of the options."""

    areas: tuple[Area, ...] | None
    exact: bool
    max_quantity: int | None
    step: int
    span: range
    max_requests: int | None
    delay: float


def _areas(text: str) -> tuple[Area, ...]:
    return places.areas_of(text)


def _span(text: str) -> range:
    first, dash, last = text.partition("-")
    numbers = places.number(first), places.number(last if dash else first)
    if None in numbers or not 0 <= (numbers[0] or 0) <= (numbers[1] or 0) <= LAST_ADDRESS:
        raise click.BadParameter(f"{text!r} is not FIRST-LAST, as in 0-999, up to {LAST_ADDRESS}.")
    return range(numbers[0] or 0, (numbers[1] or 0) + 1)


OPTIONS = (
    click.option(
        "--areas", type=_areas, metavar="AREA,...", help="Areas to search.  [default: all four]"
    ),
    click.option("--exact", is_flag=True, help="Read every address instead of samples."),
    click.option(
        "--max-quantity",
        type=click.IntRange(1),
        metavar="N",
        help="Read at most N bits or registers per request.",
    ),
    click.option(
        "--step",
        type=click.IntRange(1),
        default=discovery.STEP,
        show_default=True,
        metavar="N",
        help="Distance between samples.",
    ),
    click.option(
        "--range",
        "span",
        type=_span,
        default=f"0-{LAST_ADDRESS}",
        show_default=True,
        metavar="FIRST-LAST",
        help="Addresses to search.",
    ),
    click.option(
        "--max-requests",
        type=click.IntRange(1),
        metavar="N",
        help=f"Send at most N requests.  [default: {MAX_REQUESTS}, no limit with --exact]",
    ),
    click.option(
        "--delay",
        type=device.pause,
        default="0",
        show_default=True,
        metavar="SECONDS",
        help="Wait between two requests.",
    ),
)


def survey_options(command: Command) -> Command:
    """Adds the options."""
    for option in reversed(OPTIONS):
        command = option(command)
    return command


def planned(settings: Settings) -> Survey:
    """The survey of the options."""
    limit = settings["max_requests"] or (None if settings["exact"] else MAX_REQUESTS)
    return Survey(
        settings["areas"] or AREAS,
        exact=settings["exact"],
        max_quantity=settings["max_quantity"],
        step=settings["step"],
        span=settings["span"],
        max_requests=limit,
    )


def announced(survey: Survey) -> str:
    """How many requests the search takes, before it starts."""
    limit = "" if survey.max_requests is None else f", at most {survey.max_requests}"
    return f"At least {survey.absent_costs} requests if nothing exists{limit}. Ctrl-C stops."


def limited(error: LimitReached) -> str:
    """Why a search ended, with the option that ended it."""
    return f"{error}; --max-requests sets the limit"
