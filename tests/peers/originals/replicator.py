"""The Modbus Replicator (Go): `HOLDFAST_ORIGINAL_REPLICATOR`.

The command gets the path of a configuration. The program has no licence, so nobody may pass it
on: it is compared only where somebody has it.

The inputs are devices that answer, refuse, stay silent or are not there; the answers are the
packets that reach the targets. Counters grow with each poll, so only the first registers of a
status block count.
"""

from __future__ import annotations

import contextlib
import socket
import socketserver
import struct
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.config.dump import to_yaml
from holdfast.importing import read_replicator
from peers.originals.comparison import Difference, Original, Reason, closed_port
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from peers.originals.comparison import Answers, Command

PAGE = "moving-from-mma.md"
UNIT = """\
    - id: "NAME"
      source: {endpoint: "127.0.0.1:DEVICE", unit_id: 1, timeout_ms: 300,
               device_name: NAME, status_slot: SLOT}
      reads: [READS]
      targets:
        - id: TARGET
          endpoint: "127.0.0.1:RECEIVER"
          status_unit_id: 100
          memories:
            - {memory_id: TARGET, offsets: {3: 1000}}
      poll: {interval_ms: 100}
"""
READS = {
    "good": "{fc: 1, address: 0, quantity: 9}, {fc: 2, address: 3, quantity: 4}, "
    "{fc: 3, address: 10, quantity: 3}, {fc: 4, address: 0, quantity: 125}",
    "refusing": "{fc: 3, address: 999, quantity: 2}",
    "half": "{fc: 3, address: 10, quantity: 2}, {fc: 4, address: 999, quantity: 2}",
    "silent": "{fc: 3, address: 0, quantity: 1}",
    "absent": "{fc: 3, address: 0, quantity: 1}",
}
"""Reads by the name of a device."""
LONG = 1
"""Seconds in error after which the answers are compared."""
ERRORS = ("refusing", "half", "silent", "absent")


class Receiver:
    """A memory appliance of the second generation, as far as the replicator sees it."""

    def __init__(self) -> None:
        self.written: dict[tuple[int, int, int], list[int]] = {}
        """The newest values by unit, area, address; a status block register by register."""
        outer = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                outer.receive(self.request)

        self.server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def receive(self, connection: socket.socket) -> None:
        file = connection.makefile("rb")
        with contextlib.suppress(OSError):
            while len(header := file.read(10)) == 10:
                _, _, area, unit, address, count = struct.unpack(">2sBBHHH", header)
                size = (count + 7) // 8 if area < 3 else 2 * count
                self.take(unit, area, address, count, file.read(size))
                connection.sendall(b"\0")

    def take(self, unit: int, area: int, address: int, count: int, payload: bytes) -> None:
        if area < 3:
            values = [payload[at // 8] >> at % 8 & 1 for at in range(count)]
        else:
            values = list(struct.unpack(f">{count}H", payload))
        if unit == STATUS:
            for at, value in enumerate(values):
                self.written[unit, area, address + at] = [value]
        else:
            self.written[unit, area, address] = values

    def block(self, name: str) -> list[int]:
        """Returns the first registers of a status block: health, error, seconds, the name."""
        start = 30 * SLOTS[name]
        return [self.written.get((STATUS, 3, start + at), [-1])[0] for at in range(20)]

    def is_in_error(self, name: str) -> bool:
        """Tells whether a status block counts seconds in error."""
        return self.block(name)[2] >= LONG

    def data(self, name: str) -> dict[str, list[int]]:
        target = TARGETS[name]
        return {
            f"area {area} from {address}": values
            for (unit, area, address), values in sorted(self.written.items())
            if unit == target
        }


STATUS = 100
SLOTS = {name: slot for slot, name in enumerate(READS)}
TARGETS = {name: slot + 1 for slot, name in enumerate(READS)}


@contextlib.contextmanager
def plant() -> Iterator[tuple[str, Receiver, holdfast.Memory]]:
    """Devices of each kind and a receiver; yields the replicator's configuration for them."""
    memory = holdfast.Memory(
        coils=1000, discrete_inputs=1000, holding_registers=1000, input_registers=1000
    )
    memory.write("coils", 0, [True, False, True, True])
    memory.write("discrete_inputs", 3, [True])
    memory.write("holding_registers", 10, [100, 200, 300])
    memory.write("input_registers", 0, list(range(125)))
    receiver = Receiver()
    with (
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only") as good,
        socket.create_server(("127.0.0.1", 0)) as silent,
        receiver.server,
        closed_port() as absent,
    ):
        ports = dict.fromkeys(READS, good.address[1])
        ports |= {"silent": silent.getsockname()[1], "absent": absent}
        text = "replicator:\n  units:\n" + "".join(
            UNIT.replace("NAME", name)
            .replace("DEVICE", str(ports[name]))
            .replace("SLOT", str(SLOTS[name]))
            .replace("READS", reads)
            .replace("TARGET", str(TARGETS[name]))
            .replace("RECEIVER", str(receiver.server.server_address[1]))
            for name, reads in READS.items()
        )
        yield text, receiver, memory
        receiver.server.shutdown()


def answers(receiver: Receiver, memory: holdfast.Memory) -> Answers:
    wire.until(lambda: receiver.block("good")[0] == 1, "the good device is read")
    wire.until(lambda: len(receiver.data("good")) == 4, "all its areas are there")
    found: Answers = {"good: values": receiver.data("good"), "good: status": receiver.block("good")}
    memory.write("holding_registers", 11, [7])
    changed = [100, 7, 300]
    wire.until(lambda: changed in receiver.data("good").values(), "a change is there")
    for name in ERRORS:
        wire.until(partial(receiver.is_in_error, name), f"{name} is in error")
        block = receiver.block(name)
        found[f"{name}: values"] = receiver.data(name)
        found[f"{name}: status"] = [block[0], block[1], "seconds", *block[3:]]
    return found


def theirs(command: Command, folder: Path) -> Answers:
    with plant() as (text, receiver, memory):
        (folder / "replicator.yaml").write_text(text)
        with command.running(folder, "replicator.yaml"):
            return answers(receiver, memory)


def ours(folder: Path) -> Answers:
    with plant() as (text, receiver, memory):
        (folder / "replicator.yaml").write_text(text)
        imported: dict[str, Any] = read_replicator(folder / "replicator.yaml").data
        (folder / "holdfast.yaml").write_text(to_yaml(imported))
        with Appliance(load(folder / "holdfast.yaml")):
            return answers(receiver, memory)


OTHERS = Reason(
    "other reads keep their values",
    PAGE,
    "If a read of a device fails, the others are written. The replicator writes none.",
)
ERROR = Reason(
    "the failure is named",
    PAGE,
    "exception codes, and 1 for other failures",
)
TIMEOUT, REFUSED = 0x8001, 0x8002


def _status(name: str, error: int) -> list[object]:
    """Returns the first registers of the status block of a device in error."""
    letters = struct.unpack(">8H", name.encode().ljust(16, b"\0"))
    return [2, error, "seconds", *letters, *[0] * 9]


DIFFERENCES = (
    Difference("half: values", {}, {"area 3 from 1010": [100, 7]}, OTHERS),
    Difference("silent: status", _status("silent", 1), _status("silent", TIMEOUT), ERROR),
    Difference("absent: status", _status("absent", 1), _status("absent", REFUSED), ERROR),
)
ORIGINAL = Original(
    name="Modbus Replicator",
    variable="HOLDFAST_ORIGINAL_REPLICATOR",
    differences=DIFFERENCES,
    theirs=theirs,
    ours=ours,
)
