"""A NATS server, a device and a scanner: what it publishes, replies and writes."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nats.errors import NoRespondersError
from nats.js.errors import NotFoundError

import holdfast
from peers.originals.comparison import Command
from support import wire
from support.brokers import NatsServer
from support.nats_bus import Caller

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.nats_bus import Inbox

MARK = 900
"""The register that a test writes last, to see that what was sent before has been carried out."""
WORDS = [0x4248, 0xF5C3, 0x0001, 0x8002, 0xC0A8, 0x0000, 0x7FFF, 0xFFFE]
"""Registers whose values differ in every type and order."""
SCANNER = Command([sys.executable, "-m", "holdfast", "scan", "--publish", "change"])
"""Holdfast in the place of a scanner, as docs/moving-from-tentacle.md starts it."""


@dataclass
class Bench:
    """A scanner that serves, a caller beside it, and a device with everything it publishes."""

    caller: Caller
    memory: holdfast.Memory
    device: holdfast.Server
    data: Inbox

    def reply(self, subject: str, payload: object) -> object:
        """Returns a reply, without the texts of errors."""
        found = self.caller.request(subject, payload)
        return {key: value for key, value in found.items() if key != "error"}

    def has_bucket(self, name: str) -> bool:
        try:
            self.caller.do(self.caller.client.jetstream().key_value(name))
        except NotFoundError:
            return False
        return True

    def registers(self, address: int, count: int) -> list[int]:
        return [int(value) for value in self.memory.read("holding_registers", address, count)]

    def variables(self, id: str, count: int) -> dict[str, object]:
        """Waits until the tag of so many devices has a value or an error; returns it by device."""
        found: dict[str, object] = {}

        def are_there() -> bool:
            listed = self.caller.request("modbus.variables", b"")
            for each in listed if isinstance(listed, list) else ():
                if each["variableId"] == id and (each["value"] is not None or "error" in each):
                    found[each["deviceId"]] = each["value"]
            return len(found) == count

        wire.until(are_there, f"{count} devices have {id}")
        return found

    def values(self, *ids: str) -> dict[str, object]:
        """Waits until each of these tags has been published, and returns the newest values."""
        found: dict[str, object] = {}
        while not set(ids) <= found.keys():
            message = self.data.next()
            found[message["variableId"]] = [message["value"], message["datatype"]]
        return found


@contextlib.contextmanager
def bench(command: Command, folder: Path, **environment: str) -> Iterator[Bench]:
    """Runs a scanner; `NATS` in the environment stands for the server's URL."""
    server = NatsServer(folder)
    try:
        resolved = {name: value.replace("NATS", server.url) for name, value in environment.items()}
        with (
            device() as (memory, device_server),
            Caller(server.url) as caller,
            command.running(folder, environment=resolved) as process,
        ):
            made = Bench(caller, memory, device_server, caller.listen("modbus.data.>"))
            wire.until(lambda: process.poll() is not None or _serves(caller), "it serves")
            assert process.poll() is None, (folder / "original.log").read_text()
            yield made
    finally:
        server.kill()


def _serves(caller: Caller) -> bool:
    try:
        caller.request("modbus.unsubscribe", NOBODY, seconds=5)
    except NoRespondersError:
        return False
    return True


NOBODY: dict[str, Any] = {"deviceId": "none", "subscriberId": "none", "tagIds": ["none"]}


@contextlib.contextmanager
def device() -> Iterator[tuple[holdfast.Memory, holdfast.Server]]:
    memory = holdfast.Memory(
        coils=1000, discrete_inputs=1000, holding_registers=1000, input_registers=1000
    )
    memory.write("holding_registers", 0, WORDS)
    memory.write("input_registers", 0, WORDS)
    memory.write("coils", 0, [True, False, True])
    memory.write("discrete_inputs", 0, [False, True])
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        yield memory, server
