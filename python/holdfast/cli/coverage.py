"""What a survey asked, and what it can't know, as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.cli import showing
from holdfast.tools.discovery import FAR_STEP, NEAR, NEAR_STEP

if TYPE_CHECKING:
    from holdfast.tools.discovery import Survey

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
            STATES[found.state].format(at=(found.reached or 0) - 1),
            str(found.addresses),
            str(sum(map(len, found.absent))),
            str(len(survey.span) - found.asked),
        )
        for found in survey.areas
    ]
    return showing.table(("area", "searched", "exist", "absent", "not asked"), rows, "<<>>>")


UNKNOWN = (
    "Nothing is known about addresses that were not asked: a range without a sample is missed.",
    f"Samples are {NEAR_STEP} apart below {NEAR}, {FAR_STEP} above. --exact reads every address, "
    "--range limits it.",
)
"""What a fast search can't know."""
