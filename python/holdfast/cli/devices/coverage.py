"""The coverage of a survey as text: which addresses it asked, and which it did not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.cli import terminal_text
from holdfast.discovery.address_search import NEAR

if TYPE_CHECKING:
    from holdfast.discovery.address_search import AreaMap, Survey

STATES = {
    "searched": "yes",
    "partly": "to {at}",
    "given_up": "skipped",
    "not_asked": "no",
}


def counts(survey: Survey) -> list[str]:
    """For each area, how many addresses exist, are absent, and were not asked."""
    rows = [
        (
            found.area,
            _searched(survey, found),
            str(found.addresses),
            str(sum(map(len, found.absent))),
            str(len(survey.span) - found.asked),
        )
        for found in survey.areas
    ]
    return terminal_text.table(("area", "searched", "exist", "absent", "not asked"), rows, "<<>>>")


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
