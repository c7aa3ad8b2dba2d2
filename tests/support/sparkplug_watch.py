"""A client that decodes the messages of Sparkplug edge nodes, and sends them commands."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from holdfast.outputs.sparkplug.definition import Payload, parsed
from support import wire

if TYPE_CHECKING:
    from support.mqtt_plant import Client

GROUP, NODE = "plant", "edge"
SETTINGS: dict[str, Any] = {"type": "sparkplug", "group": GROUP, "edge_node": NODE}


class Said(NamedTuple):
    """A message of an edge node."""

    kind: str
    device: str | None
    payload: Any
    qos: int
    retain: bool

    @property
    def metrics(self) -> dict[str, Any]:
        """The metrics by name."""
        return {metric.name: metric for metric in self.payload.metrics}

    def aliased(self, alias: int) -> list[Any]:
        """The metrics with this alias."""
        return [metric for metric in self.payload.metrics if metric.alias == alias]


Wanted: TypeAlias = Callable[[Said], bool]


class Watch:
    """What the edge node has sent, in its order."""

    def __init__(self, client: Client, node: str = NODE) -> None:
        self._client, self._node = client, node
        self.said: list[Said] = []

    def next(self) -> Said:
        """The next message of the node."""
        while True:
            try:
                message = self._client.messages.get(timeout=wire.DEADLINE)
            except queue.Empty:
                seen = [(each.kind, each.device) for each in self.said]
                raise AssertionError(f"no more messages after {seen}") from None
            parts = message.topic.split("/")
            if len(parts) < 4 or parts[2] in ("NCMD", "DCMD") or parts[3] != self._node:
                continue
            device = parts[4] if len(parts) == 5 else None
            said = Said(parts[2], device, parsed(message.payload), message.qos, message.retain)
            self.said.append(said)
            return said

    def until(self, kind: str, device: str | None = None, wanted: Wanted | None = None) -> Said:
        """The next message of this kind."""
        while True:
            said = self.next()
            if (said.kind, said.device) == (kind, device) and (wanted is None or wanted(said)):
                return said

    def until_value(self, birth: Said, name: str, value: Any, field: str) -> Said:
        """The next DDATA with this value of a metric."""
        alias = birth.metrics[name].alias

        def has_value(said: Said) -> bool:
            return any(
                metric.alias == alias and getattr(metric, field) == value
                for metric in said.payload.metrics
            )

        return self.until("DDATA", birth.device, has_value)

    def births(self) -> set[str | None]:
        """The devices that were born."""
        return {said.device for said in self.said if said.kind == "DBIRTH"}

    def command(self, device: str | None, retain: bool = False, **metric: Any) -> None:
        """Sends an NCMD or DCMD with one metric."""
        payload = Payload(timestamp=int(time.time() * 1000))
        payload.metrics.add(**metric)
        self.raw_command(device, payload.SerializeToString(), retain=retain)

    def raw_command(self, device: str | None, payload: bytes, *, retain: bool = False) -> None:
        kind = "NCMD" if device is None else "DCMD"
        topic = f"spBv1.0/{GROUP}/{kind}/{self._node}"
        if device is not None:
            topic = f"{topic}/{device}"
        self._client.publish(topic, payload, retain=retain)

    def host(self, name: str, timestamp: int, *, online: bool) -> None:
        """Publishes the state of a host."""
        state = json.dumps({"online": online, "timestamp": timestamp})
        self._client.publish(f"spBv1.0/STATE/{name}", state, retain=True)

    def sequence(self) -> list[int]:
        """The sequence numbers since the last NBIRTH."""
        numbers: list[int] = []
        for said in self.said:
            if said.kind == "NBIRTH":
                numbers.clear()
            if said.kind != "NDEATH":
                numbers.append(said.payload.seq)
        return numbers
