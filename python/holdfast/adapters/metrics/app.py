"""The metrics adapter: the HTTP service of scrapes and probes."""

from __future__ import annotations

import asyncio
import gzip
import threading
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING, TypeVar, cast
from urllib.parse import parse_qs

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.exposition import choose_encoder, gzip_accepted
from prometheus_client.registry import Collector

from holdfast.adapters.metrics.families import all_metrics, readiness, tag_metrics
from holdfast.net.http import health as probes
from holdfast.net.http.application import Application
from holdfast.net.http.host_and_origin import Origins
from holdfast.net.http.operations import Operation
from holdfast.net.http.requests import BadRequest, Response, rejection, response
from holdfast.net.http.server import ConnectionLimits, WebServer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from prometheus_client.metrics_core import Metric

    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.config.models.services import MetricsConfig
    from holdfast.net.http.health import HealthSource
    from holdfast.net.http.https import Https
    from holdfast.net.http.port import ListeningSocket
    from holdfast.net.http.requests import Request
    from holdfast.runtime.stop import Stop

Result = TypeVar("Result")

LIMITS = ConnectionLimits(32, 16, when_full="evict")
REQUEST_TIMEOUT_S = 10.0
PATH = "/metrics"
STATUSES = {"malformed": 400, "foreign_page": 403, "not_found": 404, "method_not_allowed": 405}


class Metrics:
    """The metrics adapter, on a listening socket."""

    def __init__(
        self,
        settings: MetricsConfig,
        diagnostics: DiagnosticsSource,
        health: HealthSource,
        listener: ListeningSocket,
        *,
        https: Https | None = None,
    ) -> None:
        registry = CollectorRegistry()
        registry.register(Figures(partial(all_metrics, diagnostics)))
        registry.register(Figures(partial(readiness, health)))
        if settings.values:
            registry.register(Figures(partial(tag_metrics, diagnostics)))
        ProcessCollector(registry=registry)
        GCCollector(registry=registry)
        what = "an IP address, localhost, or a name in metrics.hosts"
        name_refusal = f"Host is a name, allowed: {what}"
        names = frozenset(settings.hosts)
        origins = Origins(names=names, name_refusal=name_refusal, is_https=https is not None)
        self._app = App(registry, health, origins)
        self._server = WebServer(
            "metrics",
            self._app,
            listener,
            sources=settings.sources,
            limits=LIMITS,
            request_timeout=REQUEST_TIMEOUT_S,
            https=https,
        )
        self.heartbeat = self._server.heartbeat

    def run(self, stop: Stop) -> None:
        """Serves until `stop` is set."""
        self._server.run(stop)

    def status(self) -> dict[str, object]:
        """Returns the address and the counts of connections."""
        return {
            "address": self._server.address,
            "connections": self._server.counts(),
            "tls_failures": self._server.tls_failures(),
        }


class App(Application):
    """The application: the metrics, and the probes."""

    def __init__(self, registry: CollectorRegistry, health: HealthSource, origins: Origins) -> None:
        metrics = Operation("GET", PATH, "metrics", "", App.export)
        live, ready = (
            Operation("GET", path, "health", "", App.probe, is_public=True) for path in probes.PATHS
        )
        super().__init__((metrics, live, ready), origins)
        self._registry = registry
        self._health = health
        self._exporting = asyncio.Lock()

    def nowhere(self, _: str) -> str:
        """Returns the error for another path."""
        return f"the metrics are at {PATH}, the health at {' and '.join(probes.PATHS)}"

    def error_response(self, _: Request, error: Exception) -> Response:
        """Returns the refusal of a request."""
        if not isinstance(error, BadRequest):
            raise error
        return rejection(STATUSES[error.reason], error.reason, error.detail)

    def probe(self, request: Request, _: object) -> Response:
        """Answers a probe."""
        return probes.answer(self._health, request, shown_to=self.origins)

    async def export(self, request: Request, _: object) -> Response:
        """Returns the metrics.

        A thread formats them, one scrape at a time: the metrics of thousands of devices take long
        enough to delay a probe.
        """
        async with self._exporting:
            return await _in_thread(lambda: self._exported(request))

    def _exported(self, request: Request) -> Response:
        """Returns the metrics in the format and coding that the client accepts."""

        def accepted(name: bytes) -> str:
            return b",".join(request.values(name)).decode("latin-1")

        encode, kind = choose_encoder(accepted(b"accept"))
        names = parse_qs(request.query.decode("latin-1")).get("name[]")
        registry = self._registry if names is None else self._registry.restricted_registry(names)
        answer = response(kind.encode(), encode(cast("CollectorRegistry", registry)))
        if gzip_accepted(accepted(b"accept-encoding")):
            # A time beyond 2106 has no room in the header.
            answer.body = gzip.compress(answer.body, mtime=0)
            answer.headers = (*answer.headers, (b"content-encoding", b"gzip"))
        return answer


async def _in_thread(work: Callable[[], Result]) -> Result:
    """Runs work in a thread that the end of the process does not wait for."""
    done: Future[Result] = Future()

    def run() -> None:
        done.set_running_or_notify_cancel()
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    # Not an executor: its threads are joined at exit, and a scrape may hang in a slow collector.
    threading.Thread(target=run, name="holdfast-scrape", daemon=True).start()
    return await asyncio.wrap_future(done)


class Figures(Collector):
    """Metrics whose names depend on the time of a scrape."""

    def __init__(self, metrics: Callable[[], Iterable[Metric]]) -> None:
        self._metrics = metrics

    def describe(self) -> Iterable[Metric]:
        """Returns no metrics: they are not known before a scrape."""
        return []

    def collect(self) -> Iterable[Metric]:
        """Returns all metrics with their current values."""
        return self._metrics()
