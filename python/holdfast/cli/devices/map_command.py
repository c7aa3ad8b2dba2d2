"""`holdfast describe map`: finds the addresses of a device."""

from __future__ import annotations

import shutil
import sys
import time
from typing import TYPE_CHECKING

import click

from holdfast.cli import device_errors, terminal_text
from holdfast.cli.devices import coverage
from holdfast.cli.devices.search_report import Ended, RangeReport, Report, ended_to_json
from holdfast.cli.exit_codes import fail
from holdfast.cli.options import device
from holdfast.cli.options.option import json_option
from holdfast.cli.options.search import announced, planned, survey_options
from holdfast.cli.options.url import url_argument
from holdfast.cli.signals import interruptions
from holdfast.discovery import address_search
from holdfast.discovery.address_search import Survey

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.cli.options.search import Settings
    from holdfast.client import SyncClient
    from holdfast.discovery.address_search import AreaMap

BLOCKS = "▁▂▃▄▅▆▇█"
ABSENT = "·"
ASCII = ("-" * 7 + "#", ".")
"""The same for an output that can only show ASCII."""

NOT_ASKED = " "

MAX_COLUMNS = 100


@click.command("map", epilog="Example: holdfast describe map tcp://192.168.0.10 --areas hr,ir")
@url_argument
@survey_options
@device.device_options
@json_option
def map_(
    url: str,
    settings: Settings,
    unit: int,
    timeout: float,
    as_json: bool,
) -> None:
    """Find the addresses of the device at URL by reading; nothing is written.

    An address exists if reading it succeeds, and is absent if reading it returns exception 02.
    Other exceptions, timeouts and invalid replies are counted as failed, and listed. Addresses that
    were not asked are counted: nothing is known about them.

    Without --exact, reads samples: the first 16, multiples of 10 below 10000 and of 100 above, the
    addresses after them (101, 1001), multiples of 10 from 30000 and 40000 to 1000 addresses later,
    every 256th address; then the whole range around each existing sample. All reported
    addresses were read. A range without a sample is missed. This takes about 2200 requests per
    area, more for large ranges. With --sparse, about 600: samples are 50 apart below 10000, 256
    above, and short ranges are missed more often.

    With --exact, reads every address: in blocks where addresses exist, in halves where a block
    fails, and one by one elsewhere. Nothing is missed, but each missing address takes a request, up
    to 65536 per area: minutes over TCP, hours on a serial line. --range and --areas limit the
    search.

    If no register of an area answers alone, two and four registers are read at some places; if such
    a read succeeds, the area is searched again in steps of that size.

    The registers at usual starts come first (0, 1, 100, 1000, …, 40000), then the other registers,
    then coils and discrete inputs. Each range is printed when its ends are known; with --json, as
    an element of "found".

    Ctrl-C, or SIGTERM, prints the results so far, and where the search did not look. A second one
    ends the command at once.

    Exit codes: 0 done; 1 the device did not answer, or the search ended early; 2 wrong usage.
    """
    survey = planned(settings)
    if sys.stderr.isatty():
        click.echo(announced(survey), err=True)
    began = time.monotonic()
    with interruptions() as signals:
        report = Report({"target": url, "unit": unit}, signals)
        with device.connect(url, unit, timeout) as client:
            why = _search(survey, client, settings.delay, report, url)
        seconds = time.monotonic() - began
        report.end({**ended_to_json(why), **_to_json(survey, seconds)})
        if why is None or any(each.ranges or each.failures for each in survey.areas):
            report.text(*_summary(f"{url}, unit {unit}", survey, seconds))
        if not as_json:
            for each in survey.areas:
                for failure in (*each.failures, each.given_up):
                    device_errors.hint(failure, url)
    if why is not None:
        fail(f"{url}: {why}", is_printed=as_json)


def _search(
    survey: Survey, client: SyncClient, delay: float, report: Report, url: str
) -> Ended | None:
    """Carries out a survey, and prints its ranges. Returns why it ended early, or `None`."""
    ranges = RangeReport(report, survey)

    def progress(survey: Survey) -> None:
        ranges.update()
        report.advance(survey.at)

    def search() -> None:
        with report.progress("Mapping", survey.total, lambda: _requests(survey)):
            address_search.run_sync(survey, client.read, progress, delay=delay)

    why = report.attempt(search, url, lambda: True)
    ranges.end()
    return why


def _summary(device: str, survey: Survey, seconds: float) -> list[str]:
    """The findings of a survey, without the table of its ranges."""
    found = terminal_text.counted(sum(each.addresses for each in survey.areas), "address")
    head = f"{device}: {found}; {_how(survey)}, {_requests(survey)} in {seconds:.1f} s"
    failures = coverage.failures(survey)
    is_empty = not any(each.ranges for each in survey.areas)
    return [
        *([] if is_empty else [""]),
        head,
        *coverage.incomplete(survey),
        "",
        *_picture(survey),
        *(["", "No address was found."] if is_empty else []),
        *([""] if failures else []),
        *failures,
        *_unknown(survey),
    ]


def _how(survey: Survey) -> str:
    """How complete the search is."""
    if not survey.is_done:
        return "incomplete"
    return "every address read" if survey.exact else "samples read"


def _requests(survey: Survey) -> str:
    return terminal_text.counted(survey.requests, "request")


def _picture(survey: Survey) -> list[str]:
    """One line per area, and a scale."""
    labels = [terminal_text.words(found.area) for found in survey.areas]
    margin = max(map(len, labels)) + 2
    columns = min(shutil.get_terminal_size().columns, MAX_COLUMNS)
    cells = max(8, min(columns - margin - 1, len(survey.span)))
    lines = [
        f"{label:{margin}}{_line(found, survey.span, cells)}"
        for label, found in zip(labels, survey.areas, strict=True)
    ]
    scale = ""
    for quarter in range(4):
        at = cells * quarter // 4
        if not scale or len(scale) < at:
            scale = f"{scale:{at}}{_bounds(survey.span, cells, at)[0]}"
    last = str(survey.span.stop - 1)
    scale = f"{scale:{cells - len(last)}}{last}" if len(scale) < cells - len(last) else scale
    return [*lines, " " * margin + scale]


def _line(found: AreaMap, span: range, cells: int) -> str:
    """One area: the height of a block shows the share of existing addresses in a cell.

    A cell is empty if none of its addresses was asked.
    """
    blocks, absent = (BLOCKS, ABSENT) if terminal_text.fits(BLOCKS + ABSENT) else ASCII
    missing = _counts(found.absent, span, cells)
    there = _counts(found.ranges, span, cells)
    failed = _counts((each for some in found.failures.values() for each in some), span, cells)
    line = []
    for cell in range(cells):
        first, stop = _bounds(span, cells, cell)
        if there[cell]:
            # Only a full cell has the highest block.
            level = there[cell] * (len(blocks) - 1) // (stop - first)
            line.append(terminal_text.styled(blocks[level], fg="green"))
        else:
            nothing = absent if missing[cell] else NOT_ASKED
            line.append(terminal_text.styled("!", fg="red") if failed[cell] else nothing)
    return "".join(line).rstrip()


def _counts(ranges: Iterable[range], span: range, cells: int) -> list[int]:
    """The number of addresses in each cell."""
    counts = [0] * cells
    for each in ranges:
        cell = (each.start - span.start) * cells // len(span)
        while cell < cells:
            first, stop = _bounds(span, cells, cell)
            counts[cell] += max(0, min(stop, each.stop) - max(first, each.start))
            if stop >= each.stop:
                break
            cell += 1
    return counts


def _bounds(span: range, cells: int, cell: int) -> tuple[int, int]:
    """The first address of a cell, and the address after its last."""
    size = len(span)
    return span.start + -(-cell * size // cells), span.start + -(-(cell + 1) * size // cells)


def _unknown(survey: Survey) -> list[str]:
    """The limits of the search; nothing if every address was asked."""
    if survey.is_done and survey.exact:
        return []
    return [
        "",
        *coverage.counts(survey),
        *([] if survey.exact else ["", *coverage.unknown(survey)]),
    ]


def _to_json(survey: Survey, seconds: float) -> dict[str, object]:
    """The survey for JSON."""
    return {
        "exact": survey.exact,
        "complete": survey.is_done,
        "max_requests": survey.max_requests,
        "address": survey.span.start,
        "count": len(survey.span),
        "requests": survey.requests,
        "seconds": round(seconds, 3),
        "areas": {found.area: _area(survey, found) for found in survey.areas},
    }


def _area(survey: Survey, found: AreaMap) -> dict[str, object]:
    return {
        "state": found.state,
        "searched_to": None if found.reached in (None, survey.span.start) else found.reached - 1,
        "not_searched_from": survey.not_searched_from(found),
        "ranges": coverage.pairs(found.ranges),
        "addresses": found.addresses,
        "absent": coverage.pairs(found.absent),
        "not_asked": len(survey.span) - found.asked,
        **coverage.failures_to_json(survey, found),
        "largest_read": found.largest,
        "requests": found.requests,
    }
