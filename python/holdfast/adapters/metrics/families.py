"""The metrics: their names, texts and labels, and the diagnostics that they show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
)

from holdfast import __version__
from holdfast.adapters.diagnostics import HEALTH
from holdfast.tags.text import plain

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from prometheus_client.metrics_core import Metric

    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.net.http.health import HealthSource

STATES = ("running", "failed", "stopped")
OUTCOMES = ("valid", "exceptions", "timeouts", "transport_errors")
"""The outcomes of requests to a device."""
TOTALS = {
    "events_lost": "Listener events that were not logged.",
    "log_dropped": "Log lines that nobody read, or that could not be written.",
    "tag_polls_dropped": "Polls whose values no output got, because too many came.",
}
"""The counters without labels: their key and description."""
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
LOG_OUTCOMES = ("unavailable", "not_confirmed", "not_stored", "refused")
"""The outcomes of writes of this node to a log, besides `done`."""
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


def all_metrics(diagnostics: DiagnosticsSource) -> Iterator[Metric]:
    """Yields the current diagnostics."""
    stats = diagnostics.stats()
    audit = stats["audit"]
    yield InfoMetricFamily("holdfast_build", "The version of Holdfast.", {"version": __version__})
    yield GaugeMetricFamily("holdfast_uptime_seconds", "Time since start.", stats["uptime"])
    for key, text in TOTALS.items():
        yield CounterMetricFamily(f"holdfast_{key}", text, stats[key])
    yield GaugeMetricFamily(
        "holdfast_reload_failed",
        "1 if the last reload was refused: the files are not the configuration that runs.",
        stats["reload"]["failed"],
    )
    yield GaugeMetricFamily(
        "holdfast_reload_success_timestamp_seconds",
        "Unix time of the last reload that was not refused, or of the start.",
        stats["reload"]["succeeded_at"],
    )
    if stats["memory_files"]:
        files = {
            name: file | {"is_failing": file["failing"] is not None}
            for name, file in stats["memory_files"].items()
        }
        yield from _figures("file", files, MEMORY_FILE_COUNTERS, MEMORY_FILE_GAUGES)
    if stats["logs"]:
        yield from _log_metrics(stats["logs"])
    if audit is not None:
        yield from _audit_metrics(audit)
    for key, name, text in EXPIRIES:
        family = _gauge(name, text, "file")
        for file, ends in stats[key].items():
            family.add_metric([file], ends)
        yield family
    yield from _listener_metrics(stats["listeners"])
    yield from _device_metrics(stats["devices"])
    yield from _link_metrics(stats["links"])
    yield from _adapter_metrics(stats["adapters"])
    yield from _figures("thread", stats["threads"], THREAD_COUNTERS, THREAD_GAUGES)
    yield from _memory_metrics(diagnostics.memories())


def readiness(health: HealthSource) -> Iterator[Metric]:
    """Yields whether each check of readiness has passed."""
    ready = _gauge("ready", "1 if this check of readiness has passed.", "check")
    for name, check in health.ready().items():
        ready.add_metric([name], check.ok)
    yield ready


def tag_metrics(diagnostics: DiagnosticsSource) -> Iterator[Metric]:
    """Yields the values that are numbers or bits. A tag without a value has no sample."""
    values = _gauge("tag_value", "The value of a tag.", "device", "tag", "unit")
    ages = _gauge("tag_age_seconds", "The age of the value of a tag.", "device", "tag")
    for reading, age in diagnostics.tag_values():
        for name, value in _numbers(reading.name, plain(reading.tag, reading.value)):
            values.add_metric([reading.device, name, reading.tag.unit], value)
            ages.add_metric([reading.device, name], age)
    yield from (values, ages)


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yields a number or bit with its name, and the items of an array as `name[index]`."""
    if isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numbers(f"{name}[{index}]", item)
    elif isinstance(value, int | float):
        yield name, float(value)


def _figures(
    label: str,
    every: Mapping[str, Mapping[str, Any]],
    counters: Mapping[str, tuple[str, str]],
    gauges: Mapping[str, tuple[str, str]],
) -> Iterator[Metric]:
    """Yields metrics with one value for each owner, which `label` names.

    `counters` and `gauges` have name and description by the key in the statistics of an owner. One
    that lacks the key, or has `None` there, has no sample.
    """
    for make, figures in ((_counter, counters), (_gauge, gauges)):
        for key, (name, text) in figures.items():
            family = make(name, text, label)
            for owner, stats in every.items():
                if stats.get(key) is not None:
                    family.add_metric([owner], stats[key])
            yield family


MEMORY_FILE_COUNTERS = {
    "commits": ("memory_file_commits", "How often writes were stored on the disk."),
    "refused": ("memory_file_refused", "Writes refused because of the disk."),
    "busy": ("memory_file_busy", "Writes refused because too many waited for the disk."),
}
MEMORY_FILE_GAUGES = {
    "is_failing": ("memory_file_failing", "1 while the file can't be written."),
    "pending": ("memory_file_pending", "Writes that are not on the disk."),
    "stored_at": (
        "memory_file_stored_timestamp_seconds",
        "Unix time of the last write to the disk.",
    ),
    "bytes": ("memory_file_bytes", "Size of the file."),
}
LOG_COUNTERS = {"ignored": ("log_messages_ignored", "Messages that no node has sent.")}
LOG_GAUGES = {
    "is_up": ("log_up", "1 if the node follows the log: its contents are at most max_lag old."),
    "lag": ("log_lag", "Messages of the log that are not applied yet."),
    "contact_age": ("log_contact_age_seconds", "Time since contents were surely current."),
    "sequence": ("log_sequence", "The sequence that was applied last."),
    "differs": ("log_differs", "1 if other nodes have other contents."),
}
THREAD_COUNTERS = {"cpu": ("thread_cpu_seconds", "Processor time of a thread.")}
THREAD_GAUGES = {
    "heartbeat_age": ("thread_heartbeat_age_seconds", "Time since the last heartbeat."),
}
MEMORY_COUNTERS = {
    "opened": ("memory_seal_opened", "How many times the seal opened."),
    "closed": ("memory_seal_closed", "How many times the seal closed again."),
}
MEMORY_GAUGES = {"sealed": ("memory_sealed", "1 while the memory refuses Modbus clients.")}
ADAPTER_COUNTERS = {
    "accepted": ("ingest_accepted", "Accepted messages."),
    "values": ("ingest_values", "Values written."),
    "reads": ("ingest_reads", "Reads answered."),
    "restarts": ("adapter_restarts", "Restarts of the adapter."),
}


def _stray_counters(owner: str) -> dict[str, tuple[str, str]]:
    """Returns counters for data that a device or a link received without a request."""
    texts = {
        "unexpected_replies": "Replies that no request asked for.",
        "stray_bytes": "Bytes received that are no part of a reply to a request.",
        "late_replies": "Replies that came after the timeout of their request.",
        "raised_timeouts": "Requests with a raised timeout, because of repeated late replies.",
        "floods": "Pauses because of too many stray bytes.",
    }
    return {key: (f"{owner}_{key}", text) for key, text in texts.items()}


DEVICE_COUNTERS = {
    "polls": ("device_polls", "Polls performed."),
    "missed": ("device_missed_polls", "Polls skipped because they were late."),
    "unplanned": ("device_unplanned_polls", "Polls skipped because no plan can read the device."),
    "reads": ("device_reads", "Complete reads."),
    "values": ("device_values", "Bits and registers read."),
    "unstored": ("device_unstored", "Reads and status blocks that memory refused."),
    **_stray_counters("device"),
}
DEVICE_GAUGES = {
    "age": ("device_age_seconds", "Time since the last valid response."),
    "seconds_in_error": ("device_error_seconds", "Time since polls began to fail."),
    "failures": ("device_failures", "Consecutive failed polls."),
    "last_error": ("device_last_error", "The last error code, as in the status block."),
    "round_trip": ("device_round_trip_seconds", "Round trip of the last response."),
    "requests_per_poll": ("device_requests_per_poll", "Requests per poll in the current plan."),
}
LINK_COUNTERS = {
    "exceptions": ("link_exceptions", "Replies that were exceptions."),
    **_stray_counters("link"),
}
LINK_GAUGES = {"waiting": ("link_waiting", "Requests that wait for a reply.")}


def _log_metrics(logs: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    steps = _counter("log_steps", "Writes of this node, by outcome.", "log", "outcome")
    figures = {}
    for name, stats in logs.items():
        is_up = stats["obstacle"] is None
        differs = stats["digest"] is not None and stats["digest"][2] is False
        figures[name] = {**stats, "is_up": is_up, "differs": differs}
        # A label has the name in docs/metrics.md, the key that of the core.
        _add(steps, name, {"done": stats["steps"], **{key: stats[key] for key in LOG_OUTCOMES}})
    yield from _figures("log", figures, LOG_COUNTERS, LOG_GAUGES)
    yield steps


def _audit_metrics(audit: Mapping[str, Any]) -> Iterator[Metric]:
    yield CounterMetricFamily(
        "holdfast_audit_lines", "Lines written to the audit log.", audit["lines"]
    )
    yield CounterMetricFamily(
        "holdfast_audit_failed",
        "Lines that could not be written to the audit log.",
        audit["failed"],
    )
    yield GaugeMetricFamily(
        "holdfast_audit_failing",
        "1 if the file of the audit log could not be written last time.",
        audit["failing"],
    )
    copies = _counter("audit_copies", "Copies of audit lines, by outcome.", "receiver", "outcome")
    for name, counted in audit["copies"].items():
        _add(copies, name, {key: counted[key] for key in ("sent", "failed", "dropped")})
    yield copies


def _listener_metrics(listeners: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    requests = _counter("requests", "Modbus requests, by function code.", "listener", "function")
    exceptions = _counter("exceptions", "Modbus exceptions, by exception code.", "listener", "code")
    more = _counter("listener", "Other counters of a listener.", "listener", "counter")
    connections = _Connections("", "listener")
    packets = _counter(
        "packets_refused", "Raw Ingest packets refused, by reason.", "listener", "reason"
    )
    held_bytes = _gauge(
        "packets_held_bytes", "Memory of Raw Ingest packets that are not complete.", "listener"
    )
    refused = _counter("requests_refused", "Requests refused, by reason.", "listener", "reason")
    by_label = {
        "requests": requests,
        "exceptions": exceptions,
        "tls_failures": connections.tls_failed,
    }
    for name, counters in listeners.items():
        for key, counted in counters.items():
            if key in by_label:
                _add(by_label[key], name, counted)
            elif key == "connections":
                remaining = connections.add(name, counted)
                _add(refused, name, _take_reasons(remaining, REFUSED_REQUESTS))
                _add(more, name, dict(_flat(key, remaining)))
            elif key == "packets":
                _add(packets, name, counted["refused"])
                held_bytes.add_metric([name], counted["held_bytes"])
                separate = ("refused", "held_bytes")
                remaining = {key: value for key, value in counted.items() if key not in separate}
                _add(more, name, dict(_flat(key, remaining)))
            else:
                _add(more, name, dict(_flat(key, counted)))
    yield from (requests, exceptions, refused, packets, held_bytes)
    yield from (*connections.families(), more)


def _device_metrics(devices: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    health = _gauge("device_health", "1 for the current health state.", "device", "state")
    requests = _counter("device_requests", "Requests, by outcome.", "device", "outcome")
    forward = _counter(
        "device_forward",
        "Packets forwarded to a receiver, by outcome.",
        "device",
        "receiver",
        "outcome",
    )
    labels = ("device", "memory", "area", "address")
    stale = _gauge("mirror_stale", "1 while the values of a device are stale.", *labels)
    since = _gauge(
        "mirror_stale_since_timestamp_seconds", "Unix time at which values became stale.", *labels
    )
    for name, stats in devices.items():
        for mirror in stats.get("mirrors", ()):
            label_values = [name, mirror["memory"], mirror["area"], str(mirror["address"])]
            stale.add_metric(label_values, mirror["stale_since"] is not None)
            if mirror["stale_since"] is not None:
                since.add_metric(label_values, mirror["stale_since"])
        _add(health, name, {known: known == stats["health"] for known in HEALTH})
        _add(requests, name, {key: stats[key] for key in OUTCOMES if key in stats})
        for number, packets in enumerate(stats.get("forward", ())):
            for outcome in ("sent", "refused", "failed", "replaced"):
                forward.add_metric([name, str(number), outcome], packets[outcome])
    yield from (health, requests)
    yield from _figures("device", devices, DEVICE_COUNTERS, DEVICE_GAUGES)
    yield from (forward, stale, since)


def _link_metrics(links: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    requests = _counter("link_requests", "Requests of listeners, by outcome.", "link", "outcome")
    for name, stats in links.items():
        _add(requests, name, {outcome: stats[outcome] for outcome in LINK_OUTCOMES})
    yield requests
    yield from _figures("link", links, LINK_COUNTERS, LINK_GAUGES)


def _adapter_metrics(adapters: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    refused = _counter("ingest_refused", "Refused messages, by reason.", "adapter", "reason")
    states = _gauge("adapter_state", "1 for the current state.", "adapter", "state")
    connections = _Connections("adapter_", "adapter")
    readings = _counter("output_readings", "Readings of an output.", "adapter", "outcome")
    status = _gauge("adapter_status", "Other figures of an adapter.", "adapter", "field")
    by_label = {"refused": refused, "readings": readings, "tls_failures": connections.tls_failed}
    for name, fields in adapters.items():
        state = fields.get("state")
        _add(states, name, {known: known == state for known in STATES})
        for key, value in fields.items():
            if key in ADAPTER_COUNTERS:
                continue
            if key in by_label:
                _add(by_label[key], name, value)
            elif key == "connections" and isinstance(value, dict):
                connections.add(name, value)
            else:
                _add(status, name, dict(_flat(key, value)))
    yield from _figures("adapter", adapters, ADAPTER_COUNTERS, {})
    yield from (refused, readings, states, status)
    yield from connections.families()


def _memory_metrics(memories: Mapping[str, Mapping[str, Any]]) -> Iterator[Metric]:
    size = _gauge("memory_size", "Bits or registers of an area.", "memory", "area")
    for name, memory in memories.items():
        _add(size, name, {area: extent["size"] for area, extent in memory["areas"].items()})
    yield from _figures("memory", memories, MEMORY_COUNTERS, MEMORY_GAUGES)
    yield size


def _counter(name: str, text: str, *labels: str) -> CounterMetricFamily:
    return CounterMetricFamily(f"holdfast_{name}", text, labels=labels)


def _gauge(name: str, text: str, *labels: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"holdfast_{name}", text, labels=labels)


def _add(
    family: CounterMetricFamily | GaugeMetricFamily, name: str, counted: Mapping[Any, float]
) -> None:
    for key, value in counted.items():
        family.add_metric([name, str(key)], value)


def _take_reasons(counted: dict[str, int], reasons: Mapping[str, str]) -> dict[str, int]:
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
        remaining = dict(counted)
        remaining.pop("tls_failed", None)  # The sum of all reasons.
        self.opened.add_metric([name], remaining.pop("open", 0))
        self.accepted.add_metric([name], remaining.pop("accepted", 0))
        _add(self.refused, name, _take_reasons(remaining, REFUSED))
        _add(self.closed, name, _take_reasons(remaining, CLOSED))
        return remaining

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
