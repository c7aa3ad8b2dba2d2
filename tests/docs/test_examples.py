"""Every code block of every page is run, or checked as `support/pages/decisions.py` says."""

from __future__ import annotations

import contextlib
import re
import shlex
from typing import TYPE_CHECKING

import click
import pytest

from support.pages import blocks
from support.pages.blocks import SHELL, Block
from support.pages.commands import parse
from support.pages.decisions import DECISIONS, NOT_RUN, decision
from support.pages.stage import Stage
from support.pages.stages import STAGES, everywhere

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PAGES = blocks.of_pages()


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with Stage(tmp_path) as stage, contextlib.chdir(tmp_path):
        everywhere(stage)
        yield stage


def failures(page: list[Block], stage: Stage, skipped: list[str]) -> list[str]:
    """What is wrong with the blocks of a page. Adds those that lack a program to `skipped`."""
    found = []
    for block in page:
        chosen = decision(block)
        if chosen is None:
            found.append(
                f"{block.place}: nothing is decided for this block: give it a language, or add it "
                "to DECISIONS in tests/support/pages/decisions.py"
            )
            continue
        stage.before(block.text)
        try:
            chosen(block, stage)
        except pytest.skip.Exception as missing:
            skipped.append(f"{block.place}: {missing}")
            if block.language in SHELL:
                break  # The blocks below can show what it prints.
        except Exception as error:
            text = str(error) if isinstance(error, AssertionError) else repr(error)
            found.append(text if text.startswith(block.page) else f"{block.place}: {text}")
    return found


@pytest.mark.parametrize("page", [name for name, found in PAGES.items() if found])
def test_the_examples_of_a_page_are_right(page: str, stage: Stage) -> None:
    if page in STAGES:
        STAGES[page](stage)
    skipped: list[str] = []
    found = failures(PAGES[page], stage, skipped)
    assert not found, "\n\n".join(found)
    if skipped:
        pytest.skip(", ".join(skipped))


def test_every_decision_is_for_a_block() -> None:
    every = [block for page in PAGES.values() for block in page]
    unused = [
        entry
        for entry in DECISIONS
        if not any(block.page == entry[0] and block.text.startswith(entry[1]) for block in every)
    ]
    assert unused == []


def test_every_command_that_is_not_run_is_on_a_page() -> None:
    every = [
        (block.page, command.text)
        for page in PAGES.values()
        for block in page
        if block.language in SHELL
        for command in blocks.commands(block)
    ]
    unused = [
        entry
        for entry in NOT_RUN
        if not any(page == entry[0] and text.startswith(entry[1]) for page, text in every)
    ]
    assert unused == []
    assert set(STAGES) <= set(PAGES)


@pytest.mark.parametrize("page", blocks.PAGES, ids=lambda page: page.name)
def test_the_options_of_commands_in_sentences_exist(page: Path) -> None:
    text = re.sub(r"^ *```.*?^ *```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    wrong = []
    for command in re.findall(r"`holdfast ([^`]+)`", text):
        try:
            parse(shlex.split(command))
        except click.NoSuchOption as error:
            wrong.append(f"holdfast {command}: {error.format_message()}")
        except click.UsageError:
            pass  # A sentence leaves out arguments.
    assert wrong == []


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("```\nsomething\n```", "docs/some.md:2: nothing is decided for this block"),
        ("```sh\nholdfast read --wrong\n```", "docs/some.md:2: holdfast read --wrong\nNo such"),
        ("\n```yaml\nlistener: {}\n```", "docs/some.md:3: no configuration: it has listener"),
        ("```yaml\nlog: {format: xml}\n```", "docs/some.md:2: page.yaml:1: log.format: found"),
        ("```python\nmax(1, 2)  # 3\n```", "docs/some.md:2: is 2, the page says 3"),
        ("```console\n$ holdfast token --name\n```", "docs/some.md:2: holdfast token --name\nOpt"),
        (
            "```console\n$ holdfast raw-send 127.0.0.1:1 coils 0 1 --unit 1 --dry-run\nno\n```",
            "docs/some.md:2: holdfast raw-send 127.0.0.1:1 coils 0 1 --unit 1 --dry-run\nthe page",
        ),
        ("```sh\nfalse\n```", "docs/some.md:2: false\nexit code 1"),
        ('```json\n{"a": 1}\n```', "docs/some.md:2: the commands before print"),
    ],
)
def test_a_wrong_block_is_named(text: str, told: str, stage: Stage) -> None:
    [found] = failures(blocks.of_page("docs/some.md", text), stage, [])
    assert found.startswith(told)
