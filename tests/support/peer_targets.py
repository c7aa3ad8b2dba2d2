"""What the tour of peers is addressed to: a listener itself, or a route to an RTU device.

`WAYS` is the one place where another way to the same memory is added, for some or all schemes of
URLs.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from holdfast.appliance import Appliance
from holdfast.config import load
from support import peer_tour, transports
from support.config_folder import written
from support.lines import Cable
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path
    from typing import Any

    import holdfast

LINES = {"rtu": "modbus-rtu", "ascii": "modbus-ascii"}
LISTENERS = {
    "tcp": transports.TYPES["tcp"],
    "udp": transports.TYPES["udp"],
    "rtu+tcp": transports.TYPES["rtu"],
    "rtu+udp": transports.TYPES["rtu-udp"],
    "ascii+tcp": transports.TYPES["ascii"],
} | LINES
"""The listener types by the schemes of URLs."""


@dataclass(frozen=True)
class Target:
    """An address for clients, and the memory that they reach."""

    url: str
    memory: holdfast.Memory
    unit: int = peer_tour.UNIT


class Opening(Protocol):
    """Opens a way to a memory that the tour has filled, for one scheme of URLs."""

    def __call__(
        self, scheme: str, folder: Path, access: str
    ) -> AbstractContextManager[Target]: ...


@dataclass(frozen=True)
class Way:
    """A way to a memory."""

    open: Opening
    schemes: Collection[str]
    """The schemes that clients can use."""


@contextlib.contextmanager
def direct(scheme: str, folder: Path, access: str) -> Iterator[Target]:
    """A listener of the scheme's type."""
    with contextlib.ExitStack() as stack:
        cable = stack.enter_context(Cable(folder)) if scheme in LINES else None
        file = folder / "appliance.yaml"
        file.write_text(listening(scheme, cable, access))
        appliance = stack.enter_context(Appliance(load(file)))
        memory = appliance.memories["plant"]
        peer_tour.filled(memory)
        if cable is not None:
            yield Target(f"{scheme}://{cable.devices[1]}", memory)
        else:
            host, port = endpoint(appliance, "scada")
            yield Target(f"{scheme}://{host}:{port}", memory)


@contextlib.contextmanager
def routed(scheme: str, folder: Path, access: str) -> Iterator[Target]:
    """A listener of the scheme's type whose unit is an RTU device on a serial line."""
    with Cable(folder) as cable:
        rule = {"sources": ["127.0.0.1"], "access": access}
        route = {"units": {peer_tour.UNIT: {"route": "line"}}}
        listener = {"type": LISTENERS[scheme], "bind": "127.0.0.1:0", "rules": [rule | route]}
        line = {"device": str(cable.devices[0]), "parity": "none"}
        served = {"units": {peer_tour.UNIT: "plant"}, "access": "read-write"}
        file = folder / "appliance.yaml"
        file.write_text(
            written(
                {
                    "memories": {"plant": peer_tour.SIZES},
                    "identity": peer_tour.IDENTITY,
                    "links": {
                        "line": {"url": f"rtu://{cable.devices[1]}?parity=none&baud=4000000"}
                    },
                    "listeners": {
                        "scada": listener,
                        "device": {"type": "modbus-rtu", "serial": line, "rules": [served]},
                    },
                }
            )
        )
        with Appliance(load(file)) as appliance:
            memory = appliance.memories["plant"]
            peer_tour.filled(memory)
            host, port = endpoint(appliance, "scada")
            yield Target(f"{scheme}://{host}:{port}", memory)


def listening(scheme: str, cable: Cable | None, access: str) -> str:
    """Builds the configuration of an appliance with one listener, `scada`."""
    rule: dict[str, Any] = {"units": {peer_tour.UNIT: "plant"}, "access": access}
    where: dict[str, Any]
    if cable is not None:
        where = {"serial": {"device": str(cable.devices[0]), "parity": "none"}}
    else:
        where = {"bind": "127.0.0.1:0"}
        rule["sources"] = ["127.0.0.1"]
    return written(
        {
            "memories": {"plant": peer_tour.SIZES},
            "identity": peer_tour.IDENTITY,
            "listeners": {"scada": {"type": LISTENERS[scheme], **where, "rules": [rule]}},
        }
    )


WAYS: dict[str, Way] = {"direct": Way(direct, LISTENERS), "route": Way(routed, ("tcp", "rtu+tcp"))}
