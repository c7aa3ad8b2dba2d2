"""`Server`: one listener of the native engine, whose transport `bind` names."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from operator import index
from typing import (
    TYPE_CHECKING,
    Self,
    SupportsFloat,
    SupportsIndex,
    TypeVar,
    Unpack,
    cast,
)
from urllib.parse import urlsplit

from holdfast import _core
from holdfast.client.base import ForeignAttribute
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.tolerance import STRICT
from holdfast.client.url import SERIAL_FORMS, SERIAL_SCHEMES, parse
from holdfast.net.addresses import LOOPBACK
from holdfast.protocol import MAX_SERIAL_UNIT, MAX_UNIT
from holdfast.server.fork import close_in_children
from holdfast.server.identity import Identity
from holdfast.server.options import DEFAULTS, STREAM_DEFAULTS
from holdfast.types import FRAMINGS, TRANSPORTS
from holdfast.values.integers import as_boolean, as_integer

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from holdfast._core import Memory, Rule
    from holdfast.server.options import (
        DatagramOptions,
        SerialOptions,
        ServerOptions,
        StreamOptions,
    )
    from holdfast.types import Access, ModbusCounters

NAME = "server"

Item = TypeVar("Item")
_DATAGRAMS = ("udp", "rtu+udp")

FORMS = ", ".join(
    ["127.0.0.1:5020", *(f"{each}://127.0.0.1:5020" for each in TRANSPORTS), SERIAL_FORMS]
)

_running: set[_core.Engine] = set()
"""A server that was started serves until `stop`, also if the program has no reference to it."""

SERVED = (_core.Memory, _core.Route, _core.Passage)
UNITS = "{1: memory}"
CODES = "[3, 16]"
NETWORKS = "['10.0.0.0/24', 'fd00::/64']"

MAX_WORKERS = 64
SOURCES = tuple(map(str, LOOPBACK))


class Server:
    """Serves memories over Modbus, from `start` (or `with`) to `stop`.

    `units` maps unit ids, 0 to 255 (1 to 247 on a serial line), to memories. Peers from `sources`,
    by default this machine, have `access` to them, limited by `functions` or `deny`, lists of
    function codes. Alternatively, set `rules`: for each unit id, the first rule that matches the
    peer and has the unit id applies. A peer without a rule is disconnected at once.
    `bind` is `address:port` for Modbus TCP, or a URL with the schemes of clients: `tcp`, `tls`,
    `udp`, `rtu+tcp`, `rtu+udp` and `ascii+tcp` with an IP address and a port, `rtu` and `ascii`
    with a serial line, as in `rtu:///dev/ttyUSB0?baud=19200&parity=even`. Port 0 lets the system
    pick a port. `tls` requires `tls`, the certificates. `workers` is the number of native threads.

    `options` are those of `holdfast.server.ServerOptions`: limits on connections, and times in
    seconds. An option that the transport does not have is refused.

    Raises `ValueError` or `TypeError` at once for invalid arguments.

    >>> memory = holdfast.Memory(holding_registers=100)
    >>> with holdfast.Server({1: memory}, bind="127.0.0.1:5020", access="read-write"):
    ...     input("Enter stops it. ")
    """

    __slots__ = ("__weakref__", "_engine", "_identity", "_listener", "_starting", "_workers")

    if not TYPE_CHECKING:  # Type checkers refuse these names as all that do not exist.
        units = bind = access = sources = functions = deny = rules = identity = workers = tls = (
            ForeignAttribute("it is an argument of the constructor")
        )
        host = port = ForeignAttribute("set `bind` in the constructor")

    def __init__(
        self,
        units: Mapping[int, Memory] | None = None,
        *,
        bind: str,
        access: Access | None = None,
        sources: Sequence[str] | None = None,
        functions: Collection[int] | None = None,
        deny: Collection[int] | None = None,
        rules: Sequence[Rule] | None = None,
        identity: Identity | None = None,
        workers: int = 1,
        **options: Unpack[ServerOptions],
    ) -> None:
        if rules is None:
            if units is None or access is None:
                raise TypeError("a server requires units and access, or rules")
            _check_units(units)
            if sources is None and _split(bind)[0] not in SERIAL_SCHEMES:
                sources = SOURCES
            rule = _core.Rule(
                units,
                sources=None if sources is None else _listed("sources", sources, NETWORKS),
                access=access,
                functions=None if functions is None else _listed("functions", functions, CODES),
                deny=_listed("deny", deny, CODES) if deny else None,
            )
            rules = [rule]
        else:
            rights = (units, access, sources, functions, deny)
            if any(each is not None for each in rights):
                named = "units, access, sources, functions and deny"
                raise TypeError(f"a server has rules or rights ({named}), not both")
        if not 1 <= index(workers) <= MAX_WORKERS:
            raise ValueError(f"workers is {workers}, allowed: 1 to {MAX_WORKERS}")
        if identity is not None and not isinstance(identity, Identity):
            allowed = "holdfast.server.Identity(vendor_name=…)"
            raise TypeError(f"identity is {identity!r}, allowed: {allowed}")
        self._listener = _listener(bind, list(rules), options)
        self._identity = identity or Identity()
        self._workers = workers
        self._engine: _core.Engine | None = None
        self._starting = threading.Lock()

    def start(self) -> Self:
        """Listens and serves until `stop`, or the end of the program.

        Raises `OSError` if the address can't be bound, `RuntimeError` if the server is running,
        `ValueError` for an identity that can't be sent.
        """
        with self._starting:
            if self._engine is not None:
                raise RuntimeError("the server is already running")
            engine = _core.Engine(
                [self._listener],
                identity=self._identity.objects(),
                unit_names=self._identity.names(),
                workers=self._workers,
            )
            close_in_children(engine)
            _running.add(engine)
            self._engine = engine
        return self

    def stop(self) -> None:
        """Answers received requests, closes all connections and stops listening, within a second.

        Can be called from any thread and more than once. The server can be started again.
        """
        engine, self._engine = self._engine, None
        if engine is not None:
            _running.discard(engine)
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


def _check_units(units: object) -> None:
    """Raises `TypeError` for what maps no unit ids to memories."""
    if not isinstance(units, Mapping):
        raise TypeError(f"units is {units!r}, allowed: a memory for each unit id, as in {UNITS}")
    for unit, memory in units.items():
        if as_integer(unit) is None:
            raise TypeError(f"found the unit id {unit!r}, allowed: 0 to {MAX_UNIT}, as in {UNITS}")
        if not isinstance(memory, SERVED):
            raise TypeError(f"unit {unit} is {memory!r}, allowed: a holdfast.Memory")


def _listed(name: str, given: Iterable[Item], example: str) -> list[Item]:
    """Several items as a list. Raises `TypeError` for one item or a text."""
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise TypeError(f"{name} is {given!r}, allowed: a list, as in {example}")
    return list(given)


def _listener(bind: str, rules: Sequence[Rule], options: ServerOptions) -> _core.Listener:
    """Returns the listener for `bind`. Raises `ValueError` for what it can't be or have."""
    scheme, address = _split(bind)
    _check(scheme, options)
    for rule in rules:
        _check_rule(scheme, rule)
    if scheme in SERIAL_SCHEMES:
        return _serial(bind, rules, options)
    if scheme in _DATAGRAMS:
        datagrams = {**DEFAULTS, **options, "framing": FRAMINGS[scheme]}
        return _core.Listener.udp(NAME, address, rules, cast("DatagramOptions", datagrams))
    if scheme == "tls" and options.get("tls") is None:
        raise ValueError("tls:// requires tls, the certificates: holdfast.ServerTls(cert_file=…)")
    stream: StreamOptions = {**STREAM_DEFAULTS, **options, "framing": FRAMINGS[scheme]}
    return _core.Listener(NAME, address, rules, stream)


def _check(scheme: str, options: ServerOptions) -> None:
    """Raises `ValueError` for an option that is set and has no effect with this scheme, `TypeError`
    for an unknown one and for a value of another type.
    """
    if scheme in SERIAL_SCHEMES:
        allowed = {"event_log"}
    elif scheme in _DATAGRAMS:
        allowed = {"listen_only", "event_log"}
    else:
        special = {"frame_timeout": "rtu+tcp", "tls": "tls"}
        allowed = {name for name in DEFAULTS if special.get(name, scheme) == scheme}
    for name, value in options.items():
        if name not in DEFAULTS:
            raise TypeError(f"found the option {name!r}, allowed: {', '.join(DEFAULTS)}")
        if name not in allowed and value != cast("dict[str, object]", DEFAULTS)[name]:
            raise ValueError(f"{name} has no effect with {scheme}: omit it")
        if (allowed_type := _other_type(name, value)) is not None:
            raise TypeError(f"{name} is {value!r}, allowed: {allowed_type}")


def _other_type(name: str, value: object) -> str | None:
    """The type of an option, if a value has another one. The core checks the value."""
    default = cast("dict[str, object]", DEFAULTS)[name]
    if value is default:
        return None
    if name == "tls":
        return None if isinstance(value, _core.ServerTls) else "holdfast.ServerTls(cert_file=…)"
    if isinstance(default, bool):
        return None if as_boolean(value) is not None else "True, False"
    if isinstance(default, float):
        is_number = isinstance(value, SupportsFloat | SupportsIndex)
        return None if is_number else "a number of seconds"
    if isinstance(default, str):
        return None if isinstance(value, str) else "refuse, evict"
    return None if as_integer(value) is not None else f"an integer{', None' * (default is None)}"


def _check_rule(scheme: str, rule: Rule) -> None:
    """Raises `ValueError` for what a rule has and this scheme does not, or the other way round.

    Raises `TypeError` for what is no rule.
    """
    if not isinstance(rule, _core.Rule):
        raise TypeError(f"found the rule {rule!r}, allowed: holdfast.Rule(…)")
    if scheme != "tls" and rule.roles is not None:
        raise ValueError(f"roles has no effect with {scheme}: omit it")
    if scheme not in SERIAL_SCHEMES:
        if rule.sources is None:
            raise ValueError(f"a rule requires sources with {scheme}, as in {NETWORKS}")
        return
    if rule.sources is not None:
        raise ValueError(f"sources has no effect with {scheme}: omit it")
    for unit in sorted(rule.unit_ids):
        if not 1 <= unit <= MAX_SERIAL_UNIT:
            allowed = f"allowed on a serial line: 1 to {MAX_SERIAL_UNIT}"
            raise ValueError(f"found the unit id {unit}, {allowed}")


def _split(bind: str) -> tuple[str, str]:
    """Returns the scheme and the address; without a scheme, Modbus TCP."""
    if not isinstance(bind, str):
        raise TypeError(f"bind is {bind!r}, allowed: {FORMS}")
    scheme, separator, address = bind.partition("://")
    if not separator:
        return "tcp", bind
    if scheme in SERIAL_SCHEMES:
        return scheme, bind
    if scheme not in TRANSPORTS or urlsplit(bind).netloc != address:
        raise ValueError(f"bind is {bind!r}, allowed: {FORMS}")
    return scheme, address


def _serial(bind: str, rules: Sequence[Rule], options: ServerOptions) -> _core.Listener:
    line = parse(bind)
    assert isinstance(line, SerialTarget)
    if line.tolerance != STRICT:
        raise ValueError(f"bind is {bind!r}, which has options of clients, allowed: {FORMS}")
    if len(rules) != 1:
        raise ValueError(f"found {len(rules)} rules, a serial line has exactly one")
    settings = {**DEFAULTS, **options, **line.settings}
    return _core.Listener.serial(NAME, line.device, rules[0], cast("SerialOptions", settings))
