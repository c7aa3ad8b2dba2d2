"""`Server`: one listener of the native engine."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Self, cast

from holdfast import _core
from holdfast.net.addresses import LOOPBACK
from holdfast.server.fork import close_in_children
from holdfast.server.identity import Identity
from holdfast.server.listening import NAME, TransportOptions, listener

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from holdfast._core import Memory, Rule, ServerTls
    from holdfast.types import Access, ModbusCounters, WhenFull

MAX_WORKERS = 64
SOURCES = tuple(map(str, LOOPBACK))


class Server:
    """Serves memories over Modbus, from `start` (or `with`) to `stop`.

    `units` maps unit ids, 0 to 255, to memories. Peers from `sources` have `access` to them,
    limited by `functions` or `deny`, lists of function codes. Alternatively, set `rules`: the first
    rule whose sources contain the peer applies. A peer without a rule is disconnected at once.
    `bind` is `address:port` for Modbus TCP, or a URL with the schemes of clients: `tcp`, `tls`,
    `udp`, `rtu+tcp`, `rtu+udp` and `ascii+tcp` with an IP address and a port, `rtu` and `ascii`
    with a serial line, as in `rtu:///dev/ttyUSB0?baud=19200&parity=even`. Port 0 lets the system
    pick a port. `tls` requires `tls`, the certificates. An option that the transport does not have
    is refused.

    Times are in seconds. `idle_timeout` is the time without a request; 0 is unlimited.
    `request_timeout` is the time from the first byte of a request to its last, and the time for a
    peer to read its replies. `frame_timeout`, for `rtu+tcp`, is the time without a byte after which
    an incomplete request is discarded. With `listen_only`, a peer that may write can set
    a unit to listen only mode for all peers (function 8, sub-function 4). `workers` is the number
    of native threads.

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
        when_full: WhenFull = "refuse",
        idle_timeout: float = 300.0,
        request_timeout: float = 10.0,
        frame_timeout: float = 0.05,
        listen_only: bool = False,
        tls: ServerTls | None = None,
        max_handshakes: int = 256,
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
        options = TransportOptions(
            max_connections=max_connections,
            max_connections_per_source=max_connections_per_source,
            when_full=when_full,
            idle_timeout=idle_timeout,
            request_timeout=request_timeout,
            frame_timeout=frame_timeout,
            listen_only=listen_only,
            tls=tls,
            max_handshakes=max_handshakes,
        )
        self._listener = listener(bind, list(rules), options)
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
            close_in_children(self._engine)
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
        """The address and port of the server.

        Raises `RuntimeError` if it is not running, and for a serial line, which has none.
        """
        address = self._running().addresses[0]
        if address is None:
            raise RuntimeError("a serial line has no address")
        return address

    def counters(self) -> ModbusCounters:
        """The counters since the start. Raises `RuntimeError` if the server is not running."""
        return cast("ModbusCounters", self._running().counters()[NAME])

    def _running(self) -> _core.Engine:
        if self._engine is None:
            raise RuntimeError("the server is not running")
        return self._engine

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()
