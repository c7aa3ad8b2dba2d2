"""The pages that help: messages, events and figures on them are those of the program."""

from __future__ import annotations

import errno
import os
import re
from typing import TYPE_CHECKING

from holdfast._core import EXCEPTIONS
from holdfast.cli import COMMANDS
from holdfast.cli.exit_codes import MEANINGS, ExitCode
from support.log_events import logged
from support.paths import DOCS, ROOT

if TYPE_CHECKING:
    from pathlib import Path

TROUBLES = (DOCS / "troubleshooting.md").read_text()
OF_RESOLVERS = {"Name or service not known", "Temporary failure in name resolution"}
OF_THE_SYSTEM = {"timed out", *OF_RESOLVERS, *map(os.strerror, errno.errorcode)}


def column(text: str, title: str) -> list[str]:
    """The cells below a title, in all tables of a text."""
    found: list[str] = []
    place = None
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if not line.startswith("| "):
            place = None
        elif place is None:
            place = next((at for at, cell in enumerate(cells) if title in cell), -1)
        elif place >= 0 and set(line) - set("| -"):
            found.append(cells[place])
    return found


def quoted(cells: list[str]) -> list[str]:
    return [word for cell in cells for word in re.findall("`([^`]+)`", cell)]


def source() -> str:
    files = [*ROOT.glob("python/**/*.py"), *ROOT.glob("crates/*/src/**/*.rs")]
    return "\n".join(file.read_text() for file in files)


def test_the_messages_occur_in_the_program() -> None:
    words = [
        word for word in quoted(column(TROUBLES, "message")) if not re.fullmatch("[a-z_]+", word)
    ]
    assert len(words) > 15
    text = source()
    lost = []
    for word in words:
        exception = re.fullmatch(r"exception (\w\w) \((.+)\)", word)
        if exception:
            known = EXCEPTIONS.get(int(exception[1], 16)) == exception[2]
        else:
            parts = [part.strip() for part in word.split("…")]
            known = word in OF_THE_SYSTEM or all(part in text for part in parts)
        if not known:
            lost.append(word)
    assert lost == []


def test_the_events_are_those_that_the_program_logs() -> None:
    events = {
        word for word in quoted(column(TROUBLES, "log event")) if re.fullmatch("[a-z_]+", word)
    }
    assert len(events) > 30
    metrics = {event for event in events if event.startswith("holdfast_")}
    assert sorted(events - metrics - logged() - {"error", "stale"}) == []
    listed = (DOCS / "metrics.md").read_text()
    assert [
        metric for metric in metrics if metric.removeprefix("holdfast_device") not in listed
    ] == []


def linked(cell: str, page: Path) -> str:
    """The text of the pages that a cell links to."""
    files = re.findall(r"\]\(([\w-]+\.md)", cell)
    return "\n".join((page.parent / file).read_text() for file in files)


def numbers(text: str) -> set[str]:
    return set(re.findall(r"\d[\d,.]*\d|\d", text))


def test_the_figures_for_sizing_are_those_of_the_pages_that_they_link() -> None:
    page = DOCS / "sizing.md"
    rows = [line for line in page.read_text().splitlines() if re.search(r"\]\([^)]*\) \|$", line)]
    assert len(rows) > 15
    lost = {
        row: numbers(row.split(" | ")[1]) - numbers(linked(row, page))
        for row in rows
        if numbers(row.split(" | ")[1]) - numbers(linked(row, page))
    }
    assert lost == {}


def test_the_figures_of_the_readme_are_those_of_the_benchmarks() -> None:
    section = (ROOT / "README.md").read_text().split("## Performance\n")[1].split("\n## ")[0]
    found = numbers(section)
    assert len(found) > 10
    assert sorted(found - numbers((DOCS / "benchmarks.md").read_text())) == []


def test_each_log_event_is_explained() -> None:
    pages = ("operations", "scanner", "mqtt", "outputs", "durability", "fleet")
    explained = {
        word for page in pages for word in re.findall(r"`(\w+)`", (DOCS / f"{page}.md").read_text())
    }
    assert sorted(logged() - explained) == []


def test_the_page_of_the_command_line_has_every_command() -> None:
    table = (DOCS / "cli.md").read_text().split("\n## ")[0]
    named = {word.split()[0] for word in re.findall(r"`([a-z][^`]*)`", table)}
    assert sorted(set(COMMANDS) - named) == []


def test_the_page_of_the_command_line_lists_the_exit_codes() -> None:
    rows = re.findall(r"^\| (\d) \| (.+) \|$", (DOCS / "cli.md").read_text(), re.M)
    assert rows == [(str(code.value), MEANINGS[code]) for code in ExitCode]
