"""Devices, an appliance with an MQTT output, and a client of the broker."""

from __future__ import annotations

import json
import queue
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import holdfast
from holdfast.appliance import Appliance
from support import wire
from support.brokers import Mosquitto
from support.config_folder import Folder, written
from support.mqtt_rig import Message, Probe
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from holdfast.config import Config

TAGS: dict[str, Any] = {
    "temperature": {
        "area": "holding_registers",
        "address": 0,
        "type": "int16",
        "scale": 0.1,
        "unit": "°C",
        "writable": True,
        "min": 5,
        "max": 30,
    },
    "state": {
        "area": "holding_registers",
        "address": 1,
        "states": {0: "off", 1: "running"},
        "writable": True,
    },
    "flow": {"area": "input_registers", "address": 0, "type": "float32", "null": ["nan"]},
    "valve": {"area": "coils", "address": 0, "writable": True},
}


class Device:
    """A Modbus device. It can stop answering."""

    def __init__(self, registers: int = 100) -> None:
        self.memory = holdfast.Memory(
            holding_registers=registers, input_registers=100, coils=100, discrete_inputs=100
        )
        self._server: holdfast.Server | None = None
        self._address = "127.0.0.1:0"
        self.start()

    def start(self) -> None:
        self._server = holdfast.Server({1: self.memory}, bind=self._address, access="read-write")
        self._server.start()
        host, port = self._server.address
        self._address = f"{host}:{port}"
        self.url = f"tcp://{self._address}"

    def stop(self) -> None:
        if self._server is not None:
            self._server.stop()
            self._server = None

    def set(self, value: int, address: int = 0, count: int = 1) -> None:
        self.memory.write("holding_registers", address, [value] * count)


class Plant:
    """A broker, devices and an appliance, until the end of a test."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self._running = ExitStack()
        self.broker = Mosquitto(folder, *options)
        self._running.callback(self.broker.kill)
        self.url = self.broker.url
        self.interval = 0.05
        self.devices: dict[str, Device] = {}
        self.appliance: Appliance | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.appliance is not None:
            self.appliance.stop()
        self._running.close()

    def device(self, name: str = "pump", registers: int = 100) -> Device:
        self.devices[name] = made = Device(registers)
        self._running.callback(made.stop)
        return made

    def slow_device(self, name: str = "pump") -> Proxy:
        """The way to a device, which can hold back requests and replies."""
        device = self.device(name)
        made = Proxy(int(device.url.rpartition(":")[2]), "tcp")
        device.url = made.url
        self._running.callback(made.close)
        return made

    def proxy(self) -> Proxy:
        """A way to the broker that can be closed, for the appliance."""
        made = Proxy(self.broker.port)
        self._running.callback(made.close)
        self.url = made.url
        return made

    def config(
        self, output: dict[str, Any], tags: dict[str, Any] | None = None, **more: Any
    ) -> Config:
        """The configuration of an appliance that polls all devices."""
        devices = {
            name: {
                "url": device.url,
                "interval": self.interval,
                "timeout": wire.DEADLINE,
                "retry": {"first": 0.05, "most": 0.1},
                "tags": TAGS if tags is None else tags,
            }
            for name, device in self.devices.items()
        }
        outputs = {"home": {"type": "mqtt", "url": self.url} | output}
        return Folder(self.folder).config(written({"devices": devices, "outputs": outputs} | more))

    def run(self, tags: dict[str, Any] | None = None, **output: Any) -> Appliance:
        """Starts an appliance."""
        self.appliance = Appliance(self.config(output, tags)).start()
        return self.appliance

    def stop(self) -> None:
        assert self.appliance is not None
        self.appliance.stop()
        self.appliance = None

    def status(self) -> dict[str, Any]:
        assert self.appliance is not None
        found = self.appliance.diagnostics.adapter("output/home")
        assert found is not None
        return found

    def count(self, outcome: str) -> int:
        """The readings with an outcome: sent, refused or dropped."""
        return int(self.status().get("readings", {}).get(outcome, 0))

    def has_waiting(self, least: int) -> bool:
        """Whether at least so many values wait."""
        return bool(self.status().get("waiting", 0) >= least)

    def probe(self, *topics: str) -> Client:
        """A client that has subscribed to these topics."""
        made = self._running.enter_context(Client(self.broker.port))
        for topic in topics:
            made.subscribe(topic)
        return made


class Client(Probe):
    """A client of the broker that looks for messages."""

    def until(self, topic: str, payload: str) -> list[Message]:
        """The messages up to one with this topic and payload."""
        seen: list[Message] = []
        while True:
            try:
                message = self.messages.get(timeout=wire.DEADLINE)
            except queue.Empty:
                raise AssertionError(f"no {topic} {payload!r}, but {seen}") from None
            seen.append(message)
            if message.topic == topic and message.payload.decode() == payload:
                return seen

    def next_of(self, topic: str) -> Message:
        """The next message of this topic."""
        while True:
            message = self.get()
            if message.topic == topic:
                return message

    def json(self, topic: str) -> Any:
        return json.loads(self.next_of(topic).payload)


def texts(messages: list[Message], topic: str) -> list[str]:
    """The payloads of one topic."""
    return [message.payload.decode() for message in messages if message.topic == topic]
