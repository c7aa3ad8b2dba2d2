"""The appliance that is judged, with every way in: a part of this process, or one of its own."""

from __future__ import annotations

import contextlib
import copy
import signal
import threading
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.types import AREAS
from oracle.device import MirroredDevice, Part
from oracle.faces import MEMORY_ID, UNITS
from oracle.layout import Block, Form, Kind, Layout
from oracle.mqtt_face import QOS, TOPIC
from support.brokers import free_port
from support.certificates import Certificates
from support.cli import RunCommand, answer, invoke
from support.config_folder import written
from support.tls_peer import context

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    import holdfast
    from holdfast.types import Area

Settings = dict[str, Any]

ATTEMPTS = 5
"""To start and to reload."""

PLANT, ANNEX, DEVICE = "plant", "annex", "device"
MIRROR_AT = 200
"""The first mirrored coil and the first mirrored register of the memory."""
DEVICE_AT = 1000
"""The same of the device."""
MIRRORED_COILS = 32
MIRRORED_REGISTERS = 27
MAX_REGISTERS = (9, 125)
"""The largest request to the device. With 9, a poll takes several, which have whole blocks."""

GATE = Block("gate", PLANT, "discrete_inputs", 0, 1, Kind.GATE)


def _shared(memory: str, area: Area, *places: tuple[str, int, int]) -> list[Block]:
    return [Block(name, memory, area, address, count) for name, address, count in places]


def _parts() -> list[Part]:
    """What the device has, and where it is read into."""
    registers: list[tuple[Area, str, int, int]] = [
        ("holding_registers", "mr1", 0, 1),
        ("holding_registers", "mr8", 1, 8),
        ("holding_registers", "mr9", 9, 9),
        ("holding_registers", "mr9 next", 18, 9),
        ("coils", "mc32", 0, 32),
    ]
    return [
        Part(
            Block(f"device {name}", DEVICE, area, DEVICE_AT + at, count, Kind.DEVICE),
            Block(name, PLANT, area, MIRROR_AT + at, count, Kind.MIRRORED),
        )
        for area, name, at, count in registers
    ]


PARTS = _parts()

FLAGS = [Block(f"flag {at}", PLANT, "coils", at, 1, Kind.OWNED, Form.PLAIN) for at in (83, 84)]
BYTES = [
    Block("low byte", PLANT, "holding_registers", 72, 1, Kind.OWNED, Form.LOW_BYTE),
    Block("high byte", PLANT, "holding_registers", 72, 1, Kind.OWNED, Form.HIGH_BYTE),
]
BLOCKS = [
    GATE,
    *FLAGS,
    *BYTES,
    *_shared(PLANT, "holding_registers", ("h1", 0, 1), ("h2", 1, 2), ("h8", 3, 8), ("h61", 11, 61)),
    # Both begin within a byte that they share with their neighbours.
    *_shared(PLANT, "coils", ("c32", 3, 32), ("c48", 35, 48)),
    *_shared(PLANT, "discrete_inputs", ("d32", 5, 32)),
    *_shared(PLANT, "input_registers", ("i2", 0, 2), ("i30", 2, 30), ("i300", 40, 300)),
    *_shared(ANNEX, "holding_registers", ("a1", 0, 1), ("a10", 1, 10)),
    *_shared(ANNEX, "input_registers", ("ai4", 0, 4)),
    *(part.mirror for part in PARTS),
    *(part.device for part in PARTS),
]

NAMED = {block.name: block for block in BLOCKS}


def layout() -> Layout:
    return Layout(BLOCKS)


class Plant(ABC):
    """A running appliance, its device, and its configuration, which a run changes."""

    def __init__(self, folder: Path, device: MirroredDevice, broker_url: str) -> None:
        self.folder = folder
        self.file = folder / "oracle.yaml"
        self.device = device
        authority = Certificates(folder)
        server = authority.issue("server", "DNS:localhost,IP:127.0.0.1")
        client = authority.issue("client", "DNS:c", extensions=("extendedKeyUsage=clientAuth",))
        self.trust = context(authority.ca, client)
        self._tls = {
            "cert_file": str(server.certificate),
            "key_file": str(server.key),
            "ca_file": str(authority.ca),
        }
        self._broker_url = broker_url
        self._ports: set[int] = set()
        self._lock = threading.Lock()
        self.settings: Settings = {}

    @abstractmethod
    def _start(self) -> None:
        """Runs until `stop`. Raises `OSError` if it can't."""

    @abstractmethod
    def stop(self) -> None:
        """Ends it."""

    @abstractmethod
    def sessions(self) -> list[dict[str, Any]]:
        """The open connections."""

    @abstractmethod
    def end_session(self, listener: str, number: int) -> None:
        """Ends a connection, if it is still there."""

    @abstractmethod
    def _reload(self) -> None:
        """Has the appliance read the file again. Raises `OSError` if it can't take it over."""

    memories: Mapping[str, holdfast.Memory] | None = None
    """The memories, if they are in this process."""

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        with self.device:
            self._retry(self._begin)
            try:
                yield
            finally:
                self.stop()

    def change(self, edit: Callable[[Settings], object]) -> None:
        """Changes the configuration, and reloads it."""

        def reload() -> None:
            changed = copy.deepcopy(self.settings)
            edit(changed)
            self._write(changed)
            self._reload()
            self.settings = changed

        with self._lock:
            self._retry(reload)

    def _begin(self) -> None:
        self.settings = self._first(self._broker_url)
        self._write(self.settings)
        self._start()

    @staticmethod
    def _retry(attempt: Callable[[], None]) -> None:
        """Another program may have taken a port: each attempt has others."""
        for _ in range(ATTEMPTS - 1):
            with contextlib.suppress(OSError):
                return attempt()
        return attempt()

    def locate(self, name: str) -> tuple[str, int]:
        """Where a listener or REST is. Raises `ConnectionRefusedError` if there is none."""
        settings = self.settings
        part = settings["rest"] if name == "rest" else settings["listeners"].get(name)
        if part is None:
            raise ConnectionRefusedError(f"no listener {name}")
        host, port = part["bind"].split(":")
        return host, int(port)

    def _write(self, settings: Settings) -> None:
        self.file.write_text(written(settings))

    def listener(self, kind: str, **more: Any) -> Settings:
        rule = {
            "sources": ["127.0.0.0/8"],
            "units": {
                UNITS[PLANT]: PLANT,
                UNITS[ANNEX]: ANNEX,
                UNITS[DEVICE]: {"route": "drive"},
            },
            "access": "read-write",
        }
        # All clients have one address, and may take all places.
        limits = {} if kind == "modbus-udp" else {"max_connections_per_source": None}
        rules: Settings = {"rules": [rule]}
        return {"type": kind, "bind": self._bind(), **rules, **limits, **more}

    def _packets(self, **more: Any) -> Settings:
        rule = {"sources": ["127.0.0.0/8"], "areas": list(AREAS)}
        kind = {"type": "raw-ingest", "bind": self._bind(), "max_connections_per_source": None}
        target: Settings = {"units": {UNITS[PLANT]: PLANT, UNITS[ANNEX]: ANNEX}}
        if more.get("format") == "crc":
            target = {"memories": [PLANT]}
        return {**kind, "rules": [{**rule, **target}], **more}

    def _bind(self) -> str:
        """An address that stays the same when a service starts again."""
        port = free_port()
        while port in self._ports:
            port = free_port()
        self._ports.add(port)
        return f"127.0.0.1:{port}"

    def _first(self, broker_url: str) -> Settings:
        listeners = {
            "scada": self.listener("modbus-tcp"),
            "udp": self.listener("modbus-udp"),
            "rtu": self.listener("modbus-rtu-over-tcp"),
            "ascii": self.listener("modbus-ascii-over-tcp"),
            "secure": self.listener("modbus-tls", tls=self._tls),
            "packets": self._packets(),
            "checked": self._packets(format="crc", compat={"packets": "many"}),
        }
        subscription = {"topic": TOPIC, "qos": QOS, "memories": [PLANT, ANNEX]}
        return {
            "memories": _memories(),
            "listeners": listeners,
            "devices": {"drive": self._drive()},
            "rest": {"bind": self._bind(), "sources": ["127.0.0.0/8"], "tokens": "none"},
            "mqtt": {
                "url": broker_url,
                "client_id": "oracle",
                "subscriptions": [{**subscription, "areas": list(AREAS)}],
            },
            "workers": 3,
            "log": {"level": "error"},
        }

    def _drive(self) -> Settings:
        return {
            "url": self.device.url,
            "unit": 1,
            "interval": 0.02,
            "timeout": 0.25,
            "retry": {"first": 0.05, "most": 0.2},
            "writes": "pass",
            "max_registers": MAX_REGISTERS[0],
            "reads": [
                _read("holding_registers", MIRRORED_REGISTERS),
                _read("coils", MIRRORED_COILS),
            ],
        }


def _read(area: Area, count: int) -> Settings:
    into = {"memory": PLANT, "area": area, "address": MIRROR_AT}
    return {"area": area, "address": DEVICE_AT, "count": count, "into": into}


def _memories() -> Settings:
    seal = {"area": GATE.area, "address": GATE.address, "mode": "level"}
    areas = {"coils": 300, "discrete_inputs": 64, "holding_registers": 300, "input_registers": 400}
    return {
        PLANT: {**areas, "id": MEMORY_ID, "seal": seal},
        ANNEX: {"holding_registers": 32, "input_registers": 32},
    }


class InProcess(Plant):
    """The appliance as a part of this process, as programs embed it."""

    appliance: Appliance

    def _start(self) -> None:
        self.appliance = Appliance(load(self.file), retries_ports=False).start()
        self.memories = self.appliance.memories

    def stop(self) -> None:
        self.appliance.stop()

    def sessions(self) -> list[dict[str, Any]]:
        return self.appliance.sessions()

    def end_session(self, listener: str, number: int) -> None:
        self.appliance.end_session(listener, number, {"token": "oracle"})

    def _reload(self) -> None:
        self.appliance.reload(load(self.file))


class OwnProcess(Plant):
    """`holdfast run`."""

    _command: RunCommand

    def _start(self) -> None:
        self._command = RunCommand(self.file)
        try:
            self._command.wait_for_greeting()
        except AssertionError as error:
            raise OSError(str(error)) from None

    def stop(self) -> None:
        code, log = self._command.end(signal.SIGTERM)
        assert code == 0, log

    def sessions(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = answer("sessions", str(self.file))["sessions"]
        return found

    def end_session(self, listener: str, number: int) -> None:
        invoke("sessions", str(self.file), "--end", f"{listener}/{number}")

    def _reload(self) -> None:
        result = invoke("reload", str(self.file))
        if result.exit_code != 0:
            raise OSError(result.output)
