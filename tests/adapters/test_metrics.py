"""Metrics, as Prometheus reads them."""

from __future__ import annotations

import contextlib
import gzip
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families

import holdfast
from holdfast.adapters import Grant, MemoryAccess, Refused
from holdfast.adapters.metrics import Metrics
from holdfast.adapters.metrics.app import LIMITS
from holdfast.appliance.parts.devices import Devices
from holdfast.appliance.parts.mirrors import Mirrors
from holdfast.appliance.services.supervision import Supervisor
from holdfast.config import Config
from holdfast.config.models.services import MetricsConfig
from holdfast.net.http.health import Check
from holdfast.net.http.port import listen
from support import web, wire
from support.machine import needs_127_0_0_2

if TYPE_CHECKING:
    from collections.abc import Iterator

    from prometheus_client.metrics_core import Metric

    from holdfast.appliance.diagnostics import Diagnostics

LISTENER: dict[str, Any] = {
    "requests": {3: 7, 16: 2},
    "exceptions": {2: 1},
    "unanswered": 4,
    "connections": {
        "accepted": 5,
        "refused_source": 1,
        "refused_role": 12,
        "refused_full": 13,
        "refused_listen_only": 14,
        "tls_failed": 9,
        "evicted": 15,
        "rights_revoked": 16,
        "ended": 17,
        "idle": 3,
        "accept_errors": 18,
        "open": 2,
    },
    "tls_failures": {"expired": 4, "not_tls": 5},
    "frames": {"foreign": 6, "broken": 0},
}
RAW: dict[str, Any] = {
    "packets": {"accepted": 9, "held_bytes": 70, "refused": {"crc": 1, "range": 2}},
    "fresh": 8,
    "name": "not a number",
}

LINK: dict[str, int] = {
    "requests": 47,
    "replies": 21,
    "exceptions": 2,
    "timeouts": 3,
    "failures": 4,
    "refused_full": 5,
    "refused_down": 6,
    "coalesced": 1,
    "cached": 7,
    "withdrawn": 0,
    "waiting": 8,
    "unexpected_replies": 31,
    "stray_bytes": 32,
    "late_replies": 33,
    "raised_timeouts": 35,
    "floods": 34,
}

LOG: dict[str, Any] = {
    "phase": "running",
    "connected": True,
    "obstacle": None,
    "digest": (9, "abc", False),
    "contact_age": 0.5,
    "sequence": 9,
    "lag": 1,
    "steps": 61,
    "unavailable": 62,
    "not_confirmed": 63,
    "not_stored": 64,
    "refused": 65,
    "ignored": 66,
}

METER: dict[str, Any] = {
    "health": "error",
    "last_error": 0x8001,
    "seconds_in_error": 4.5,
    "age": 5.5,
    "failures": 3,
    "round_trip": 0.25,
    "requests_per_poll": 2,
    "unexpected_replies": 41,
    "stray_bytes": 42,
    "late_replies": 43,
    "raised_timeouts": 45,
    "floods": 44,
    "polls": 30,
    "missed": 1,
    "unplanned": 6,
    "plan_error": "read 0: field 0: no items",
    "requests": 60,
    "valid": 50,
    "exceptions": 4,
    "timeouts": 5,
    "transport_errors": 1,
    "reads": 29,
    "values": 290,
    "unstored": 7,
    "forward": [{"sent": 20, "refused": 2, "failed": 3, "replaced": 4}],
}


@pytest.fixture
def memories() -> dict[str, holdfast.Memory]:
    return {
        "plant_a": holdfast.Memory(coils=16, holding_registers=(10, 90)),
        "gated": holdfast.Memory(coils=8, seal=("coils", 7, "level")),
    }


@pytest.fixture
def memory_access(memories: dict[str, holdfast.Memory]) -> MemoryAccess:
    return MemoryAccess("rest", memories)


@pytest.fixture
def diagnostics(memories: dict[str, holdfast.Memory], memory_access: MemoryAccess) -> Diagnostics:
    others = web.StandIn({"scada": LISTENER, "replication": RAW}, events_lost=11)
    others.logs = {"site": LOG}
    others.threads = [("holdfast-io-0", 0.25, threading.get_native_id()), ("gone", 7.5, None)]
    made = web.diagnostics_of(memories, others, devices())
    status = {
        "state": "failed",
        "restarts": 3,
        "last_error": "gone",
        "connected": True,
        "messages": {"in": 12},
        "topics": ["a"],
    }
    rest: Any = SimpleNamespace(
        status=lambda: {
            "state": "running",
            "restarts": 0,
            "connections": {"refused_full": 3, "idle": 1, "broken_request": 4, "open": 2},
            "tls_failures": {"not_tls": 6},
            **memory_access.counts(),
        }
    )
    mqtt: Any = SimpleNamespace(status=lambda: status)
    made.adapters = {"rest": rest, "mqtt": mqtt}
    return made


def devices() -> Devices:
    nothing: Any = None
    spare: Any = SimpleNamespace(enabled=False)
    config = Config.model_construct(devices={"spare": spare})
    made = Devices(config, nothing, nothing, Mirrors(config))
    polled: Any = SimpleNamespace(
        counters=lambda: {
            "meter": METER,
            "fresh": {**METER, "health": "unknown", "age": None},
            "nats/1": METER,
        }
    )
    made.poller = polled
    bus: Any = SimpleNamespace(counters=lambda: LINK, error=None)
    made._links = {"bus": bus}
    return made


class Healthy:
    """The health of an appliance, as a test sets it."""

    def __init__(self) -> None:
        self.is_live = self.is_ready = True

    def live(self) -> dict[str, Check]:
        return {"threads": Check(self.is_live, "stalled: io")}

    def ready(self) -> dict[str, Check]:
        return {**self.live(), "logs": Check(self.is_ready, "site: not connected")}


@pytest.fixture
def health() -> Healthy:
    return Healthy()


@pytest.fixture
def address(diagnostics: Diagnostics, health: Healthy) -> Iterator[tuple[str, int]]:
    settings = MetricsConfig.model_validate({"bind": "127.0.0.1:0"})
    listener = listen("127.0.0.1", 0)
    supervisor = Supervisor("metrics", lambda: Metrics(settings, diagnostics, health, listener))
    diagnostics.adapters["metrics"] = supervisor
    with web.supervised(supervisor, listener):
        yield listener.getsockname()


@pytest.fixture
def client(address: tuple[str, int]) -> Iterator[web.Client]:
    with contextlib.closing(web.Client(address)) as connected:
        yield connected


def families(text: str) -> list[Metric]:
    return list(text_string_to_metric_families(text))


def samples(text: str) -> dict[tuple[str, ...], float]:
    """Each sample by its name and the values of its labels."""
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in families(text)
        for sample in family.samples
    }


@pytest.fixture
def scraped(client: web.Client) -> dict[tuple[str, ...], float]:
    answer = client.get("/metrics")
    assert answer.status == 200
    return samples(answer.body.decode())


@pytest.mark.parametrize(
    ("sample", "value"),
    [
        # Labels in the order of their names.
        (("holdfast_build_info", holdfast.__version__), 1),
        (("holdfast_events_lost_total",), 11),
        (("holdfast_requests_total", "3", "scada"), 7),
        (("holdfast_requests_total", "16", "scada"), 2),
        (("holdfast_exceptions_total", "2", "scada"), 1),
        (("holdfast_connections_open", "scada"), 2),
        (("holdfast_connections_accepted_total", "scada"), 5),
        (("holdfast_connections_refused_total", "scada", "source"), 1),
        (("holdfast_connections_refused_total", "scada", "role"), 12),
        (("holdfast_connections_refused_total", "scada", "full"), 13),
        (("holdfast_requests_refused_total", "scada", "listen_only"), 14),
        (("holdfast_connections_closed_total", "scada", "evicted"), 15),
        (("holdfast_connections_closed_total", "scada", "rights_revoked"), 16),
        (("holdfast_connections_closed_total", "scada", "ended"), 17),
        (("holdfast_connections_closed_total", "scada", "idle"), 3),
        (("holdfast_tls_failed_total", "scada", "expired"), 4),
        (("holdfast_tls_failed_total", "scada", "not_tls"), 5),
        (("holdfast_listener_total", "connections_accept_errors", "scada"), 18),
        (("holdfast_listener_total", "unanswered", "scada"), 4),
        (("holdfast_listener_total", "frames_foreign", "scada"), 6),
        (("holdfast_listener_total", "frames_broken", "scada"), 0),
        (("holdfast_listener_total", "fresh", "replication"), 8),
        (("holdfast_listener_total", "packets_accepted", "replication"), 9),
        (("holdfast_packets_held_bytes", "replication"), 70),
        (("holdfast_packets_refused_total", "replication", "crc"), 1),
        (("holdfast_packets_refused_total", "replication", "range"), 2),
        (("holdfast_device_unexpected_replies_total", "meter"), 41),
        (("holdfast_device_stray_bytes_total", "meter"), 42),
        (("holdfast_device_late_replies_total", "meter"), 43),
        (("holdfast_device_floods_total", "meter"), 44),
        (("holdfast_device_health", "meter", "error"), 1),
        (("holdfast_device_health", "meter", "ok"), 0),
        (("holdfast_device_health", "fresh", "unknown"), 1),
        (("holdfast_device_health", "spare", "disabled"), 1),
        (("holdfast_device_requests_total", "meter", "valid"), 50),
        (("holdfast_device_requests_total", "meter", "exceptions"), 4),
        (("holdfast_device_requests_total", "meter", "timeouts"), 5),
        (("holdfast_device_requests_total", "meter", "transport_errors"), 1),
        (("holdfast_device_polls_total", "meter"), 30),
        (("holdfast_device_missed_polls_total", "meter"), 1),
        (("holdfast_device_unplanned_polls_total", "meter"), 6),
        (("holdfast_device_reads_total", "meter"), 29),
        (("holdfast_device_values_total", "meter"), 290),
        (("holdfast_device_unstored_total", "meter"), 7),
        (("holdfast_device_age_seconds", "meter"), 5.5),
        (("holdfast_device_error_seconds", "meter"), 4.5),
        (("holdfast_device_failures", "meter"), 3),
        (("holdfast_device_last_error", "meter"), 0x8001),
        (("holdfast_device_round_trip_seconds", "meter"), 0.25),
        (("holdfast_device_requests_per_poll", "meter"), 2),
        (("holdfast_device_forward_total", "meter", "sent", "0"), 20),
        (("holdfast_device_forward_total", "meter", "replaced", "0"), 4),
        (("holdfast_link_requests_total", "bus", "replies"), 21),
        (("holdfast_link_requests_total", "bus", "timeouts"), 3),
        (("holdfast_link_requests_total", "bus", "failures"), 4),
        (("holdfast_link_requests_total", "bus", "refused_full"), 5),
        (("holdfast_link_requests_total", "bus", "refused_down"), 6),
        (("holdfast_link_requests_total", "bus", "coalesced"), 1),
        (("holdfast_link_requests_total", "bus", "cached"), 7),
        (("holdfast_link_requests_total", "bus", "withdrawn"), 0),
        (("holdfast_link_exceptions_total", "bus"), 2),
        (("holdfast_link_waiting", "bus"), 8),
        (("holdfast_log_up", "site"), 1),
        (("holdfast_log_lag", "site"), 1),
        (("holdfast_log_sequence", "site"), 9),
        (("holdfast_log_contact_age_seconds", "site"), 0.5),
        (("holdfast_log_differs", "site"), 1),
        (("holdfast_log_messages_ignored_total", "site"), 66),
        (("holdfast_log_steps_total", "site", "done"), 61),
        (("holdfast_log_steps_total", "site", "unavailable"), 62),
        (("holdfast_log_steps_total", "site", "not_confirmed"), 63),
        (("holdfast_log_steps_total", "site", "not_stored"), 64),
        (("holdfast_log_steps_total", "site", "refused"), 65),
        (("holdfast_adapter_state", "rest", "running"), 1),
        (("holdfast_adapter_state", "rest", "failed"), 0),
        (("holdfast_adapter_state", "mqtt", "failed"), 1),
        (("holdfast_adapter_restarts_total", "mqtt"), 3),
        (("holdfast_adapter_connections_open", "rest"), 2),
        (("holdfast_adapter_connections_refused_total", "rest", "full"), 3),
        (("holdfast_adapter_connections_closed_total", "rest", "idle"), 1),
        (("holdfast_adapter_connections_closed_total", "rest", "broken_request"), 4),
        (("holdfast_adapter_tls_failed_total", "rest", "not_tls"), 6),
        (("holdfast_adapter_status", "mqtt", "connected"), 1),
        (("holdfast_adapter_status", "mqtt", "messages_in"), 12),
        (("holdfast_adapter_state", "metrics", "running"), 1),
        (("holdfast_adapter_connections_open", "metrics"), 1),
        (("holdfast_memory_sealed", "gated"), 1),
        (("holdfast_memory_sealed", "plant_a"), 0),
        (("holdfast_memory_seal_opened_total", "gated"), 0),
        (("holdfast_memory_size", "coils", "plant_a"), 16),
        (("holdfast_memory_size", "holding_registers", "plant_a"), 90),
    ],
)
def test_every_counter_is_there(
    scraped: dict[tuple[str, ...], float], sample: tuple[str, ...], value: float
) -> None:
    assert scraped[sample] == value


def test_threads_have_a_heartbeat_and_the_processor_time_that_the_system_knows(
    scraped: dict[tuple[str, ...], float],
) -> None:
    assert scraped["holdfast_thread_heartbeat_age_seconds", "holdfast-io-0"] == 0.25
    assert scraped["holdfast_thread_heartbeat_age_seconds", "gone"] == 7.5
    assert ("holdfast_thread_cpu_seconds_total", "gone") not in scraped
    if sys.platform == "linux":
        assert scraped["holdfast_thread_cpu_seconds_total", "holdfast-io-0"] > 0


def test_what_the_process_does_is_there(scraped: dict[tuple[str, ...], float]) -> None:
    names = {name for name, *_ in scraped}
    assert "holdfast_connections_total" not in names
    assert not [
        key for key in scraped if key[0] == "holdfast_listener_total" and "refuse" in key[1]
    ]
    assert ("holdfast_device_age_seconds", "fresh") not in scraped
    assert ("holdfast_device_polls_total", "spare") not in scraped
    assert scraped["holdfast_uptime_seconds",] >= 0
    assert ("python_gc_collections_total", "0") in scraped
    if ("process_open_fds",) in scraped:
        assert scraped["process_open_fds",] > 0


def test_the_result_of_the_last_reload_is_there(
    client: web.Client, diagnostics: Diagnostics
) -> None:
    def shown() -> list[float]:
        seen = samples(client.get("/metrics").body.decode())
        names = ("holdfast_reload_failed", "holdfast_reload_success_timestamp_seconds")
        return [seen[name,] for name in names]

    failed, start = shown()
    assert (failed, start > 0) == (0, True)
    diagnostics.note_reload(is_done=False)
    assert shown() == [1, start]
    diagnostics.note_reload(is_done=True)
    failed, at = shown()
    assert (failed, at >= start) == (0, True)


def test_it_shows_the_moment(
    client: web.Client, memory_access: MemoryAccess, memories: dict[str, holdfast.Memory]
) -> None:
    grant = Grant("test", {"plant_a", "gated"}, web.AREAS)
    memory_access.write(
        [web.command("coils", 0, [1, 1]), web.command("coils", 7, [1], "gated")], grant, "-"
    )
    with pytest.raises(Refused):
        memory_access.write([web.command("coils", 0, [2])], grant, "-")
    memory_access.read("plant_a", "coils", 0, 1, grant, "-")
    memories["gated"].write("coils", 7, [0])
    seen = samples(client.get("/metrics").body.decode())
    assert seen["holdfast_ingest_accepted_total", "rest"] == 1
    assert seen["holdfast_ingest_values_total", "rest"] == 3
    assert seen["holdfast_ingest_reads_total", "rest"] == 1
    assert seen["holdfast_ingest_refused_total", "rest", "invalid_value"] == 1
    assert seen["holdfast_memory_seal_opened_total", "gated"] == 1
    assert seen["holdfast_memory_seal_closed_total", "gated"] == 1
    assert seen["holdfast_memory_sealed", "gated"] == 1


AUDIT = {
    "lines": 5,
    "failed": 1,
    "waiting": 0,
    "failing": True,
    "copies": {"syslog": {"sent": 3, "failed": 2, "dropped": 1, "waiting": 4}},
}


def test_a_connected_log_without_contact_is_not_up(
    client: web.Client, diagnostics: Diagnostics
) -> None:
    late = LOG | {"contact_age": 68.9, "obstacle": "last contact 68.9 s ago, allowed 5 s"}
    web.stand_in(diagnostics).logs = {"site": late}
    assert samples(client.get("/metrics").body.decode())["holdfast_log_up", "site"] == 0


@pytest.mark.parametrize("audit", [None, AUDIT])
def test_the_audit_log_when_there_is_one(
    client: web.Client, diagnostics: Diagnostics, audit: dict[str, object] | None
) -> None:
    web.stand_in(diagnostics).audit = audit
    seen = samples(client.get("/metrics").body.decode())
    assert seen.get(("holdfast_audit_lines_total",)) == (None if audit is None else 5)
    assert seen.get(("holdfast_audit_failed_total",)) == (None if audit is None else 1)
    assert seen.get(("holdfast_audit_failing",)) == (None if audit is None else 1)
    copies = {key[1:]: value for key, value in seen.items() if "audit_copies" in key[0]}
    assert copies == (
        {}
        if audit is None
        else {("sent", "syslog"): 3, ("failed", "syslog"): 2, ("dropped", "syslog"): 1}
    )


def test_a_real_server_is_shown(
    client: web.Client, diagnostics: Diagnostics, server: holdfast.Server
) -> None:
    with wire.Connection(server.address) as modbus:
        modbus.ask(bytes.fromhex("0300000001"))
        modbus.ask(bytes.fromhex("03ffff0002"))
        web.stand_in(diagnostics).listeners = {"real": server.counters()}
        seen = samples(client.get("/metrics").body.decode())
    assert seen["holdfast_requests_total", "3", "real"] == 2
    assert seen["holdfast_exceptions_total", "2", "real"] == 1
    assert seen["holdfast_connections_open", "real"] == 1


def test_no_counter_of_a_real_listener_is_forgotten(
    client: web.Client, diagnostics: Diagnostics, server: holdfast.Server
) -> None:
    """What a listener newly counts as refused or closed belongs to a metric with its reason."""
    counters = server.counters()
    web.stand_in(diagnostics).listeners = {"real": counters}
    seen = samples(client.get("/metrics").body.decode())
    others = {key[1] for key in seen if key[0] == "holdfast_listener_total"}
    assert {name for name in others if name.startswith("connections")} == {
        "connections_accept_errors"
    }


def test_names_follow_the_conventions(client: web.Client) -> None:
    text = client.get("/metrics").body.decode()
    for family in families(text):
        assert family.documentation
        if family.name.startswith("holdfast_") and family.type == "counter":
            assert all(sample.name.endswith("_total") for sample in family.samples)
        assert family.type != "unknown"


def test_openmetrics_when_it_is_asked_for(client: web.Client) -> None:
    accept = {"Accept": "application/openmetrics-text; version=1.0.0"}
    answer = client.ask("GET", "/metrics", headers=accept)
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    text = answer.body.decode()
    assert text.endswith("# EOF\n")
    parsed: list[Metric] = list(openmetrics.text_string_to_metric_families(text))  # type: ignore[no-untyped-call]
    names = {family.name for family in parsed}
    assert {"holdfast_requests", "holdfast_build", "holdfast_memory_sealed"} <= names


def test_plain_text_otherwise_and_compressed_when_asked_for(client: web.Client) -> None:
    plain = client.get("/metrics")
    assert plain.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert plain.headers["cache-control"] == "no-store"
    packed = client.ask("GET", "/metrics", headers={"Accept-Encoding": "gzip"})
    assert packed.headers["content-encoding"] == "gzip"
    assert (
        samples(gzip.decompress(packed.body).decode()).keys() == samples(plain.body.decode()).keys()
    )


def test_a_time_that_gzip_has_no_room_for(
    client: web.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time", lambda: 2.0**32)
    assert client.ask("GET", "/metrics", headers={"Accept-Encoding": "gzip"}).status == 200


def test_head_and_other_methods(client: web.Client) -> None:
    assert client.ask("HEAD", "/metrics").status == 200
    options = client.ask("OPTIONS", "/metrics")
    assert (options.status, options.headers["allow"]) == (204, "GET, HEAD, OPTIONS")
    post = client.ask("POST", "/metrics", b"{}")
    assert (post.status, post.headers["allow"]) == (405, "GET, HEAD, OPTIONS")


def test_probes_are_answered_by_status_and_each_check(client: web.Client, health: Healthy) -> None:
    assert client.get("/health/ready").status == 200
    health.is_ready = False
    assert client.get("/health/live").status == 200
    answer = client.get("/health/ready")
    assert (answer.status, answer.headers["cache-control"]) == (503, "no-store")
    assert answer.json == {
        "ok": False,
        "checks": {
            "threads": {"ok": True, "detail": "stalled: io"},
            "logs": {"ok": False, "detail": "site: not connected"},
        },
    }
    seen = samples(client.get("/metrics").body.decode())
    assert (seen["holdfast_ready", "threads"], seen["holdfast_ready", "logs"]) == (1, 0)
    health.is_live = False
    assert client.get("/health/live").status == 503


@needs_127_0_0_2
@pytest.mark.parametrize("path", ["/metrics", "/health/live"])
def test_one_source_can_not_take_all_places(address: tuple[str, int], path: str) -> None:
    assert web.status_for_another(address, path, LIMITS.max_connections) == 200


def test_a_slow_scrape_holds_up_no_probe(
    address: tuple[str, int], diagnostics: Diagnostics, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, finish = threading.Event(), threading.Event()
    stats = diagnostics.stats

    def slow() -> dict[str, Any]:
        begun.set()
        finish.wait()
        return stats()

    monkeypatch.setattr(diagnostics, "stats", slow)
    with (
        contextlib.closing(web.Client(address)) as scraper,
        contextlib.closing(web.Client(address)) as prober,
        ThreadPoolExecutor(1) as threads,
    ):
        scrape = threads.submit(scraper.get, "/metrics")
        try:
            assert begun.wait(wire.DEADLINE)
            assert prober.get("/health/ready").status == 200
            assert not scrape.done()
        finally:
            finish.set()
        assert scrape.result(wire.DEADLINE).status == 200


@pytest.mark.parametrize("path", ["/health/live", "/health/ready"])
def test_probes_take_head_and_nothing_that_changes(
    client: web.Client, health: Healthy, path: str
) -> None:
    for health.is_live, status in ((True, 200), (False, 503)):
        answer = client.ask("HEAD", path)
        assert (answer.status, answer.body) == (status, b"")
        assert int(answer.headers["content-length"]) > 0
    assert client.ask("OPTIONS", path).headers["allow"] == "GET, HEAD, OPTIONS"
    assert client.ask("POST", path, b"{}").status == 405


@pytest.mark.parametrize(
    "path", ["/", "/metrics/", "/health", "/health/ready/", "/api/v1/health", "/openapi.json"]
)
def test_nothing_else_is_there(client: web.Client, path: str) -> None:
    answer = client.get(path)
    assert answer.status == 404
    assert "/metrics" in answer.json["detail"]


def test_a_name_of_any_kind_is_quoted(client: web.Client, diagnostics: Diagnostics) -> None:
    name = 'a"b\\c\nd'
    web.stand_in(diagnostics).listeners[name] = {"requests": {3: 1}}
    seen = samples(client.get("/metrics").body.decode())
    assert seen["holdfast_requests_total", "3", name] == 1


def test_a_fault_of_one_part_is_answered_without_a_detail(
    client: web.Client, diagnostics: Diagnostics
) -> None:
    web.stand_in(diagnostics).listeners["broken"] = None
    answer = client.get("/metrics")
    assert (answer.status, answer.json["reason"]) == (500, "internal_error")
    del web.stand_in(diagnostics).listeners["broken"]
    assert client.get("/metrics").status == 200
