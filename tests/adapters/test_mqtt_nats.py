"""The MQTT adapter with the MQTT side of nats-server, which speaks version 3.1.1."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.brokers import Rig, command, free_port, settings, subscription, text
from support.machine import missing, tool

if TYPE_CHECKING:
    from collections.abc import Iterator

CONFIGURATION = """
server_name: holdfast-test
listen: "127.0.0.1:-1"
jetstream {{ store_dir: "{folder}" }}
mqtt {{ listen: "127.0.0.1:{port}" }}
"""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Where a nats-server takes MQTT."""
    program = Path(sys.executable).with_name("nats-server")
    if not program.exists():
        missing("the program nats-server")
    for _ in range(10):
        port = free_port()
        file = tmp_path / "nats.conf"
        file.write_text(CONFIGURATION.format(folder=tmp_path / "store", port=port))
        log = tmp_path / "nats.log"
        process = subprocess.Popen([program, "-c", file, "-l", log])
        try:
            wire.until(
                lambda process=process, log=log: (  # type: ignore[misc]
                    process.poll() is not None
                    or (log.exists() and "Server is ready" in log.read_text())
                ),
                "nats-server starts",
            )
            if process.poll() is None:
                yield port
                return
        finally:
            process.kill()
            process.wait()
    raise AssertionError(log.read_text())


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_messages_are_written_and_bad_ones_are_not(tmp_path: Path, port: int, qos: int) -> None:
    with Rig(tmp_path) as rig:
        url = f"mqtt://127.0.0.1:{port}"
        running = rig.run(settings(url, subscription(qos=qos), version="3.1.1"))
        running.wait_until_connected()
        assert running.status()["topics"] == [{"topic": "plant/ingest", "qos": qos, "granted": qos}]

        for message in (command([1, 2, 3]), command([9, 70000]), command([4], 3)):
            publish = [tool("mosquitto_pub"), "-V", "311", "-h", "127.0.0.1", "-p", str(port)]
            publish += [
                "-i",
                "publisher",
                "-t",
                "plant/ingest",
                "-q",
                str(qos),
                "-m",
                text(message),
            ]
            subprocess.run(publish, check=True, timeout=wire.DEADLINE)
        running.wait_until_received(3)

        assert rig.registers(0, 5) == [1, 2, 3, 4, 0]
        assert rig.memory_access.counts()["refused"] == {"invalid_value": 1}
