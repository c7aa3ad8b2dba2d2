"""The names of Sparkplug topics."""

from __future__ import annotations

from typing import NamedTuple

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
