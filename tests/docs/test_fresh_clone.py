"""What a newcomer does: the first commands of the README, in a fresh clone and a fresh home."""

from __future__ import annotations

import os
import re
import subprocess
import urllib.request
from pathlib import Path

import pytest

from support import wire
from support.brokers import free_port
from support.machine import tool
from support.pages import blocks
from support.paths import ROOT

BUILD_TIMEOUT_S = 1800.0
PAGES = blocks.of_pages()


def environment(home: Path) -> dict[str, str]:
    """That of a new user, but for Rust. Crates of others are not compiled again."""
    kept = {
        key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "MAKEFLAGS")
    }
    rust = {
        name: os.environ.get(name, str(Path.home() / folder))
        for name, folder in (("CARGO_HOME", ".cargo"), ("RUSTUP_HOME", ".rustup"))
    }
    return {**kept, **rust, "HOME": str(home), "CARGO_TARGET_DIR": str(ROOT / "target")}


def build_blocks() -> dict[str, str]:
    """The blocks of pages that build the checkout and activate its environment."""
    return {
        block.place: block.text
        for page in PAGES.values()
        for block in page
        if re.match(r"make build *(#.*)?\nsource ", block.text)
    }


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    folder = tmp_path / "holdfast"
    subprocess.run([tool("git"), "clone", "--quiet", str(ROOT), str(folder)], check=True)
    (tmp_path / "home").mkdir()
    return folder


@pytest.mark.skipif("HOLDFAST_DIST" not in os.environ, reason="`make dist-check` runs it")
@pytest.mark.timeout(BUILD_TIMEOUT_S)
def test_the_first_commands_of_the_readme_lead_to_values(clone: Path) -> None:
    own = environment(clone.parent / "home")

    def bash(script: str) -> str:
        done = subprocess.run(
            [tool("bash"), "-e", "-c", script],
            cwd=clone,
            env=own,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=BUILD_TIMEOUT_S,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    for text in build_blocks().values():
        asked = bash(f"{text}\ncommand -v holdfast\nholdfast --version")
        assert f"{clone}/.venv/bin/holdfast" in asked
    file = clone / "examples" / "plant.yaml"
    ports = re.sub(r"127\.0\.0\.1:\d+", lambda _: f"127.0.0.1:{free_port()}", file.read_text())
    file.write_text(ports)
    [first, *_] = PAGES["README.md"]
    assert first.text.startswith("make run ")
    command = [tool("bash"), "-c", f"exec {first.text.splitlines()[0]}"]
    with subprocess.Popen(
        command, cwd=clone, env=own, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            greeting = "".join(iter(process.stdout.readline, "Ctrl-C stops it.\n"))
            again = subprocess.run(command, cwd=clone, env=own, capture_output=True, text=True)
            console, watch, write = re.findall(r"^    (\S.*)$", greeting, re.MULTILINE)
            with urllib.request.urlopen(console, timeout=wire.DEADLINE) as answer:
                assert b"<title>Holdfast" in answer.read()
            assert "voltage" in bash(f"{watch} --times 1 --csv")
            assert "Read back alike." in bash(write)
        finally:
            process.terminate()
    assert again.returncode != 0
    assert "in use by another program" in again.stderr


def test_every_page_that_begins_with_a_build_has_the_same_commands() -> None:
    assert {place.split(":")[0] for place in build_blocks()} >= {
        "README.md",
        "docs/install.md",
        "docs/start.md",
    }
    assert len({re.sub(r"#.*", "", text) for text in build_blocks().values()}) == 1
