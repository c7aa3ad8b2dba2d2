"""The edge node: its messages in their order, without a connection."""

from __future__ import annotations

import itertools
import random
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.outputs.mqtt.delivery import Message, packed_topic
from holdfast.outputs.sparkplug.datatypes import BOOLEAN, INT64
from holdfast.outputs.sparkplug.definition import Payload
from holdfast.outputs.sparkplug.metrics import DeviceMetrics
from holdfast.polling.faults import is_exception

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from holdfast.outputs.sparkplug.metrics import Entry
    from holdfast.polling import Reading
    from holdfast.tags import Tag

    Latest = Callable[[], Mapping[str, Mapping[str, Reading]]]
    """The last reading of each tag of each device."""

REBIRTH = "Node Control/Rebirth"
MAX_FIRST_ALIAS = 2**27
"""The first alias is a random number up to this one, and each birth of a device has new aliases: a
command for an alias of an earlier birth must never reach another tag. Hosts of Eclipse Tahu also
request a rebirth if a device is born again with the same aliases.
"""

SEQUENCE_NUMBERS = 256
"""Sequence numbers begin again after 255."""


NAMESPACE = "spBv1.0"


class Names(NamedTuple):
    """The topics of an edge node."""

    group: str
    node: str

    def of(self, kind: str, device: str | None = None) -> str:
        """The topic of a type of message, such as `DDATA`."""
        topic = f"{NAMESPACE}/{self.group}/{kind}/{self.node}"
        return topic if device is None else f"{topic}/{device}"

    def device_of(self, topic: str) -> str | None:
        """The device that a DCMD topic names; `None` for other topics."""
        device = topic.removeprefix(self.of("DCMD") + "/")
        return None if device == topic or "/" in device else device


def state_topic(host: str) -> str:
    """The topic of the state of a host."""
    return f"{NAMESPACE}/STATE/{host}"


class EdgeNode:
    """What a host knows of this node and its devices. For one thread.

    Metrics have their types in births, and if `always_typed`, also in data. `next_number` is the
    number of the next reading that will wait for `data`: those before it are older than a birth.
    """

    def __init__(
        self, names: Names, next_number: Callable[[], int], *, always_typed: bool = False
    ) -> None:
        self._names, self._next_number = names, next_number
        self._always_typed = always_typed
        self._seq = 0
        self._session = -1
        self._aliases = itertools.count(random.SystemRandom().randrange(1, MAX_FIRST_ALIAS))
        self._devices: dict[str, DeviceMetrics] = {}
        self._alive: set[str] = set()
        self.unfit: list[Reading] = []
        """The readings that the last `data` left out: they are of an earlier form of their tag."""

    def begin(self) -> None:
        """Begins a session, before its CONNECT."""
        self._session = (self._session + 1) % SEQUENCE_NUMBERS
        self._alive.clear()

    def death(self) -> Message:
        """NDEATH: the will of the session, and its last message."""
        payload = Payload(timestamp=_now())
        self._add_session(payload)
        return Message(packed_topic(self._names.of("NDEATH")), payload.SerializeToString())

    def adopt(self, tags: Mapping[str, Sequence[Tag]]) -> None:
        """Takes over the tags, before births."""
        # A device may be removed at this moment: the next births are without it.
        self._devices = {
            device: DeviceMetrics(device, some, always_typed=self._always_typed)
            for device, some in tags.items()
        }

    def find(self, device: str, name: str, alias: int | None) -> Entry | None:
        """The metric with an alias, or with a name. Thread-safe."""
        metrics = self._devices.get(device)
        if metrics is None:
            return None
        return metrics.by_name.get(name) if alias is None else metrics.by_alias.get(alias)

    def births(
        self,
        answering: Mapping[str, bool],
        latest: Latest,
    ) -> list[Message]:
        """NBIRTH, and DBIRTH of each device that answers; DDEATH first for those that are gone."""
        gone = [device for device in self._alive if not answering.get(device)]
        messages = [self._ddeath(device) for device in sorted(gone)]
        self._seq, self._alive = 0, set()
        payload = Payload(timestamp=_now(), seq=self._next())
        self._add_session(payload)
        payload.metrics.add(name=REBIRTH, timestamp=_now(), datatype=BOOLEAN, boolean_value=False)
        messages.append(
            Message(packed_topic(self._names.of("NBIRTH")), payload.SerializeToString())
        )
        return [*messages, *self.device_births(answering, latest)]

    def device_births(
        self,
        answering: Mapping[str, bool],
        latest: Latest,
    ) -> list[Message]:
        """DBIRTH of devices that have begun to answer."""
        new = [
            device
            for device in self._devices
            if answering.get(device) and device not in self._alive
        ]
        return self._dbirths(new, latest) if new else []

    def _dbirths(self, devices: Iterable[str], latest: Latest) -> list[Message]:
        number, known = self._next_number(), latest()  # In this order, see `DeviceMetrics.birth`.
        return [self._dbirth(device, known.get(device, {}), number) for device in devices]

    def device_deaths(
        self, answering: Mapping[str, bool], readings: Iterable[Reading] = ()
    ) -> list[Message]:
        """DDEATH of devices that do not answer any more, and of which there are no more values
        to send: values that had to wait may belong to a time when the device did answer.
        """
        kept = {reading.device for reading in readings if not _is_silent(reading)}
        gone = [device for device in self._alive - kept if not answering.get(device)]
        return [self._ddeath(device) for device in sorted(gone)]

    def data(
        self,
        readings: Iterable[Reading],
        latest: Latest,
        first_number: int,
    ) -> Iterator[Message]:
        """DDATA of readings. A device that does not answer is born for values that had to wait.

        `first_number` is the number of the first reading.
        """
        self.unfit = []
        open_payloads: dict[str, tuple[Any, set[str]]] = {}
        for number, reading in enumerate(readings, first_number):
            device = self._devices.get(reading.device)
            if device is None or _is_silent(reading):
                continue
            if device.device not in self._alive:
                yield from self._dbirths([device.device], latest)
            if device.is_known(reading, number):
                continue
            payload, names = open_payloads.get(device.device) or (Payload(), set())
            if reading.tag.name in names:
                yield self._ddata(device.device, payload)
                payload, names = Payload(), set()
            open_payloads[device.device] = payload, names
            if device.add(payload, reading, number):
                names.add(reading.tag.name)
            else:
                self.unfit.append(reading)
        for name, (payload, _) in open_payloads.items():
            if payload.metrics:
                yield self._ddata(name, payload)

    def _dbirth(self, device: str, latest: Mapping[str, Reading], number: int) -> Message:
        self._alive.add(device)
        payload = Payload(timestamp=_now(), seq=self._next())
        self._devices[device].birth(payload, latest, self._aliases, number)
        return self._message("DBIRTH", device, payload)

    def _ddata(self, device: str, payload: Any) -> Message:
        payload.timestamp, payload.seq = _now(), self._next()
        return self._message("DDATA", device, payload)

    def _ddeath(self, device: str) -> Message:
        self._alive.discard(device)
        return self._message("DDEATH", device, Payload(timestamp=_now(), seq=self._next()))

    def _message(self, kind: str, device: str, payload: Any) -> Message:
        topic = packed_topic(self._names.of(kind, device))
        return Message(topic, payload.SerializeToString())

    def _add_session(self, payload: Any) -> None:
        payload.metrics.add(
            name="bdSeq", timestamp=_now(), datatype=INT64, long_value=self._session
        )

    def _next(self) -> int:
        seq, self._seq = self._seq, (self._seq + 1) % SEQUENCE_NUMBERS
        return seq


def _is_silent(reading: Reading) -> bool:
    """Whether the device did not answer."""
    return reading.fault != 0 and not is_exception(reading.fault)


def _now() -> int:
    return int(time.time() * 1000)
