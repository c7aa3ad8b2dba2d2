"""The page about the memory alone: its configuration loads what its table says."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING

from support import wire
from support.brokers import free_port
from support.paths import DOCS

if TYPE_CHECKING:
    from pathlib import Path

PAGE = (DOCS / "just-the-memory.md").read_text()
PORTS = ("5020", "9000", "8080")


def test_what_the_table_names_is_loaded_or_not_loaded(tmp_path: Path) -> None:
    loaded = modules(tmp_path)
    rows = re.findall(r"^\| (`.*?) \| (.+) \|$", PAGE, re.M)
    assert len(rows) > 5
    for parts, when in rows:
        for part in re.findall(r"`(\S+?)`", parts):
            name = {"ruamel.yaml": "ruamel.yaml.main"}.get(part, part)
            assert (name in loaded) == (when != "not"), part


def modules(folder: Path) -> set[str]:
    """Runs the configuration of the page, and returns all modules that the process has imported."""
    [text, *_] = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.M | re.S)
    ports = {port: str(free_port()) for port in PORTS}
    text = re.sub("|".join(rf"\b{port}\b" for port in PORTS), lambda at: ports[at[0]], text)
    (folder / "plant.yaml").write_text(text)
    log = folder / "imports"
    command = [sys.executable, "-X", "importtime", "-m", "holdfast", "run", "plant.yaml"]
    with (
        log.open("w") as file,
        subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=file) as process,
    ):
        try:
            wire.until(lambda: process.poll() is not None or serves(ports["8080"]), "REST answers")
            with wire.Connection(("127.0.0.1", int(ports["5020"]))) as client:
                assert client.ask(bytes.fromhex("0300000001")).hex() == "03020000"
        finally:
            process.terminate()
    return set(re.findall(r"^import time:.*\| +(\S+)$", log.read_text(), re.M))


def serves(port: str) -> bool:
    """Tells whether REST answers."""
    try:
        with wire.Connection(("127.0.0.1", int(port))) as client:
            client.send(
                b"GET /api/v1/health HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n"
            )
            return client.rest().startswith(b"HTTP/1.1 ")
    except OSError:
        return False
