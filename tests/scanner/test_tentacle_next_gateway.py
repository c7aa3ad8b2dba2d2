"""The gateway of tentacle-next itself, where its program `tentacle-gateway` is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.scanner.subscriptions.request_rules import Defaults
from support import wire
from support.nats_bus import Caller
from support.tentacle_next import (
    BUCKET,
    CONFIGURATION,
    command,
    gateway_configuration,
    gateway_entry,
    gateway_tag,
    gateway_variable,
    key,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    import holdfast
    from support.brokers import NatsServer
    from support.nats_bus import Run

PROGRAM = shutil.which("tentacle-gateway")

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="tentacle-gateway is not installed")

NEXT: dict[str, Any] = {"dialect": "tentacle-next", "defaults": Defaults(publish="change")}


@pytest.fixture
def bus(own_nats: NatsServer) -> Iterator[Caller]:
    with Caller(own_nats.url) as caller:
        yield caller


@pytest.fixture
def gateway(own_nats: NatsServer, bus: Caller, tmp_path: Any) -> Iterator[None]:
    """The gateway, which has written its first heartbeat."""
    environment = {**os.environ, "NATS_URL": own_nats.url, "MODULE_ID": "gateway"}
    log = tmp_path / "gateway.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(PROGRAM)], env=environment, stdout=output, stderr=output, cwd=tmp_path
        )
        try:
            wire.until(lambda: "gateway" in bus.kept(CONFIGURATION), "the gateway runs")
            yield
        finally:
            process.kill()
            process.wait()


def browsed(bus: Caller) -> dict[str, set[str]]:
    """The ids of the tags of each device."""
    found = bus.request("modbus.browse", b"")["devices"]
    return {each["deviceId"]: {tag["id"] for tag in each["tags"]} for each in found}


@pytest.mark.usefixtures("gateway")
def test_the_gateway_reads_writes_and_changes_its_configuration(
    run_scanner: Run,
    own_nats: NatsServer,
    bus: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
) -> None:
    memory.write("holding_registers", 0, [7, 0x42F6, 0xE979])
    first = run_scanner(own_nats, **NEXT)
    data = bus.listen("gateway.data.>")
    variables = [
        gateway_variable("Speed", "speed", 0, writable=True),
        gateway_variable("Pressure", "Line 1.pressure", 1, "float32"),
        gateway_variable("Running", "running", 0, function=1, writable=True),
    ]
    bus.put(CONFIGURATION, "gateway", gateway_configuration(server, *variables))
    found: dict[str, Any] = {}
    while found.keys() != {"Speed", "Pressure", "Running"}:
        message = data.next()
        found[message["variableId"]] = (message["value"], message["datatype"])
    assert found == {
        "Speed": (7, "number"),
        "Pressure": (123.45600128173828, "number"),
        "Running": (False, "boolean"),
    }
    assert bus.kept(BUCKET).keys() == {key()}

    memory.write("holding_registers", 0, [8])
    data.until(lambda each: each["value"] == 8, "the gateway publishes the change")
    bus.publish("gateway.command.speed", command(1450))
    wire.until(lambda: memory.read("holding_registers", 0, 1) == [1450], "it is written")
    bus.publish("gateway.command.running", command(True))
    wire.until(lambda: memory.read("coils", 0, 1) == [1], "the coil is on")

    first.stop()
    run_scanner(own_nats, **NEXT)
    assert browsed(bus) == {"plc1": {"speed", "Line 1.pressure", "running"}}

    data.take()
    other = gateway_variable("Level", "level", 5)
    bus.put(CONFIGURATION, "gateway", gateway_configuration(server, variables[0], other))
    wire.until(lambda: browsed(bus) == {"plc1": {"speed", "level"}}, "it is changed")
    data.until(lambda each: each["variableId"] == "Level", "the new variable has a value")
    bus.delete(CONFIGURATION, "gateway")
    wire.until(lambda: browsed(bus) == {}, "its subscriptions have ended")


@pytest.mark.usefixtures("gateway")
def test_the_messages_of_the_tests_are_those_of_the_gateway(
    bus: Caller, server: holdfast.Server
) -> None:
    variable = gateway_variable("Speed", "speed", 0)
    bus.put(CONFIGURATION, "gateway", gateway_configuration(server, variable, rate=100))
    wire.until(lambda: key() in bus.kept(BUCKET), "it writes its entry")
    entry = gateway_entry(server, gateway_tag("speed", 0), rate=100)
    assert bus.text(BUCKET, key()) == entry
