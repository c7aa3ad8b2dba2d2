"""The fenced code blocks of the pages, and the commands in them."""

from __future__ import annotations

import re
import shlex
import textwrap
from dataclasses import dataclass

from support.paths import DOCS, ROOT

PRINTED = DOCS / "benchmark-runs.md"
"""What programs have printed: it has no examples."""

PAGES = [ROOT / "README.md", *sorted({*DOCS.glob("*.md")} - {PRINTED})]
SHELL = {"sh", "console"}


@dataclass(frozen=True)
class Block:
    """A code block; `line` is that of its first line of text."""

    page: str
    line: int
    language: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


@dataclass(frozen=True)
class Command:
    """A command of a block, and the output that the page shows for it."""

    place: str
    text: str
    output: str

    @property
    def environment(self) -> dict[str, str]:
        """The variables that are set for it."""
        before = re.match(r"(?:[A-Za-z_]\w*=\S* )*", self.text)
        assert before
        return dict(each.split("=", 1) for each in before[0].split())

    @property
    def programs(self) -> list[list[str]]:
        """The programs of its pipeline with their arguments, as a shell splits them."""
        lexer = shlex.shlex(self.text, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        found: list[list[str]] = [[]]
        words = iter(lexer)
        for word in words:
            if word in {"|", ";", "&&"}:
                found.append([])
            elif word in {">", ">>", "<"}:
                next(words)
            elif found[-1] or not re.match(r"[A-Za-z_]\w*=", word):
                found[-1].append(word)
        return [program for program in found if program]


def of_page(page: str, text: str) -> list[Block]:
    """The blocks of a page, in order. Raises `AssertionError` for one that does not end."""
    found = []
    opened: tuple[int, str] | None = None
    lines: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        fence = re.fullmatch(r" *```(\S*) *", line)
        if fence is None:
            lines.append(line)
        elif opened is None:
            opened, lines = (number + 1, fence[1]), []
        else:
            joined = textwrap.dedent("".join(f"{each}\n" for each in lines))
            found.append(Block(page, *opened, joined))
            opened = None
    assert opened is None, f"{page}:{opened}: this block does not end"
    return found


def of_pages() -> dict[str, list[Block]]:
    """The blocks of each page."""
    names = {str(page.relative_to(ROOT)): page for page in PAGES}
    return {name: of_page(name, page.read_text()) for name, page in names.items()}


def commands(block: Block) -> list[Command]:
    """The commands of a block: in `console`, those after `$ `, with the output below each."""
    lines = block.text.splitlines()
    found: list[Command] = []
    at = 0
    while at < len(lines):
        begin = at
        text = lines[at]
        at += 1
        if block.language == "console":
            assert text.startswith("$ "), f"{block.page}:{block.line + begin}: begin with `$ `"
            text = text.removeprefix("$ ")
        while not _complete(text) and at < len(lines):
            text += f"\n{lines[at]}"
            at += 1
        shown = []
        while block.language == "console" and at < len(lines) and lines[at][:2] != "$ ":
            shown.append(f"{lines[at]}\n")
            at += 1
        if text.strip() and not text.startswith("#"):
            found.append(Command(f"{block.page}:{block.line + begin}", text, "".join(shown)))
    return found


def _complete(text: str) -> bool:
    try:
        shlex.split(text, comments=True)
    except ValueError:
        return False
    return not text.endswith("\\")
