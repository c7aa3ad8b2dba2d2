"""Rounds: clients of all faces at work on one appliance, and what they did and saw."""

from __future__ import annotations

import random
import threading
from collections import Counter
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from oracle import faces
from oracle.clients import CUTS, Client, Cuts, Publisher
from oracle.device import FATES, Fates, MirroredDevice
from oracle.disturbances import GUEST, Disturbances, Gate
from oracle.history import History, Ids, Operation, Outcome, Recorder
from oracle.layout import Block, Kind
from oracle.mqtt_face import MqttFace
from oracle.plant import BLOCKS, GATE, PARTS, Plant, layout
from oracle.requests import Request, is_passed
from oracle.workload import EVERYTHING, OWNERS, Draws, OwnerDraws
from support import wire
from support.brokers import Mosquitto
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from oracle.faces import Face

    Way = tuple[type[Face], str]

WAYS: list[Way] = [
    (faces.TcpFace, "scada"),
    (faces.TcpFace, "scada"),
    (faces.GuestFace, GUEST),
    (faces.UdpFace, "udp"),
    (faces.RtuFace, "rtu"),
    (faces.AsciiFace, "ascii"),
    (faces.TlsFace, "secure"),
    (faces.LibraryFace, "scada"),
    (faces.RestFace, "rest"),
    (faces.RestFace, "rest"),
    (faces.RawV1Face, "packets"),
    (faces.RawCrcFace, "checked"),
    (faces.PythonFace, ""),
]
"""The faces of the clients, and the listeners that they use."""

OWNER_WAYS: list[Way] = [(faces.TcpFace, "scada"), (faces.RtuFace, "rtu")]
GATE_WAYS: list[Way] = [
    (faces.RestFace, "rest"),
    (faces.RawV1Face, "packets"),
    (faces.RawCrcFace, "checked"),
]


@dataclass
class Round:
    """What has happened in a round."""

    history: History
    surprises: list[str]
    disturbances: list[str]
    by_face: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    """How requests ended; those that write into a mirror or a device are `passed`."""
    sights: int = 0
    """Values of blocks that were read, and are judged."""

    def __post_init__(self) -> None:
        for operation in self.history.operations:
            self.by_face[operation.face] += 1
            passed = "passed " * is_passed([write.block for write in operation.writes])
            self.ends[f"{passed}{operation.name} {operation.outcome.value}"] += 1
            if operation.readings:
                self.sights += sum(1 for _ in self.history.decoded(operation))


@contextmanager
def started(kind: type[Plant], folder: Path, seed: int, fates: Fates = FATES) -> Iterator[Oracle]:
    """A broker, a device and an appliance, until the end."""
    with ExitStack() as ending:
        # With small messages, each would wait for the acknowledgement of the one before.
        broker = Mosquitto(folder, "allow_anonymous true", "set_tcp_nodelay true")
        ending.callback(broker.kill)
        proxy = Proxy(broker.port)
        ending.callback(proxy.close)
        device = MirroredDevice(PARTS, f"{seed} device", fates)
        plant = kind(folder, device, proxy.url)
        ending.enter_context(plant.running())
        yield Oracle(plant, broker, proxy, seed)


class Oracle:
    """Runs rounds, one after another, on a running appliance."""

    def __init__(self, plant: Plant, broker: Mosquitto, proxy: Proxy, seed: int) -> None:
        self._plant = plant
        self._broker = broker
        self._proxy = proxy
        self._seed = seed
        self._number = 0
        self._ids = Ids(block for block in BLOCKS if block.kind in (Kind.SHARED, Kind.MIRRORED))
        self._held: dict[Block, int] = {}
        """What all blocks have between two rounds."""
        self._late: list[Operation] = []
        """Writes of the round before that may still come."""
        self._recorder = Recorder()
        self._over = threading.Event()

    def round(self, count: int, every: int, cuts: Cuts = CUTS) -> Round:
        """Lets each client send `count` requests; after so many operations, something happens."""
        self._number += 1
        self._recorder, self._over = Recorder(), threading.Event()
        self._plant.device.begin_round()
        ways = [self._client(*way) for way in GATE_WAYS]
        gate = Gate(ways, self._ids, self._chance("gate"), self._held.get(GATE, 0))
        clients, guests = self._clients(count, cuts)
        disturbances = Disturbances(
            *(self._plant, gate, self._proxy, self._ids, self._recorder),
            *(self._chance("disturbances"), every),
        )
        gate.open()
        threads = [*clients, *guests, disturbances]
        for thread in threads:
            thread.start()
        for client in clients:
            if not client.is_endless:
                client.join()
        self._over.set()
        disturbances.finish()
        disturbances.bring_guest()
        for client in [*clients, *guests]:
            client.join()
        for thread in threads:
            if thread.failure is not None:
                raise thread.failure
        gate.open()
        return self._end(gate, disturbances.done)

    def _chance(self, name: str) -> random.Random:
        """Random numbers that are the same ones for each seed, round and name."""
        return random.Random(f"{self._seed} {self._number} {name}")

    def _face(self, way: type[Face], listener: str) -> Face:
        if issubclass(way, faces.PythonFace):
            assert self._plant.memories is not None
            return way(self._plant.memories)
        if issubclass(way, faces.TlsFace):
            return way(lambda: self._plant.locate(listener), self._plant.trust)
        return way(lambda: self._plant.locate(listener))

    def _client(self, way: type[Face], listener: str) -> Client:
        """A client that is asked from outside."""
        face, chance = self._face(way, listener), self._chance("none")
        return Client(face, Draws(way, self._ids, chance), self._recorder, 0, chance)

    def _clients(self, count: int, cuts: Cuts) -> tuple[list[Client | Publisher], list[Client]]:
        clients: list[Client | Publisher] = []
        guests: list[Client] = []
        for number, (way, listener) in enumerate(WAYS):
            if way is faces.PythonFace and self._plant.memories is None:
                continue
            chance = self._chance(f"client {number}")
            source = Draws(way, self._ids, chance)
            # A program is much faster than all others, and would soon be at its end.
            until = self._over if way is faces.PythonFace else None
            face = self._face(way, listener)
            client = Client(face, source, self._recorder, count, chance, cuts, until)
            (guests if listener == GUEST else clients).append(client)
        for (way, listener), blocks in zip(OWNER_WAYS, OWNERS, strict=True):
            chance = self._chance(f"owner {listener}")
            face, owned = self._face(way, listener), OwnerDraws(blocks, chance)
            clients.append(Client(face, owned, self._recorder, count, chance))
        chance = self._chance("publisher")
        publisher = MqttFace(self._broker.port, self._number, self._recorder)
        source = Draws(faces.MqttTraits, self._ids, chance)
        clients.append(Publisher(publisher, source, self._recorder, count // 3, chance))
        return clients, guests

    def _end(self, gate: Gate, disturbances: list[str]) -> Round:
        """Reads all that there is, when nothing happens any more."""
        device, reader = self._plant.device, self._client(faces.RestFace, "rest")
        device.is_obedient = True
        recorded = self._recorder.operations
        held: dict[Block, int] = {}

        def is_settled() -> bool:
            start = len(recorded)
            for each in EVERYTHING:
                reader.ask(Request(reads=(each,)))
            seen = [sight for operation in recorded[start:] for sight in history.decoded(operation)]
            held.update((block, found) for block, found in seen if found is not None)
            return [held.get(part.mirror) for part in PARTS] == device.held()

        initial = dict(self._held)
        versions = {}
        for part, before, its in zip(PARTS, device.before, device.versions, strict=True):
            initial[part.device] = before
            versions.update({part.device: its, part.mirror: its})
        history = History(layout(), recorded, initial, versions)
        wire.until(is_settled, "the mirror has what the device has")
        reader.disconnect()
        device.is_obedient = False
        held[GATE] = gate.count
        history.operations = self._late + recorded
        self._carry_over(history, held)
        return Round(history, self._recorder.surprises, disturbances)

    def _carry_over(self, history: History, held: dict[Block, int]) -> None:
        """Keeps what the next round has to know."""
        seen = {
            sight
            for operation in history.operations
            if operation.readings
            for sight in history.decoded(operation)
        }
        self._late = [
            operation
            for operation in self._recorder.operations
            if operation.outcome is Outcome.UNKNOWN and not seen.intersection(operation.writes)
        ]
        self._held = held
        late = {(block, number) for each in self._late for block, number in each.writes}
        self._ids.taken = late | set(held.items())
