"""The MQTT adapter with the MQTT side of nats-server, which speaks version 3.1.1."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.brokers import NatsServer
from support.machine import tool
from support.mqtt_rig import Rig, command, settings, subscription, text

if TYPE_CHECKING:
    from collections.abc import Iterator

CONFIGURATION = """
server_name: holdfast-test
mqtt { listen: "127.0.0.1:-1" }
"""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Where a nats-server takes MQTT."""
    file = tmp_path / "nats.conf"
    file.write_text(CONFIGURATION)
    server = NatsServer(tmp_path, "-c", str(file))
    [port] = re.findall(r"Listening for MQTT clients on mqtt://127\.0\.0\.1:(\d+)", server.log)
    yield int(port)
    server.kill()


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
