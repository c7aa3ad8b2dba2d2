"""Exports the diagnostics as Prometheus metrics, and answers probes, see docs/metrics.md."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import threading
import time
from typing import TYPE_CHECKING, Any, TypeVar, cast
from urllib.parse import parse_qs

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
)
from prometheus_client.exposition import choose_encoder, gzip_accepted
from prometheus_client.registry import Collector

from holdfast import __version__
from holdfast.tags.text import plain
from holdfast.web import health as probes
from holdfast.web.application import Application
from holdfast.web.host import ConnectionLimits, Host
from holdfast.web.operations import Operation
from holdfast.web.origin import Origins
from holdfast.web.requests import BadRequest, Response, rejection, response

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from prometheus_client.metrics_core import Metric

    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.config import MetricsConfig
    from holdfast.runtime.stop import Stop
    from holdfast.web.health import HealthSource
    from holdfast.web.https import Https
    from holdfast.web.port import ListeningSocket
    from holdfast.web.requests import Request

Result = TypeVar("Result")

LIMITS = ConnectionLimits(32, when_full="evict")
REQUEST_TIMEOUT = 10.0
PATH = "/metrics"
STATUSES = {"malformed": 400, "foreign_page": 403, "not_found": 404, "method_not_allowed": 405}
STATES = ("running", "failed", "stopped")
HEALTH = ("unknown", "ok", "error", "stale", "disabled", "standby")
OUTCOMES = ("valid", "exceptions", "timeouts", "transport_errors")
"""The outcomes of requests to a device."""
EXPIRIES = (
    (
        "certificates",
        "certificate_expiry_timestamp_seconds",
        "Unix time at which the first certificate of a configured file expires.",
    ),
    (
        "revocation_lists",
        "revocation_list_expiry_timestamp_seconds",
        "Unix time of the first nextUpdate in a configured file of revocation lists.",
    ),
)
"""Statistics that are times: their key, metric and description."""
REFUSED = {"refused_source": "source", "refused_role": "role", "refused_full": "full"}
"""The reasons of refused connections, by their keys in the counters."""
REFUSED_REQUESTS = {"refused_listen_only": "listen_only"}
"""The reasons of refused requests, by their keys in the counters of connections."""
CLOSED = {
    "evicted": "evicted",
    "evicted_handshakes": "evicted_handshake",
    "rights_revoked": "rights_revoked",
    "ended": "ended",
    "idle": "idle",
    "request_timeout": "request_timeout",
    "slow_reader": "slow_reader",
    "broken_request": "broken_request",
}
"""The reasons of connections that were closed by this side, by their keys in the counters."""
LINK_OUTCOMES = (
    "replies",
    "timeouts",
    "failures",
    "refused_full",
    "refused_down",
    "coalesced",
    "cached",
    "withdrawn",
)
"""The outcomes of requests of listeners to a link."""


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
        registry.register(Figures(diagnostics))
        registry.register(Readiness(health))
        if settings.values:
            registry.register(TagFigures(diagnostics))
        ProcessCollector(registry=registry)
        GCCollector(registry=registry)
        allowed = ": an IP address, localhost, or a name in metrics.hosts"
        names = frozenset(settings.hosts)
        origins = Origins(names=names, allowed=allowed, is_https=https is not None)
        self._app = App(registry, health, origins)
        self._host = Host(
            "metrics",
            self._app,
            listener,
            sources=settings.sources,
            limits=LIMITS,
            request_timeout=REQUEST_TIMEOUT,
            https=https,
        )
        self.heartbeat = self._host.heartbeat

    def run(self, stop: Stop) -> None:
        """Serves until `stop` is set."""
        self._host.run(stop)

    def status(self) -> dict[str, object]:
        """Returns the address and the counts of connections."""
        return {
            "address": self._host.address,
            "connections": self._host.counts(),
            "tls_failures": self._host.tls_failures(),
        }


class App(Application):
    """The application: the metrics, and the probes."""

    def __init__(self, registry: CollectorRegistry, health: HealthSource, origins: Origins) -> None:
        metrics = Operation("GET", PATH, "metrics", "", App.export)
        live, ready = (
            Operation("GET", path, "health", "", App.probe, is_open=True) for path in probes.PATHS
        )
        super().__init__((metrics, live, ready), origins)
        self._registry = registry
        self._health = health
        self._exporting = asyncio.Lock()

    def nowhere(self, _: str) -> str:
        """Returns the error for another path."""
        return f"the metrics are at {PATH}, the health at {' and '.join(probes.PATHS)}"

    def refused(self, _: Request, error: Exception) -> Response:
        """Returns the refusal of a request."""
        if not isinstance(error, BadRequest):
            raise error
        return rejection(STATUSES[error.reason], error.reason, error.detail)

    def probe(self, request: Request, _: object) -> Response:
        """Answers a probe, whatever its Host. Only whom the metrics are for is shown details."""
        details = self.origins.admits(request)
        return probes.answer(self._health, request.path, details=details)

    async def export(self, request: Request, _: object) -> Response:
        """Returns the metrics.

        They are made in a thread, one scrape at a time: thousands of devices must not hold up a
        probe.
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
            answer.body = gzip.compress(answer.body)
            answer.headers.append((b"content-encoding", b"gzip"))
        return answer


async def _in_thread(work: Callable[[], Result]) -> Result:
    """Runs work in a thread that the end of the process does not wait for."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[Result] = loop.create_future()

    def tell(result: Result | None, error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is None:
            done.set_result(cast("Result", result))
        else:
            done.set_exception(error)

    def run() -> None:
        result, error = None, None
        try:
            result = work()
        except BaseException as caught:
            error = caught
        with contextlib.suppress(RuntimeError):  # The loop is already closed.
            loop.call_soon_threadsafe(tell, result, error)

    threading.Thread(target=run, name="holdfast-scrape", daemon=True).start()
    return await done


class Figures(Collector):
    """Turns the current diagnostics into metrics."""

    def __init__(self, diagnostics: DiagnosticsSource) -> None:
        self._diagnostics = diagnostics

    def describe(self) -> Iterable[Metric]:
        """Returns no metrics: their names depend on the diagnostics at the time of a scrape."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yields all metrics with their current values."""
        stats = self._diagnostics.stats()
        yield InfoMetricFamily(
            "holdfast_build", "The version of Holdfast.", {"version": __version__}
        )
        yield GaugeMetricFamily("holdfast_uptime_seconds", "Time since start.", stats["uptime"])
        yield CounterMetricFamily(
            "holdfast_events_lost",
            "Listener events that were not logged.",
            stats["events_lost"],
        )
        yield CounterMetricFamily(
            "holdfast_log_dropped",
            "Log lines that were dropped because nobody read them.",
            stats["log_dropped"],
        )
        yield from _of_memory_files(stats["memory_files"])
        yield from _of_logs(stats["logs"])
        if stats["audit"] is not None:
            yield CounterMetricFamily(
                "holdfast_audit_lines", "Lines written to the audit log.", stats["audit"]["lines"]
            )
            yield CounterMetricFamily(
                "holdfast_audit_failed",
                "Lines that could not be written to the audit log.",
                stats["audit"]["failed"],
            )
            yield from _of_audit(stats["audit"])
        for key, name, text in EXPIRIES:
            family = _gauge(name, text, "file")
            for file, ends in stats[key].items():
                family.add_metric([file], ends)
            yield family
        yield from _of_listeners(stats["listeners"])
        yield from _of_devices(stats["devices"])
        yield from _of_links(stats["links"])
        yield from _of_adapters(stats["adapters"])
        yield from _of_threads(stats["threads"])
        yield from _of_memories(self._diagnostics.memories())


class Readiness(Collector):
    """Turns the checks of readiness into metrics."""

    def __init__(self, health: HealthSource) -> None:
        self._health = health

    def describe(self) -> Iterable[Metric]:
        """Returns no metrics: the checks are those of the time of a scrape."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yields whether each check has passed."""
        ready = _gauge("ready", "1 if this check of readiness has passed.", "check")
        for name, check in self._health.ready().items():
            ready.add_metric([name], check.ok)
        yield ready


class TagFigures(Collector):
    """Turns the last value of each tag into metrics."""

    def __init__(self, diagnostics: DiagnosticsSource) -> None:
        self._diagnostics = diagnostics

    def describe(self) -> Iterable[Metric]:
        """Returns no metrics: there may be no values yet."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yields the values that are numbers or bits. A tag without a value has no sample."""
        values = _gauge("tag_value", "The value of a tag.", "device", "tag", "unit")
        ages = _gauge("tag_age_seconds", "The age of the value of a tag.", "device", "tag")
        now = time.time()
        for reading in self._diagnostics.tag_values():
            for name, value in _numbers(reading.name, plain(reading.tag, reading.value)):
                values.add_metric([reading.device, name, reading.tag.unit], value)
                ages.add_metric([reading.device, name], max(0.0, now - reading.time))
        yield from (values, ages)


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """A value that is a number or a bit; of an array, each item by its index."""
    if isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numbers(f"{name}[{index}]", item)
    elif isinstance(value, int | float):
        yield name, float(value)


def _of_memory_files(files: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    if not files:
        return
    failing = _gauge("memory_file_failing", "1 if the file could not be written last time.", "file")
    stored = _gauge(
        "memory_file_stored_timestamp_seconds", "Unix time of the last step on the disk.", "file"
    )
    commits = _counter("memory_file_commits", "Times that writes were put on the disk.", "file")
    refused = _counter("memory_file_refused", "Writes refused because of the disk.", "file")
    size = _gauge("memory_file_bytes", "Size of the file.", "file")
    for name, told in files.items():
        failing.add_metric([name], told["failing"] is not None)
        if told["stored_at"] is not None:
            stored.add_metric([name], told["stored_at"])
        commits.add_metric([name], told["commits"])
        refused.add_metric([name], told["refused"])
        size.add_metric([name], told["bytes"])
    yield from (failing, stored, commits, refused, size)


def _of_logs(logs: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    if not logs:
        return
    up = _gauge("log_up", "1 if the node is connected to the log and follows it.", "log")
    lag = _gauge("log_lag", "Messages of the log that are not applied yet.", "log")
    contact = _gauge("log_contact_age_seconds", "Time since the last contact to the log.", "log")
    sequence = _gauge("log_sequence", "The sequence that was applied last.", "log")
    differs = _gauge("log_differs", "1 if other nodes have other contents.", "log")
    steps = _counter("log_steps", "Writes of this node, by outcome.", "log", "outcome")
    ignored = _counter("log_messages_ignored", "Messages that no node has sent.", "log")
    for name, told in logs.items():
        up.add_metric([name], told["phase"] == "running" and told["connected"])
        lag.add_metric([name], told["lag"])
        if told["contact_age"] is not None:
            contact.add_metric([name], told["contact_age"])
        sequence.add_metric([name], told["sequence"])
        differs.add_metric([name], told["digest"] is not None and told["digest"][2] is False)
        ignored.add_metric([name], told["ignored"])
        for outcome, key in (
            ("done", "steps"),
            ("unavailable", "unavailable"),
            ("not_confirmed", "not_confirmed"),
            ("refused", "refused"),
        ):
            steps.add_metric([name, outcome], told[key])
    yield from (up, lag, contact, sequence, differs, steps, ignored)


def _of_audit(audit: Mapping[str, Any]) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "holdfast_audit_failing",
        "1 if the file of the audit log could not be written last time.",
        audit["failing"],
    )
    copies = _counter("audit_copies", "Copies of audit lines, by outcome.", "receiver", "outcome")
    for name, counted in audit["copies"].items():
        for outcome in ("sent", "failed", "dropped"):
            copies.add_metric([name, outcome], counted[outcome])
    yield copies


def _of_listeners(listeners: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    requests = _counter("requests", "Modbus requests, by function code.", "listener", "function")
    exceptions = _counter("exceptions", "Modbus exceptions, by exception code.", "listener", "code")
    more = _counter("listener", "Other counters of a listener.", "listener", "counter")
    connections = _Connections("", "listener")
    packets = _counter(
        "packets_refused", "Raw Ingest packets refused, by reason.", "listener", "reason"
    )
    held = _gauge(
        "packets_held_bytes", "Memory of Raw Ingest packets that are not complete.", "listener"
    )
    refused = _counter("requests_refused", "Requests refused, by reason.", "listener", "reason")
    for name, counters in listeners.items():
        for key, counted in counters.items():
            if key == "requests":
                _add(requests, name, counted)
            elif key == "exceptions":
                _add(exceptions, name, counted)
            elif key == "connections":
                rest = connections.add(name, counted)
                _add(refused, name, _taken(rest, REFUSED_REQUESTS))
                _add(more, name, dict(_flat(key, rest)))
            elif key == "tls_failures":
                _add(connections.tls_failed, name, counted)
            elif key == "packets":
                _add(packets, name, counted["refused"])
                held.add_metric([name], counted["held_bytes"])
                apart = ("refused", "held_bytes")
                rest = {key: value for key, value in counted.items() if key not in apart}
                _add(more, name, dict(_flat(key, rest)))
            else:
                _add(more, name, dict(_flat(key, counted)))
    yield from (requests, exceptions, refused, packets, held)
    yield from (*connections.families(), more)


def _of_devices(devices: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    health = _gauge("device_health", "1 for the current health state.", "device", "state")
    requests = _counter("device_requests", "Requests, by outcome.", "device", "outcome")
    forward = _counter(
        "device_forward",
        "Packets forwarded to a receiver, by outcome.",
        "device",
        "receiver",
        "outcome",
    )
    counters = {
        "polls": _counter("device_polls", "Polls performed.", "device"),
        "missed": _counter(
            "device_missed_polls", "Polls skipped because they were late.", "device"
        ),
        "unplanned": _counter(
            "device_unplanned_polls", "Polls skipped because no plan can read the device.", "device"
        ),
        "reads": _counter("device_reads", "Complete reads.", "device"),
        "values": _counter("device_values", "Bits and registers read.", "device"),
        "unstored": _counter(
            "device_unstored", "Reads and status blocks that memory refused.", "device"
        ),
        **_strays("device"),
    }
    gauges = {
        "age": _gauge("device_age_seconds", "Time since the last valid response.", "device"),
        "seconds_in_error": _gauge(
            "device_error_seconds", "Time since polls began to fail.", "device"
        ),
        "failures": _gauge("device_failures", "Consecutive failed polls.", "device"),
        "last_error": _gauge(
            "device_last_error", "The last error code, as in the status block.", "device"
        ),
        "round_trip": _gauge(
            "device_round_trip_seconds", "Round trip of the last response.", "device"
        ),
        "requests_per_poll": _gauge(
            "device_requests_per_poll", "Requests per poll in the current plan.", "device"
        ),
    }
    labels = ("device", "memory", "area", "address")
    stale = _gauge("mirror_stale", "1 while the values of a device are stale.", *labels)
    since = _gauge(
        "mirror_stale_since_timestamp_seconds", "Unix time since which they are stale.", *labels
    )
    for name, told in devices.items():
        for mirror in told.get("mirrors", ()):
            of = [name, mirror["memory"], mirror["area"], str(mirror["address"])]
            stale.add_metric(of, mirror["stale_since"] is not None)
            if mirror["stale_since"] is not None:
                since.add_metric(of, mirror["stale_since"])
        _add(health, name, {known: known == told["health"] for known in HEALTH})
        _add(requests, name, {key: told[key] for key in OUTCOMES if key in told})
        for key, counter in counters.items():
            if key in told:
                counter.add_metric([name], told[key])
        for key, gauge in gauges.items():
            if told.get(key) is not None:
                gauge.add_metric([name], told[key])
        for number, packets in enumerate(told.get("forward", ())):
            for outcome in ("sent", "refused", "failed", "replaced"):
                forward.add_metric([name, str(number), outcome], packets[outcome])
    yield from (health, requests, *counters.values(), *gauges.values(), forward, stale, since)


def _of_links(links: Mapping[str, Mapping[str, int]]) -> Iterator[Metric]:
    requests = _counter("link_requests", "Requests of listeners, by outcome.", "link", "outcome")
    exceptions = _counter("link_exceptions", "Replies that were exceptions.", "link")
    waiting = _gauge("link_waiting", "Requests that wait for a reply.", "link")
    strays = _strays("link")
    for name, told in links.items():
        _add(requests, name, {outcome: told[outcome] for outcome in LINK_OUTCOMES})
        exceptions.add_metric([name], told["exceptions"])
        waiting.add_metric([name], told["waiting"])
        for key, counter in strays.items():
            counter.add_metric([name], told[key])
    yield from (requests, exceptions, waiting, *strays.values())


def _strays(of: str) -> dict[str, CounterMetricFamily]:
    """What a device or a link has received without a request, by key."""
    texts = {
        "unexpected_replies": "Replies that no request asked for.",
        "stray_bytes": "Bytes received that are no part of a reply to a request.",
        "late_replies": "Replies that came after the timeout of their request.",
        "raised_timeouts": "Requests with more than their timeout, because late replies repeat.",
        "floods": "Pauses because of too many stray bytes.",
    }
    return {key: _counter(f"{of}_{key}", text, of) for key, text in texts.items()}


def _of_adapters(adapters: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    accepted = _counter("ingest_accepted", "Accepted messages.", "adapter")
    values = _counter("ingest_values", "Values written.", "adapter")
    reads = _counter("ingest_reads", "Reads answered.", "adapter")
    refused = _counter("ingest_refused", "Refused messages, by reason.", "adapter", "reason")
    restarts = _counter("adapter_restarts", "Restarts of the adapter.", "adapter")
    states = _gauge("adapter_state", "1 for the current state.", "adapter", "state")
    connections = _Connections("adapter_", "adapter")
    readings = _counter("output_readings", "Readings of an output.", "adapter", "outcome")
    status = _gauge("adapter_status", "Other figures of an adapter.", "adapter", "field")
    plain = {"accepted": accepted, "values": values, "reads": reads, "restarts": restarts}
    for name, fields in adapters.items():
        state = fields.get("state")
        _add(states, name, {known: known == state for known in STATES})
        for key, value in fields.items():
            if key in plain:
                plain[key].add_metric([name], value)
            elif key == "refused":
                _add(refused, name, value)
            elif key == "readings":
                _add(readings, name, value)
            elif key == "connections" and isinstance(value, dict):
                connections.add(name, value)
            elif key == "tls_failures":
                _add(connections.tls_failed, name, value)
            else:
                _add(status, name, dict(_flat(key, value)))
    yield from (accepted, values, reads, refused, readings, restarts, states, status)
    yield from connections.families()


def _of_threads(threads: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    ages = _gauge("thread_heartbeat_age_seconds", "Time since the last heartbeat.", "thread")
    cpu = _counter("thread_cpu_seconds", "Processor time of a thread.", "thread")
    for name, told in threads.items():
        ages.add_metric([name], told["heartbeat_age"])
        if told["cpu"] is not None:
            cpu.add_metric([name], told["cpu"])
    yield from (ages, cpu)


def _of_memories(memories: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    sealed = _gauge("memory_sealed", "1 while the memory refuses Modbus clients.", "memory")
    opened = _counter("memory_seal_opened", "How many times the seal opened.", "memory")
    closed = _counter("memory_seal_closed", "How many times the seal closed again.", "memory")
    size = _gauge("memory_size", "Bits or registers of an area.", "memory", "area")
    for name, memory in memories.items():
        sealed.add_metric([name], memory["sealed"])
        opened.add_metric([name], memory["opened"])
        closed.add_metric([name], memory["closed"])
        _add(size, name, {area: extent["size"] for area, extent in memory["areas"].items()})
    yield from (sealed, opened, closed, size)


def _counter(name: str, text: str, *labels: str) -> CounterMetricFamily:
    return CounterMetricFamily(f"holdfast_{name}", text, labels=labels)


def _gauge(name: str, text: str, *labels: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"holdfast_{name}", text, labels=labels)


def _add(
    family: CounterMetricFamily | GaugeMetricFamily, name: str, counted: Mapping[Any, float]
) -> None:
    for key, value in counted.items():
        family.add_metric([name, str(key)], value)


def _taken(counted: dict[str, int], reasons: Mapping[str, str]) -> dict[str, int]:
    """Removes the counters of these keys. Returns them by reason."""
    return {reason: counted.pop(key) for key, reason in reasons.items() if key in counted}


class _Connections:
    """The metrics of connections: of listeners, or of the HTTP services among the adapters."""

    def __init__(self, prefix: str, label: str) -> None:
        self.opened = _gauge(f"{prefix}connections_open", "Open connections.", label)
        self.accepted = _counter(f"{prefix}connections_accepted", "Accepted connections.", label)
        self.refused = _counter(
            f"{prefix}connections_refused", "Refused connections, by reason.", label, "reason"
        )
        self.closed = _counter(
            f"{prefix}connections_closed",
            "Connections closed by this side, by reason.",
            label,
            "reason",
        )
        self.tls_failed = _counter(
            f"{prefix}tls_failed", "Failures of TLS, by reason.", label, "reason"
        )

    def add(self, name: str, counted: Mapping[str, int]) -> dict[str, int]:
        """Adds the counters of one listener. Returns those that belong to other metrics."""
        rest = dict(counted)
        rest.pop("tls_failed", None)  # The sum of all reasons.
        self.opened.add_metric([name], rest.pop("open", 0))
        self.accepted.add_metric([name], rest.pop("accepted", 0))
        _add(self.refused, name, _taken(rest, REFUSED))
        _add(self.closed, name, _taken(rest, CLOSED))
        return rest

    def families(self) -> Iterator[Metric]:
        """Yields the metrics."""
        yield from (self.opened, self.accepted, self.refused, self.closed, self.tls_failed)


def _flat(key: str, value: object) -> Iterator[tuple[str, float]]:
    """Yields the numbers of nested counters, with their keys joined by underscores."""
    if isinstance(value, dict):
        for inner, more in value.items():
            yield from _flat(f"{key}_{inner}", more)
    elif isinstance(value, int | float):
        yield key, value
