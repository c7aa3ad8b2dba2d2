"""Options of commands that search for addresses: where, how, and with how many requests."""

from __future__ import annotations

from dataclasses import dataclass

import click

from holdfast.cli.options import item
from holdfast.cli.options.duration import delay_option
from holdfast.cli.options.item import areas_of
from holdfast.cli.options.option import flag, number_option, option, option_group
from holdfast.discovery.address_search import Survey
from holdfast.protocol import LAST_ADDRESS
from holdfast.types import AREAS, Area

MAX_REQUESTS = 20_000
"""The default of `--max-requests`, without `--exact`."""


@dataclass(frozen=True)
class Settings:
    """The values of the options."""

    areas: tuple[Area, ...] | None
    exact: bool
    sparse: bool
    max_quantity: int | None
    span: range
    max_requests: int | None
    delay: float


def _span(text: str) -> range:
    found = item.span(text)
    if found is None:
        raise click.BadParameter(f"{text!r} is not FIRST-LAST, as in 0-999, up to {LAST_ADDRESS}.")
    return found


_LIMIT = f"Send at most N requests.  [default: {MAX_REQUESTS}, no limit with --exact]"
survey_options = option_group(
    option("--areas", "AREA,...", "Areas to search.  [default: all four]", areas_of),
    flag("--exact", "Read every address instead of samples."),
    flag("--sparse", "Read a quarter of the samples."),
    number_option("--max-quantity", "Read at most N bits or registers per request."),
    option("--range span", "FIRST-LAST", "Addresses to search.", _span, f"0-{LAST_ADDRESS}"),
    number_option("--max-requests", _LIMIT),
    delay_option,
    into=("settings", Settings),
)


def planned(settings: Settings) -> Survey:
    """The survey of the options. Raises `click.UsageError`."""
    if settings.exact and settings.sparse:
        raise click.UsageError("--exact and --sparse: give one of them.")
    limit = settings.max_requests or (None if settings.exact else MAX_REQUESTS)
    return Survey(
        settings.areas or AREAS,
        exact=settings.exact,
        max_quantity=settings.max_quantity,
        span=settings.span,
        dense=not settings.sparse,
        max_requests=limit,
    )


def announced(survey: Survey) -> str:
    """How many requests the search takes, before it starts."""
    limit = "" if survey.max_requests is None else f", at most {survey.max_requests}"
    return f"At least {survey.absent_costs} requests if nothing exists{limit}. Ctrl-C stops."
