"""The pages about tags: their commands print what they say, with other numbers."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

import pytest

import holdfast
from support.cli import ServingCommand, invoke
from support.paths import DOCS, ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LIST = "examples/tags/heater.yaml"
PAGES = ("tags.md", "cli.md", "compare.md")
URL = "tcp://127.0.0.1:5020"
SIMULATE = f"holdfast simulate {LIST}"


def commands(page: str) -> list[tuple[str, str]]:
    """The commands of a page that use the device of the example, and what they print."""
    text = (DOCS / page).read_text()
    blocks = re.findall(r"^```console\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    found = [
        part.split("\n", 1)
        for block in blocks
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]
    ]
    used = re.compile(r"--tags|ir:\d")
    return [(command, shown) for command, shown in found if used.search(command)]


EXAMPLES = [each for page in PAGES for each in commands(page)]


@pytest.fixture(scope="module")
def simulated() -> Iterator[tuple[str, str]]:
    """The URL of the simulated device, and what the command says."""
    command = ServingCommand("simulate", str(ROOT / LIST), "--port", "0")
    try:
        greeting = command.wait_for_greeting()
        found = re.search(r"tcp://\S+:\d+", greeting)
        assert found is not None
        yield found[0], greeting.replace(found[0], URL).replace(str(ROOT / LIST), LIST)
    finally:
        command.process.kill()
        command.process.communicate()


def masked(text: str) -> set[str]:
    """The lines, without numbers, states and widths."""
    text = re.sub(r"\d[\d.:TZ-]*|\btrue\b|\bfalse\b", "#", text)
    text = re.sub(r"\b(off|heating|fault) \(#\)", "STATE", text)
    text = re.sub(r'"states": \{.*?\}', "", text)
    return {" ".join(line.split()) for line in text.splitlines()}


@pytest.mark.parametrize(("command", "shown"), EXAMPLES, ids=[each for each, _ in EXAMPLES])
def test_the_commands_print_what_the_pages_say(
    simulated: tuple[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    shown: str,
) -> None:
    url, _ = simulated
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "wrong.yaml").write_text(
        "order: CDAB\ntags:\n  power: {area: input_registers, address: 2, type: float23}\n"
    )
    monkeypatch.chdir(tmp_path)
    program, *arguments = shlex.split(command.replace(URL, url))
    assert program == "holdfast"
    assert masked(invoke(*arguments).output.replace(url, URL)) == masked(shown)


def test_the_simulated_device_is_introduced_as_the_page_says(
    simulated: tuple[str, str],
) -> None:
    text = (DOCS / "tags.md").read_text()
    shown = text.split(f"$ {SIMULATE}\n")[1].split("```")[0]
    assert simulated[1] == shown


def test_the_python_of_the_page_does_what_it_says() -> None:
    setpoint = holdfast.load_tags(ROOT / LIST)["setpoint"]
    assert setpoint.value(215) == 21.5
    assert setpoint.raw(21.5) == 215


def test_the_example_of_csv_is_a_tag_list(tmp_path: Path) -> None:
    text = (DOCS / "tags.md").read_text()
    [example] = re.findall(r"^```csv\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    file = tmp_path / "list.csv"
    file.write_text(example)
    assert [(tag.name, tag.writable) for tag in holdfast.load_tags(file)] == [
        ("power", False),
        ("setpoint", True),
    ]


def test_the_examples_of_yaml_are_valid(tmp_path: Path) -> None:
    text = (DOCS / "tags.md").read_text()
    first, plant = re.findall(r"^```yaml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    file = tmp_path / "list.yaml"
    file.write_text(first)
    assert len(holdfast.load_tags(file)) == 4
    file.write_text(plant)
    result = invoke("check", str(file))
    assert result.exit_code == 0, result.output
