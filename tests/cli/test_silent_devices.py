"""A signal ends each command at once, although a device does not answer for a long time."""

from __future__ import annotations

import json
import re
import signal
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest
from nats.errors import NoRespondersError

from support import web, wire
from support.cli import ProxyCommand, ServingCommand
from support.fake_device import ScriptedDevice, Stream, Udp, silent
from support.nats_bus import subscription, tag

if TYPE_CHECKING:
    from collections.abc import Iterator

    import holdfast
    from support.brokers import NatsServer
    from support.nats_bus import Caller

TIMEOUT = 30
"""Seconds that a command waits for the device: the most that all of them allow."""

END_TIMEOUT = TIMEOUT - 5
"""Seconds that a test waits for the command. One that waits for the device takes longer."""


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[ScriptedDevice]:
    """A device that never answers, over the transport of the parameter."""
    kind = getattr(request, "param", "tcp")
    made = Udp(kind=kind, then=silent) if "udp" in kind else Stream(kind, then=silent)
    with made:
        yield made


@pytest.fixture
def running() -> Iterator[ExitStack]:
    with ExitStack() as commands:
        yield commands


def started(commands: ExitStack, command: ServingCommand) -> ServingCommand:
    def kill() -> None:
        command.process.kill()
        command.process.communicate()

    commands.callback(kill)
    return command


@pytest.mark.parametrize("device", ["tcp", "rtu+tcp", "ascii+tcp", "udp"], indirect=True)
def test_the_gateway_ends_and_answers_the_request_that_waits(
    device: ScriptedDevice, running: ExitStack
) -> None:
    command = started(
        running, ServingCommand("gateway", "--bind", "127.0.0.1:0", "--allow", "127.0.0.1:*")
    )
    found = re.search(r"http://([0-9.]+):([0-9]+)/", command.wait_for_greeting())
    assert found
    transport, port = device.url.partition("://")[0], int(device.url.rpartition(":")[2])
    body = {"host": "127.0.0.1", "port": port, "transport": transport, "timeout": 1000 * TIMEOUT}
    body |= {"functionCode": 3, "address": 0, "quantity": 1}
    content = json.dumps(body).encode()
    head = web.head("POST", "/api/modbus/read", f"Content-Length: {len(content)}")
    with wire.Connection((found[1], int(found[2]))) as client:
        client.send(head + content)
        device.await_requests(1)
        code, log = command.end(signal.SIGTERM, END_TIMEOUT)
        reply = client.rest()
    assert (code, "Traceback" in log) == (0, False)
    assert reply.startswith(b"HTTP/1.1 503 ")
    assert b"the gateway is stopping" in reply


@pytest.mark.parametrize("device", ["tcp", "rtu+tcp", "udp"], indirect=True)
def test_the_proxy_ends(device: ScriptedDevice, running: ExitStack) -> None:
    command = ProxyCommand(device.url, "--timeout", str(TIMEOUT))
    started(running, command)
    with wire.Connection(command.wait_until_it_serves()) as client:
        client.send(wire.frame(bytes.fromhex("0300000001")))
        device.await_requests(1)
        code, log = command.end(signal.SIGTERM, END_TIMEOUT)
    assert (code, "Traceback" in log) == (0, False)


def test_the_scanner_ends(
    device: ScriptedDevice,
    running: ExitStack,
    nats: NatsServer,
    caller: Caller,
    server: holdfast.Server,
) -> None:
    command = started(running, ServingCommand("scan", "--nats", nats.url, "--allow", "127.0.0.0/8"))
    command.wait_for_greeting()
    port = int(device.url.rpartition(":")[2])
    asked = subscription(server, tag("a", 0), port=port, timeout=1000 * TIMEOUT)

    def is_subscribed() -> bool:
        try:
            return bool(caller.request("modbus.subscribe", asked)["success"])
        except NoRespondersError:
            return False

    wire.until(is_subscribed, "it serves")
    device.await_requests(1)
    code, log = command.end(signal.SIGTERM, END_TIMEOUT)
    assert (code, "Traceback" in log) == (0, False)


@pytest.mark.parametrize(
    "words",
    [
        ("describe map",),
        ("watch", "hr", "0"),
        ("read", "hr", "0"),
        ("write", "hr", "0", "1"),
        ("describe identify",),
    ],
    ids=lambda words: words[0],
)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_command_for_one_device_ends(
    device: ScriptedDevice, words: tuple[str, ...], number: signal.Signals, running: ExitStack
) -> None:
    name, *more = words
    command = started(
        running, ServingCommand(*name.split(), device.url, *more, "--timeout", str(TIMEOUT))
    )
    device.await_requests(1)
    code, log = command.end(number, END_TIMEOUT)
    assert "Traceback" not in log
    if number == signal.SIGINT:
        assert code == (0 if name == "watch" else 1)
    assert code != 0 or name == "watch"
