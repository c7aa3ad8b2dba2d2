"""A Modbus TCP server over memories, for use from Python.

It is one listener of the native engine; the engine's threads serve it, outside the interpreter.
An appliance with several listeners is `holdfast.appliance`.
"""

from __future__ import annotations

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
    """The identification objects of all units, and names of single ones.

    Texts are sent as UTF-8, at most 244 bytes each; an empty one that is not mandatory is left out.
    `unit_names` by unit id, 0 to 255, take the place of `user_application_name`; `private_objects`
    are those by id, 128 to 255.
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
        """Object ids and texts, the three mandatory ones first."""
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

    `units` maps unit ids, 0 to 255, to memories; what peers from `sources` may do with them is
    `access`, and `functions` or `deny`, lists of function codes. In place of these, `rules` are
    several grants, of which the first that names a peer's address holds. A peer that none names is
    closed at once. `bind` is `address:port`; port 0 lets the system pick one.

    Times are in seconds: `idle_timeout` without a request (0 keeps a connection for ever),
    `request_timeout` from the first byte of a request to its last, and for a peer to take its
    replies. `workers` is the number of native threads.

    Raises `ValueError` or `TypeError` for arguments that can't be, at once.

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
        identity: Identity | None = None,
        workers: int = 1,
    ) -> None:
        if rules is None:
            if units is None or access is None:
                raise TypeError("a server needs units and access, or rules")
            rule = _core.Rule(
                units,
                sources=list(sources),
                access=access,
                functions=None if functions is None else list(functions),
                deny=list(deny) if deny else None,
            )
            rules = [rule]
        elif units is not None or access is not None:
            raise TypeError("a server has units and access, or rules, not both")
        if not 1 <= workers <= MAX_WORKERS:
            raise ValueError(f"workers is {workers}, allowed are 1 to {MAX_WORKERS}")
        self._listener = _core.Listener(
            "server",
            bind,
            list(rules),
            max_connections=max_connections,
            max_connections_per_source=max_connections_per_source,
            when_full=when_full,
            idle_timeout=idle_timeout,
            request_timeout=request_timeout,
        )
        self._identity = identity or Identity()
        self._workers = workers
        self._engine: _core.Engine | None = None

    def start(self) -> Self:
        """Listens and serves, until `stop`.

        Raises `OSError` when the address can't be bound, `RuntimeError` when it runs already.
        """
        if self._engine is not None:
            raise RuntimeError("the server runs already")
        self._engine = _core.Engine(
            [self._listener],
            identity=self._identity.objects(),
            unit_names=self._identity.names(),
            workers=self._workers,
        )
        return self

    def stop(self) -> None:
        """Answers what was received, ends all connections and stops listening, within a second.

        From any thread, any number of times; it can be started again.
        """
        engine, self._engine = self._engine, None
        if engine is not None:
            engine.stop()

    @property
    def address(self) -> tuple[str, int]:
        """The address and port that it listens on. Raises `RuntimeError` when it does not run."""
        address = self._running().addresses[0]
        assert address is not None
        return address

    def counters(self) -> ModbusCounters:
        """What it counted since it was started. Raises `RuntimeError` when it does not run."""
        return cast("ModbusCounters", self._running().counters()["server"])

    def _running(self) -> _core.Engine:
        if self._engine is None:
            raise RuntimeError("the server does not run")
        return self._engine

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()
