"""The page about routes: its commands print what it says, and its configuration is an example."""

from __future__ import annotations

import re
import shlex

import pytest

from holdfast.client.url import parse
from holdfast.config import load
from holdfast.config.models.links import LinkConfig
from support.brokers import free_port
from support.cli import ServingCommand, done, invoke
from support.paths import DOCS, EXAMPLES
from support.routed import configuration, counters
from support.running import Run, endpoint

PAGE = (DOCS / "routes.md").read_text()
EXAMPLE = EXAMPLES / "routes.yaml"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def first_cells(heading: str) -> list[str]:
    """The words in the first column of the table of a section."""
    section = PAGE.split(f"# {heading}\n")[1].split("\n#")[0]
    return re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)


def test_the_commands_of_the_page_print_what_it_says(run: Run) -> None:
    text = (
        (EXAMPLES / "plant.yaml")
        .read_text()
        .replace("initial: boiler.csv", f"initial: {EXAMPLES}/boiler.csv")
    )
    plant = run(re.sub(r"(bind: 127\.0\.0\.1):\d+", r"\1:0", text))
    ports = {"5020": str(endpoint(plant, "scada")[1]), "5030": str(free_port())}
    served, read = (
        re.sub(r"\b50[23]0\b", lambda match: ports[match[0]], block) for block in blocks("console")
    )

    command, _, greeting = served.removeprefix("$ holdfast ").partition("\n")
    proxy = ServingCommand(*shlex.split(command))
    try:
        assert proxy.wait_for_greeting() == greeting
        command, _, output = read.removeprefix("$ holdfast ").partition("\n")
        assert done(*shlex.split(command)) == output.splitlines()
    finally:
        proxy.process.kill()
        proxy.process.communicate()


def test_the_configuration_of_the_page_is_the_example() -> None:
    shown, *_ = blocks("yaml")
    assert EXAMPLE.read_text().endswith(f"\n\n{shown}")
    assert load(EXAMPLE).warnings == ()


def test_the_table_of_options_is_complete() -> None:
    told = set(re.findall(r"--[a-z-]+", invoke("proxy", "--help").stdout)) - {"--help"}
    section = PAGE.split("## Configuration")[0]
    assert set(re.findall(r"^\| `(--[a-z-]+)", section, re.MULTILINE)) == told


def test_the_table_of_counters_is_complete(run: Run) -> None:
    assert first_cells("Counters") == list(counters(run(configuration("tcp://127.0.0.1:1"))))


def test_the_reference_has_every_key_of_a_link() -> None:
    section = (DOCS / "config.md").read_text().split("\n## `links.NAME`\n")[1].split("\n## ")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == set(LinkConfig.model_fields)


@pytest.mark.parametrize("url", sorted(set(re.findall(r"(?:rtu|tcp|ascii)://[^\s'`]+\w", PAGE))))
def test_every_url_is_valid(url: str) -> None:
    assert parse(url)
