"""The listener of a server: which transport `bind` names, and which options it has."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal, TypeAlias
from urllib.parse import urlsplit

from holdfast import _core
from holdfast.client.tolerance import STRICT
from holdfast.client.url import SERIAL, SerialTarget, parse
from holdfast.types import TRANSPORTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast._core import Rule, ServerTls
    from holdfast.types import WhenFull

NAME = "server"

Framing: TypeAlias = Literal["mbap", "rtu", "ascii"]

_CONNECTIONS: dict[str, Framing] = {
    "tcp": "mbap",
    "tls": "mbap",
    "rtu+tcp": "rtu",
    "ascii+tcp": "ascii",
}
_DATAGRAMS: dict[str, Literal["mbap", "rtu"]] = {"udp": "mbap", "rtu+udp": "rtu"}

FORMS = (
    "127.0.0.1:5020, tcp://127.0.0.1:5020, tls://127.0.0.1:5020, udp://127.0.0.1:5020, "
    "rtu+tcp://127.0.0.1:5020, rtu+udp://127.0.0.1:5020, ascii+tcp://127.0.0.1:5020, "
    "rtu:///dev/ttyUSB0?baud=19200&parity=even, ascii:///dev/ttyUSB0"
)


@dataclass(frozen=True, kw_only=True)
class TransportOptions:
    """The options of a server that not every transport has, with their defaults."""

    max_connections: int = 256
    max_connections_per_source: int | None = None
    when_full: WhenFull = "refuse"
    idle_timeout: float = 300.0
    request_timeout: float = 10.0
    frame_timeout: float = 0.05
    listen_only: bool = False
    tls: ServerTls | None = None
    max_handshakes: int = 256

    def check(self, scheme: str, *allowed: str) -> None:
        """Raises `ValueError` for an option that is set and has no effect with this scheme."""
        for option in fields(self):
            if option.name not in allowed and getattr(self, option.name) != option.default:
                raise ValueError(f"{option.name} has no effect with {scheme}: omit it")


def listener(bind: str, rules: Sequence[Rule], options: TransportOptions) -> _core.Listener:
    """Returns the listener for `bind`. Raises `ValueError` for what it can't be or have."""
    scheme, address = _split(bind)
    if scheme in SERIAL:
        options.check(scheme)
        return _serial(bind, rules)
    if scheme in _DATAGRAMS:
        options.check(scheme, "listen_only")
        return _core.Listener.udp(
            NAME,
            address,
            rules,
            framing=_DATAGRAMS[scheme],
            listen_only=options.listen_only,
        )
    special = {"rtu+tcp": {"frame_timeout"}, "tls": {"tls", "max_handshakes"}}
    others = {"frame_timeout", "tls", "max_handshakes"} - special.get(scheme, set())
    options.check(scheme, *({each.name for each in fields(options)} - others))
    if scheme == "tls" and options.tls is None:
        raise ValueError("tls:// requires tls, the certificates: holdfast.ServerTls(cert_file=…)")
    return _core.Listener(
        NAME,
        address,
        rules,
        framing=_CONNECTIONS[scheme],
        max_connections=options.max_connections,
        max_connections_per_source=options.max_connections_per_source,
        when_full=options.when_full,
        idle_timeout=options.idle_timeout,
        request_timeout=options.request_timeout,
        frame_timeout=options.frame_timeout if scheme == "rtu+tcp" else None,
        listen_only=options.listen_only,
        tls=options.tls,
        max_handshakes=options.max_handshakes,
    )


def _split(bind: str) -> tuple[str, str]:
    """Returns the scheme and the address; without a scheme, Modbus TCP."""
    if not isinstance(bind, str):
        raise TypeError(f"bind is {bind!r}, allowed: {FORMS}")
    scheme, separator, address = bind.partition("://")
    if not separator:
        return "tcp", bind
    if scheme in SERIAL:
        return scheme, bind
    if scheme not in TRANSPORTS or urlsplit(bind).netloc != address:
        raise ValueError(f"bind is {bind!r}, allowed: {FORMS}")
    return scheme, address


def _serial(bind: str, rules: Sequence[Rule]) -> _core.Listener:
    line = parse(bind)
    assert isinstance(line, SerialTarget)
    if line.tolerance != STRICT:
        raise ValueError(f"bind is {bind!r}, which has options of clients, allowed: {FORMS}")
    if len(rules) != 1:
        raise ValueError(f"found {len(rules)} rules, a serial line has exactly one")
    return _core.Listener.serial(
        NAME,
        line.device,
        rules[0],
        mode=line.mode,
        baud=line.baud,
        parity=line.parity,
        stop_bits=line.stop_bits,
        data_bits=line.data_bits,
        silence=line.silence,
        rs485=line.rs485,
    )
