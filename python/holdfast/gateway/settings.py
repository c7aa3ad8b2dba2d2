"""What a gateway is told when it starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.net.addresses import LOOPBACK
from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from holdfast.gateway.tokens import Token
    from holdfast.net.addresses import Network
    from holdfast.net.allow_list import AllowedNetwork
    from holdfast.net.tls import Tls


@dataclass(frozen=True)
class GatewayLimits:
    """What a gateway takes and does at most. Times are in seconds."""

    body: int = 65536
    """Bytes of a request's body."""
    timeout: float = 60.0
    """What a request may ask for as its time."""
    requests: int = 128
    """Requests at once; more are answered 503."""
    requests_of_device: int = 64
    """Those to one host and port, so that a dead device leaves places for others."""
    streams: int = 16
    """Maps and watches at once; more are answered 503."""
    mapping: float = 900.0
    """For a map, which ends unfinished then."""
    interval: float = 0.1
    """Between two polls of a watch, at least."""
    heartbeat: float = 5.0
    """Between two signs of life of a stream, at most."""
    devices: int = 256
    """Connections that are kept."""
    idle: float = 30.0
    """A connection that nobody uses is kept for."""
    in_flight: int = 1
    """Requests on their way to one device at once."""
    connections: int = 128
    """Connections of HTTP clients."""
    request_timeout: float = 10.0
    """For a request to arrive, and for an answer to be taken."""
    ending: float = 0.7
    """For requests under way when the gateway ends; then they are answered 503."""

    @property
    def open_connections(self) -> int:
        """The most connections, to clients and to devices."""
        return self.connections + self.devices


@dataclass(frozen=True)
class Settings:
    """Whom it may talk to, what it may do, and who may ask."""

    allow: tuple[AllowedNetwork, ...]
    writes: bool = False
    tokens: tuple[Token, ...] = ()
    """Without any, whoever may connect may ask."""
    sources: tuple[Network, ...] = LOOPBACK
    limits: GatewayLimits = field(default_factory=GatewayLimits)
    tls: Tls = NO_FILES
    """Whom it trusts among devices with TLS, and what it shows them; callers have no say in it."""
