"""A Modbus TCP server for memories, for use from Python.

The server is one listener of the native engine, whose threads serve it outside the interpreter.
`holdfast.appliance` has appliances with several listeners.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self, cast

from holdfast import _core
from holdfast._core import __version__
from holdfast.net.addresses import LOOPBACK

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from holdfast._core import Memory, Rule
    from holdfast.types import Access, ModbusCounters, WhenFull

MAX_WORKERS = 64
SOURCES = tuple(map(str, LOOPBACK))


@dataclass(frozen=True, kw_only=True)
class Identity:
    """The identification objects of all units, and names of single units.

    Text is sent as UTF-8, at most 244 bytes each. Optional objects with empty text are omitted.
    `unit_names`, by unit id 0 to 255, override `user_application_name`. `private_objects` are by
    object id, 128 to 255.
    """

    vendor_name: str = "Holdfast"
    product_code: str = "HF"
    revision: str = __version__
    vendor_url: str = ""
    product_name: str = ""
    model_name: str = ""
    user_application_name: str = ""
    unit_names: Mapping[int, str] = field(default_factory=dict)
    private_objects: Mapping[int, str] = field(default_factory=dict)

    def objects(self) -> list[tuple[int, str]]:
        """Object ids and texts, the three mandatory objects first."""
        mandatory = [self.vendor_name, self.product_code, self.revision]
        optional = [
            self.vendor_url,
            self.product_name,
            self.model_name,
            self.user_application_name,
        ]
        regular = [(index, text) for index, text in enumerate(optional, start=3) if text]
        return [*enumerate(mandatory), *regular, *self.private_objects.items()]

    def names(self) -> list[tuple[int, str]]:
        """Unit ids and names."""
        return list(self.unit_names.items())


class Server:
    """Serves memories over Modbus TCP, from `start` (or `with`) to `stop`.

    `units` maps unit ids, 0 to 255, to memories. Peers from `sources` have `access` to them,
    limited by `functions` or `deny`, lists of function codes. Alternatively, set `rules`: the first
    rule whose sources contain the peer applies. A peer without a rule is disconnected at once.
    `bind` is `address:port`; port 0 lets the system pick a port.

    Times are in seconds. `idle_timeout` is the time without a request; 0 is unlimited.
    `request_timeout` is the time from the first byte of a request to its last, and the time for a
    peer to read its replies. With `listen_only`, a peer that may write can set a unit to listen
    only mode for all peers (function 8, sub-function 4). `workers` is the number of native threads.

    Raises `ValueError` or `TypeError` at once for invalid arguments.

    >>> memory = holdfast.Memory(holding_registers=100)
    >>> with holdfast.Server({1: memory}, bind="127.0.0.1:5020", access="read-write"):
    ...     input("Enter stops it. ")
    """

    def __init__(
        self,
        units: Mapping[int, Memory] | None = None,
        *,
        bind: str,
        access: Access | None = None,
        sources: Sequence[str] = SOURCES,
        functions: Collection[int] | None = None,
        deny: Collection[int] | None = None,
        rules: Sequence[Rule] | None = None,
        max_connections: int = 256,
        max_connections_per_source: int | None = None,
        max_requests_per_source: int | None = None,
        max_writes_per_source: int | None = None,
        when_full: WhenFull = "refuse",
        idle_timeout: float = 300.0,
        request_timeout: float = 10.0,
        listen_only: bool = False,
        identity: Identity | None = None,
        workers: int = 1,
    ) -> None:
        if rules is None:
            if units is None or access is None:
                raise TypeError("a server requires units and access, or rules")
            rule = _core.Rule(
                units,
                sources=list(sources),
                access=access,
                functions=None if functions is None else list(functions),
                deny=list(deny) if deny else None,
            )
            rules = [rule]
        elif units is not None or access is not None:
            raise TypeError("a server requires units and access, or rules, not both")
        if not 1 <= workers <= MAX_WORKERS:
            raise ValueError(f"workers is {workers}, allowed: 1 to {MAX_WORKERS}")
        self._listener = _core.Listener(
            "server",
            bind,
            list(rules),
            max_connections=max_connections,
            max_connections_per_source=max_connections_per_source,
            max_requests_per_source=max_requests_per_source,
            max_writes_per_source=max_writes_per_source,
            when_full=when_full,
            idle_timeout=idle_timeout,
            request_timeout=request_timeout,
            listen_only=listen_only,
        )
        self._identity = identity or Identity()
        self._workers = workers
        self._engine: _core.Engine | None = None
        self._starting = threading.Lock()

    def start(self) -> Self:
        """Listens and serves until `stop`.

        Raises `OSError` if the address can't be bound, `RuntimeError` if the server is running.
        """
        with self._starting:
            if self._engine is not None:
                raise RuntimeError("the server is already running")
            self._engine = _core.Engine(
                [self._listener],
                identity=self._identity.objects(),
                unit_names=self._identity.names(),
                workers=self._workers,
            )
        return self

    def stop(self) -> None:
        """Answers received requests, closes all connections and stops listening, within a second.

        Can be called from any thread and more than once. The server can be started again.
        """
        engine, self._engine = self._engine, None
        if engine is not None:
            engine.stop()

    @property
    def address(self) -> tuple[str, int]:
        """The address and port of the server. Raises `RuntimeError` if it is not running."""
        address = self._running().addresses[0]
        assert address is not None
        return address

    def counters(self) -> ModbusCounters:
        """The counters since the start. Raises `RuntimeError` if the server is not running."""
        return cast("ModbusCounters", self._running().counters()["server"])

    def _running(self) -> _core.Engine:
        if self._engine is None:
            raise RuntimeError("the server is not running")
        return self._engine

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()
