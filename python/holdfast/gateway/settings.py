"""The settings of a gateway."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.net.addresses import LOOPBACK
from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config.models.services import Compat
    from holdfast.gateway.token_file import Token
    from holdfast.net.addresses import Network
    from holdfast.net.allow_list import AllowedNetwork
    from holdfast.net.tls import Tls
    from holdfast.tags import TagList


@dataclass(frozen=True)
class GatewayLimits:
    """The limits of a gateway. Times are in seconds."""

    body: int = 65536
    """The largest request body in bytes."""
    timeout: float = 60.0
    """The longest `timeout` of a request."""
    requests: int = 128
    """Pending requests; further ones get status 503."""
    requests_of_device: int = 64
    """Pending requests to one host and port, so that a dead device does not block others."""
    streams: int = 16
    """Open maps and watches; further ones get status 503."""
    discovery: float = 900.0
    """The longest duration of a map; then it ends unfinished."""
    interval: float = 0.1
    """The shortest polling interval of a watch."""
    heartbeat: float = 5.0
    """The longest time between two events or comments of a stream."""
    devices: int = 256
    """Open connections to devices."""
    idle: float = 30.0
    """The time after which an idle connection to a device is closed."""
    in_flight: int = 1
    """Requests in flight to one device."""
    connections: int = 128
    """Connections of HTTP clients."""
    connections_per_source: int | None = 64
    """Connections of HTTP clients with one address, so that it can't take all places."""
    request_timeout: float = 10.0
    """The timeout for receiving a request, and for sending a response."""
    ending: float = 0.7
    """The time for pending requests when the gateway stops; then they get status 503."""


@dataclass(frozen=True)
class Settings:
    """The settings of a gateway: allowed targets, allowed operations and allowed clients."""

    allow: tuple[AllowedNetwork, ...]
    writes: bool = False
    tokens: tuple[Token, ...] = ()
    """Without tokens, every client from `sources` is allowed."""
    sources: tuple[Network, ...] = LOOPBACK
    limits: GatewayLimits = field(default_factory=GatewayLimits)
    profiles: Mapping[str, TagList] = field(default_factory=dict)
    """Tag lists that clients can choose by name."""
    hosts: frozenset[str] = frozenset()
    """Without tokens: the names of the gateway that Host may have, in lower case."""
    compat: Compat | None = None
    """The program whose requests and errors are accepted and sent as by that program."""
    tls: Tls = NO_FILES
    """The TLS files for connections to devices. Requests can't change them."""
