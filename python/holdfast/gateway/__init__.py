"""The gateway: access to Modbus devices over HTTP, with a console, see docs/gateway.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast import __version__
from holdfast.client.client import connection
from holdfast.gateway.app import App, gateway_rejection
from holdfast.gateway.operations import document, operations
from holdfast.gateway.settings import GatewayLimits, Settings
from holdfast.net.allow_list import AllowedNetwork
from holdfast.net.http.server import ConnectionLimits, WebServer, address_of

if TYPE_CHECKING:
    from holdfast._core import ListeningSocket, Poller
    from holdfast.gateway.pool import Dial
    from holdfast.net.http.health import HealthSource
    from holdfast.net.http.https import Https
    from holdfast.net.resolver import Resolve
    from holdfast.runtime.stop import Stop

__all__ = ["AllowedNetwork", "Gateway", "GatewayLimits", "Settings"]


class Gateway:
    """A gateway on a listening socket.

    `resolve` resolves names, `dial` creates connections to addresses. Devices that `poller` uses
    are asked over its connections. With `health`, probes are answered, without a token.
    """

    def __init__(
        self,
        settings: Settings,
        listener: ListeningSocket,
        *,
        resolve: Resolve | None = None,
        dial: Dial = connection,
        poller: Poller | None = None,
        https: Https | None = None,
        health: HealthSource | None = None,
    ) -> None:
        host, port, *_ = listener.getsockname()
        self.address = address_of(host, port)
        """The address it listens on."""
        scheme = "http" if https is None else "https"
        self.url = f"{scheme}://{self.address}"
        """The URL of its root."""
        self._app = App(
            operations(settings),
            settings,
            resolve=resolve,
            dial=dial,
            poller=poller,
            health=health,
            is_https=https is not None,
        )
        self._app.describe(document(__version__, settings), self.url)
        self._server = WebServer(
            "gateway",
            self._app,
            listener,
            sources=settings.sources,
            limits=ConnectionLimits(
                settings.limits.connections,
                settings.limits.connections_per_source,
                when_full="evict",
            ),
            request_timeout=settings.limits.request_timeout,
            half_close_is_disconnect=True,
            rejection=gateway_rejection,
            https=https,
        )
        self.heartbeat = self._server.heartbeat

    def run(self, stop: Stop) -> None:
        """Serves in this thread until `stop` is set."""
        stop.then(self._app.end)
        self._server.run(stop)

    def status(self) -> dict[str, object]:
        """Returns the address and the counts of connections and requests. Thread-safe."""
        return {
            "address": self.address,
            "connections": self._server.counts(),
            "tls_failures": self._server.tls_failures(),
            **self._app.counts(),
        }
