"""Appliances that pass requests on to devices."""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING, Any

from holdfast import _core
from holdfast.client.endpoint import endpoint
from holdfast.client.url import parse
from holdfast.server.options import STREAM_DEFAULTS
from support import wire
from support.config_folder import written
from support.fake_device import registers
from support.lines import Cable
from support.transports import TYPES

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import holdfast
    from holdfast.appliance import Appliance
    from holdfast.server import Identity
    from holdfast.server.options import SerialOptions
    from support.fake_device import Asked

LOOPBACK = ["127.0.0.0/8"]


def configuration(
    url: str,
    *,
    kind: str = "tcp",
    link: dict[str, Any] | None = None,
    units: dict[int | str, Any] | None = None,
    rule: dict[str, Any] | None = None,
    listener: dict[str, Any] | None = None,
    **more: Any,
) -> str:
    """One listener, `scada`. By default all its unit ids, 0 to 247, are behind the link `bus`."""
    units = units or {"0-247": {"route": "bus"}}
    rules = [{"sources": LOOPBACK, "access": "read-write", "units": units, **(rule or {})}]
    scada = {"type": TYPES[kind], "bind": "127.0.0.1:0", "rules": rules, **(listener or {})}
    return written(
        {
            "listeners": {"scada": scada},
            "links": {"bus": {"url": url, "timeout": wire.DEADLINE, **(link or {})}},
            **more,
        }
    )


def serial_configuration(url: str, kind: str, device: Path, **more: Any) -> str:
    """One listener, `line`, on a serial line; all its unit ids are behind the link `bus`."""
    rules = [{"access": "read-write", "units": {"1-247": {"route": "bus"}}}]
    serial = {"device": str(device), "parity": "none"}
    return written(
        {
            "listeners": {"line": {"type": kind, "serial": serial, "rules": rules}},
            "links": {"bus": {"url": url, "timeout": wire.DEADLINE}},
            **more,
        }
    )


def counters(appliance: Appliance, link: str = "bus") -> dict[str, Any]:
    """Returns the counters of a link, and its `error`."""
    counted: dict[str, Any] = appliance.diagnostics.stats()["links"][link]
    return counted


def await_count(appliance: Appliance, counter: str, number: int, link: str = "bus") -> None:
    """Waits until a counter of a link has this number."""
    wire.until(lambda: counters(appliance, link)[counter] == number, f"{counter} is {number}")


class Held:
    """Answers only after `release`: correctly, or with registers of one value."""

    def __init__(self, value: int | None = None) -> None:
        self._value = value
        self._released = threading.Event()

    def __call__(self, asked: Asked) -> None:
        self._released.wait(wire.DEADLINE)
        asked.answer(None if self._value is None else registers(asked.pdu, self._value))

    def release(self) -> None:
        self._released.set()


@contextlib.contextmanager
def to_rtu_server(
    memory: holdfast.Memory, identity: Identity, folder: Path
) -> Iterator[tuple[str, int]]:
    """A Modbus TCP address whose unit 1 is an RTU server on a serial line, with this memory."""
    with contextlib.ExitStack() as stack:
        cable = stack.enter_context(Cable(folder))
        poller = _core.Poller([])
        stack.callback(poller.stop)
        target = parse(f"rtu://{cable.devices[1]}?parity=none&baud=4000000")
        route = poller.link(endpoint(target)).route("line", timeout=wire.DEADLINE)
        rules = [
            _core.Rule({unit: behind}, sources=LOOPBACK, access="read-write")
            for unit, behind in ((1, route), (1, memory))
        ]
        line: SerialOptions = {
            "mode": "rtu",
            "baud": 19200,
            "parity": "none",
            "stop_bits": 2,
            "data_bits": 8,
            "silence": None,
            "rs485": None,
            "event_log": False,
        }
        engine = _core.Engine(
            [
                _core.Listener("front", "127.0.0.1:0", rules[:1], STREAM_DEFAULTS),
                _core.Listener.serial(
                    "line",
                    str(cable.devices[0]),
                    rules[1],
                    line,
                ),
            ],
            identity=identity.objects(),
            unit_names=identity.names(),
            workers=1,
        )
        stack.callback(engine.stop)
        host, port = engine.addresses[0] or ("", 0)
        yield host, port
