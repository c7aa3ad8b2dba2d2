"""REST: reads and writes memories as JSON over HTTP, see docs/rest.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast import __version__
from holdfast.adapters.rest.app import App
from holdfast.adapters.rest.operations import OPERATIONS, document
from holdfast.net.http.server import STOP_TIMEOUT_S, ConnectionLimits, WebServer

if TYPE_CHECKING:
    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.adapters.sessions import SessionControl
    from holdfast.config.models.services import RestConfig
    from holdfast.ingest import MemoryAccess
    from holdfast.net.http.https import Https
    from holdfast.net.http.port import ListeningSocket
    from holdfast.runtime.stop import Stop

__all__ = ["Rest"]


class Rest:
    """The REST adapter, on a listening socket."""

    def __init__(
        self,
        settings: RestConfig,
        memory_access: MemoryAccess,
        diagnostics: DiagnosticsSource,
        sessions: SessionControl,
        listener: ListeningSocket,
        *,
        https: Https | None = None,
        stop_timeout: float = STOP_TIMEOUT_S,
    ) -> None:
        is_https = https is not None
        self._app = App(
            OPERATIONS, settings, memory_access, diagnostics, sessions, is_https=is_https
        )
        self._server = WebServer(
            "rest",
            self._app,
            listener,
            sources=settings.sources,
            limits=ConnectionLimits(
                settings.max_connections,
                settings.max_connections_per_source,
                settings.when_full,
            ),
            request_timeout=settings.request_timeout,
            stop_timeout=stop_timeout,
            https=https,
        )
        self._app.describe(
            document(__version__, settings.max_body, secured=settings.tokens != "none"),
            f"{'https' if is_https else 'http'}://{self._server.address}",
        )
        self.heartbeat = self._server.heartbeat

    def run(self, stop: Stop) -> None:
        """Serves until `stop` is set."""
        stop.then(self._app.end)
        self._server.run(stop)

    def status(self) -> dict[str, object]:
        """Returns the address, the counts of connections, and how many change streams are open."""
        return {
            "address": self._server.address,
            "connections": self._server.counts(),
            "streams": self._app.open_streams,
            "tls_failures": self._server.tls_failures(),
        }
