"""The example of a mirror: one command runs it all, and shows what its page says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from holdfast.config import load
from support import wire
from support.brokers import free_port
from support.commands import write_script
from support.machine import tool
from support.paths import EXAMPLES

FOLDER = EXAMPLES / "replication"
PORTS = range(5031, 5035)


@pytest.fixture
def ports() -> dict[str, str]:
    """Ports of this machine that are free, in place of those of the example."""
    found: set[int] = set()
    while len(found) < len(PORTS):
        found.add(free_port())
    return dict(zip(map(str, PORTS), map(str, found), strict=True))


def test_one_command_shows_what_the_page_says(tmp_path: Path, ports: dict[str, str]) -> None:
    back = {own: port for port, own in ports.items()}
    for file in FOLDER.iterdir():
        text = re.sub(r"\b503[1-4]\b", lambda match: ports[match[0]], file.read_text())
        (tmp_path / file.name).write_text(text)
    shutil.copymode(FOLDER / "run", tmp_path / "run")
    script = tmp_path / "holdfast"
    write_script(script)
    done = subprocess.run(
        [tool("sh"), tmp_path / "run"],
        env={**os.environ, "HOLDFAST": str(script)},
        capture_output=True,
        text=True,
        timeout=4 * wire.DEADLINE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    shown = re.sub(r"(?<=:)\d+\b", lambda match: back.get(match[0], match[0]), done.stdout)
    page = (FOLDER / "README.md").read_text()
    block = page.split("```\n")[2]
    assert block == shown.lstrip("\n")
    # Everything has ended.
    for port in ports.values():
        with pytest.raises(ConnectionRefusedError):
            wire.Connection(("127.0.0.1", int(port)))


@pytest.mark.parametrize("name", ["source", "mirror", "target"])
def test_the_configurations_are_right_and_stay_on_this_machine(name: str) -> None:
    config = load(FOLDER / f"{name}.yaml")
    assert config.warnings == ()
    for listener in config.listeners.values():
        bind = getattr(listener, "bind", None)
        assert bind is not None
        assert bind.address.is_loopback
