"""MQTT in tests: a client, a proxy to a broker, and running adapters.

Everything stays on the loopback interface, and a `Rig` stops everything that it started.
"""

from __future__ import annotations

import json
import queue
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

import holdfast
from holdfast.adapters import Stop
from holdfast.adapters.mqtt import Mqtt
from holdfast.config.models.services import MqttConfig
from holdfast.ingest import MemoryAccess
from support import wire
from support.brokers import Mosquitto
from support.running import content
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Mapping, Set
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from holdfast.config.models.root import MappedTag
    from holdfast.types import Area


PAUSE_S = 0.01
"""The pause between attempts to connect."""


class Message(NamedTuple):
    topic: str
    payload: bytes
    properties: Properties | None
    qos: int = 0
    retain: bool = False


class Probe:
    """A client beside the adapter that publishes and subscribes."""

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self.messages: queue.Queue[Message] = queue.Queue()
        self._subscribed = threading.Event()
        self._client = Client(
            CallbackAPIVersion.VERSION2,
            protocol=MQTTProtocolVersion.MQTTv5,
            client_id="",
            reconnect_on_failure=False,
        )
        self._client.on_message = lambda _client, _data, message: self.messages.put(
            Message(
                message.topic,
                bytes(message.payload),
                message.properties,
                message.qos,
                message.retain,
            )
        )
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.connect(host, port)
        self._client.loop_start()
        wire.until(self._client.is_connected, "the probe is connected")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def subscribe(self, topic: str, qos: int = 1) -> None:
        self._subscribed.clear()
        self._client.subscribe(topic, qos)
        assert self._subscribed.wait(wire.DEADLINE)

    def publish(
        self,
        topic: str,
        payload: str | bytes,
        qos: int = 1,
        *,
        retain: bool = False,
        **properties: Any,
    ) -> None:
        """Publishes a message and waits until the broker has it."""
        packed = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        for name, value in properties.items():
            setattr(packed, name, value)
        info = self._client.publish(topic, payload, qos, retain, packed)
        info.wait_for_publish(wire.DEADLINE)
        assert info.is_published()

    def get(self) -> Message:
        return self.messages.get(timeout=wire.DEADLINE)


def subscription(topic: str = "plant/ingest", qos: int = 1, **more: Any) -> dict[str, Any]:
    """Builds an entry of `subscriptions`."""
    areas = ["holding_registers", "coils"]
    return {"topic": topic, "qos": qos, "memories": ["plant"], "areas": areas} | more


def settings(url: str, *subscriptions: dict[str, Any], **more: Any) -> MqttConfig:
    """Builds the configuration of an adapter; by default with one subscription."""
    entries = list(subscriptions) or [subscription()]
    fields = {"url": url, "client_id": "holdfast-test", "subscriptions": entries} | more
    return MqttConfig.model_validate(fields)


def command(values: list[Any], address: int = 0, **more: Any) -> dict[str, Any]:
    """Builds a command for holding registers of `plant`; `more` overrides fields."""
    plain = {"memory": "plant", "area": "holding_registers", "address": address, "values": values}
    return plain | more


def text(*commands: dict[str, Any]) -> str:
    """Encodes one command as JSON, or several as a batch."""
    return json.dumps(commands[0] if len(commands) == 1 else commands)


class Running:
    """An adapter in a thread, until the test ends."""

    def __init__(
        self,
        config: MqttConfig,
        memory_access: MemoryAccess,
        mapped: Mapping[str, MappedTag] | None = None,
        first_pause: float = PAUSE_S,
        restored: Set[str] = frozenset(),
    ) -> None:
        pauses = {"first_pause": first_pause, "max_pause": max(first_pause, PAUSE_S)}
        self.adapter = Mqtt(config, memory_access, mapped, restored, **pauses)
        self.memory_access = memory_access
        self._stop = Stop()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mqtt under test")
        self._thread.start()

    def _run(self) -> None:
        try:
            self.adapter.run(self._stop)
        except BaseException as error:
            self._failure = error
            raise

    def status(self) -> dict[str, Any]:
        return self.adapter.status()

    def tell_to_stop(self) -> None:
        self._stop.set()

    def stop(self, seconds: float = wire.DEADLINE) -> None:
        """Stops the adapter within `seconds`. It must not have failed."""
        self._stop.set()
        self._thread.join(seconds)
        assert not self._thread.is_alive(), f"does not end within {seconds} s"
        assert self._failure is None

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def wait_until_connected(self) -> None:
        """Waits until it is connected and each subscription is acknowledged."""
        wire.until(self._ready, "connected")

    def _ready(self) -> bool:
        status = self.status()
        return status["connected"] and all(
            topic["granted"] is not None for topic in status["topics"]
        )

    def wait_until_received(self, count: int) -> None:
        """Waits until `count` messages were accepted or refused."""
        wire.until(lambda: handled(self.memory_access) >= count, f"{count} messages")


def handled(memory_access: MemoryAccess) -> int:
    """Returns the number of messages that were accepted or refused."""
    counts: Any = memory_access.counts()
    return int(counts["accepted"] + sum(counts["refused"].values()))


class Rig:
    """Two memories with memory access, and everything that a test starts."""

    def __init__(self, folder: Path) -> None:
        self.memory = _memory()
        self.other = _memory()
        self.memory_access = MemoryAccess("mqtt", {"plant": self.memory, "other": self.other})
        self._folder = folder
        self._running = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._running.close()

    def broker(self, *options: str, host: str = "127.0.0.1") -> Mosquitto:
        """Starts Mosquitto with these configuration lines; default: allows anonymous clients."""
        started = Mosquitto(self._folder, *options, host=host)
        self._running.callback(started.kill)
        return started

    def run(
        self,
        config: MqttConfig,
        memory_access: MemoryAccess | None = None,
        mapped: Mapping[str, MappedTag] | None = None,
        first_pause: float = PAUSE_S,
        restored: Set[str] = frozenset(),
    ) -> Running:
        """Starts an adapter without waiting for its connection."""
        access = memory_access or self.memory_access
        running = Running(config, access, mapped, first_pause, restored)
        self._running.callback(running.stop)
        return running

    def connected(self, broker: Mosquitto, *subscriptions: dict[str, Any], **more: Any) -> Running:
        """Starts an adapter and waits until it is connected."""
        running = self.run(settings(broker.url, *subscriptions, **more))
        running.wait_until_connected()
        return running

    def proxy(self, broker: Mosquitto) -> Proxy:
        """Starts a proxy to the broker."""
        proxy = Proxy(broker.port)
        self._running.callback(proxy.close)
        return proxy

    def probe(self, broker: Mosquitto) -> Probe:
        return self._running.enter_context(Probe(broker.port, broker.host))

    def registers(self, address: int, count: int) -> list[int]:
        """Reads holding registers of `plant`."""
        return self.memory.read("holding_registers", address, count)

    def all_content(self) -> list[dict[Area, list[int]]]:
        """Returns the content of both memories."""
        return [content(self.memory), content(self.other)]


def _memory() -> holdfast.Memory:
    return holdfast.Memory(
        coils=1000, discrete_inputs=1000, holding_registers=1000, input_registers=1000
    )
