"""The coverage of a survey: which addresses it asked, which failed, and which it did not ask."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from holdfast.cli import terminal_text
from holdfast.discovery.address_search import NEAR

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.discovery.address_search import AreaMap, Failure, Survey

STATES = {
    "searched": "yes",
    "partly": "to {at}",
    "given_up": "skipped",
    "not_asked": "no",
}


def counts(survey: Survey) -> list[str]:
    """For each area, how many addresses exist, are absent, failed otherwise, and were not asked."""
    rows = [
        (
            found.area,
            _searched(survey, found),
            str(found.addresses),
            str(absent := sum(map(len, found.absent))),
            str(len(found.refused) - absent),
            str(len(survey.span) - found.asked),
        )
        for found in survey.areas
    ]
    head = ("area", "searched", "exist", "absent", "failed", "not asked")
    return terminal_text.table(head, rows, "<<>>>>")


def _searched(survey: Survey, found: AreaMap) -> str:
    if found.state == "partly" and found.reached == survey.span.start:
        return "starts"
    return STATES[found.state].format(at=(found.reached or 0) - 1)


def incomplete(survey: Survey) -> list[str]:
    """The places that an interrupted search did not reach; nothing after a complete search."""
    places: dict[str, list[str]] = {}
    for found in survey.areas:
        start = survey.not_searched_from(found)
        if found.state == "partly" and start is not None:
            some = "some " if start == survey.span.start else ""
            where = f" from {start} on (only {some}usual starts there)"
            places.setdefault(where, []).append(found.area)
        elif found.state == "not_asked":
            places.setdefault("", []).append(found.area)
    if not places:
        return []
    listed = "; ".join(f"{', '.join(areas)}{where}" for where, areas in places.items())
    return [f"Incomplete. Not searched: {listed}."]


def unknown(survey: Survey) -> list[str]:
    """The limits of a search by samples."""
    near, far = survey.distances
    return [
        "Nothing is known about addresses that were not asked: a range without a sample is missed.",
        f"Samples are {near} apart below {NEAR}, {far} above. --exact reads every address, --range "
        "limits it.",
    ]


def failures(survey: Survey) -> list[str]:
    """The failures other than exception 02, one line each."""
    lines = []
    for found in survey.areas:
        if found.given_up is not None:
            lines.append(f"{found.area}: {_words(survey, found.given_up)}; area skipped")
            continue
        for failure, ranges in found.failures.items():
            lines.append(f"{found.area}: {_words(survey, failure)} at {shown(ranges)}")
    return lines


def shown(ranges: Sequence[range]) -> str:
    """The first ranges, and how many more there are."""
    where = ", ".join(
        str(each.start) if len(each) == 1 else f"{each.start}-{each.stop - 1}"
        for each in ranges[:8]
    )
    return where + (f", and {len(ranges) - 8} more" if len(ranges) > 8 else "")


def _words(survey: Survey, failure: Failure) -> str:
    text = survey.texts.get(failure, str(failure))
    return terminal_text.styled(re.sub(r"\s+", " ", text), fg="red")


def failures_to_json(survey: Survey, found: AreaMap) -> dict[str, object]:
    """The failures of an area other than exception 02, for JSON."""
    return {
        "failures": [
            {**_reason(survey, failure), "ranges": pairs(ranges)}
            for failure, ranges in found.failures.items()
        ],
        "given_up": None if found.given_up is None else _reason(survey, found.given_up),
    }


def _reason(survey: Survey, failure: Failure) -> dict[str, object]:
    detail = {"detail": survey.texts.get(failure, str(failure))}
    if isinstance(failure, int):
        return {"reason": "exception", "code": failure, **detail}
    return {"reason": failure, **detail}


def pairs(ranges: Iterable[range]) -> list[list[int]]:
    """First and last address of each range."""
    return [[each.start, each.stop - 1] for each in ranges]
