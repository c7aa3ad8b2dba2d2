"""Links of an appliance in its diagnostics, over REST and as metrics."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from holdfast.adapters.rest.operations import document
from support import web, wire
from support.fake_device import Stream, exception
from support.routed import await_count, configuration, counters
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300050001")
NONE = dict.fromkeys(
    (
        "requests",
        "replies",
        "exceptions",
        "timeouts",
        "failures",
        "refused_full",
        "refused_down",
        "coalesced",
        "cached",
        "withdrawn",
        "waiting",
        "unexpected_replies",
        "stray_bytes",
        "late_replies",
        "raised_timeouts",
        "floods",
    ),
    0,
)


@pytest.fixture
def device() -> Iterator[Stream]:
    with Stream("tcp") as made:
        yield made


def ask(appliance: Appliance, pdu: bytes, unit: int = 1) -> bytes:
    """Sends one request. Afterwards nothing waits, also in the counters."""
    with wire.Connection(endpoint(appliance, "scada")) as client:
        reply = client.ask(pdu, unit)
    for link in appliance.diagnostics.stats()["links"]:
        await_count(appliance, "waiting", 0, link)
    return reply


def test_a_link_counts_its_requests(device: Stream, run: Run) -> None:
    appliance = run(configuration(device.url))
    assert counters(appliance) == NONE

    ask(appliance, READ)
    ask(appliance, bytes.fromhex("03ffff0001"))

    assert counters(appliance) == NONE | {"requests": 2, "replies": 2, "exceptions": 1}


def test_devices_at_one_address_are_one_link_with_the_name_of_the_first(
    device: Stream, run: Run
) -> None:
    devices = {name: {"url": device.url, "unit": 1} for name in ("pump", "valve")}
    units: dict[int | str, Any] = {5: {"route": "valve"}, 6: {"route": "pump"}}
    appliance = run(configuration("tcp://127.0.0.1:1", units=units, devices=devices))
    for unit in units:
        ask(appliance, READ, int(unit))

    stats = appliance.diagnostics.stats()["links"]
    assert {name: link["replies"] for name, link in stats.items()} == {"bus": 0, "valve": 2}


def test_a_device_at_the_address_of_a_link_counts_as_that_link(device: Stream, run: Run) -> None:
    units: dict[int | str, Any] = {5: {"route": "pump"}}
    devices = {"pump": {"url": device.url, "unit": 1}}
    appliance = run(configuration(device.url, units=units, devices=devices))
    ask(appliance, READ, 5)

    assert appliance.diagnostics.stats()["links"] == {"bus": NONE | {"requests": 1, "replies": 1}}


def test_an_appliance_without_routes_has_no_links(run: Run) -> None:
    appliance = run(
        "memories: {plant: {coils: 8}}\nlisteners: {scada: {type: modbus-tcp, "
        "bind: '127.0.0.1:0', rules: [{sources: [127.0.0.1], access: read-only, "
        "units: {1: plant}}]}}\n"
    )
    assert appliance.diagnostics.stats()["links"] == {}


def test_rest_tells_the_counters_as_it_describes_them(device: Stream, run: Run) -> None:
    rest = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"], "tokens": "none"}
    memories = {"plant": {"coils": 8}}
    appliance = run(configuration(device.url, rest=rest, memories=memories))
    assert ask(appliance, READ, unit=2) == exception(READ, 0x0B)

    with contextlib.closing(web.Client(endpoint(appliance, "rest"))) as client:
        told = client.get("/api/v1/diagnostics/stats").json["links"]
    schemas = document("1.0", 1024, secured=False)["components"]["schemas"]
    described = schemas["Stats"]["properties"]["links"]["additionalProperties"]
    assert set(told["bus"]) == set(described["required"]) == set(described["properties"])
    assert told == {"bus": NONE | {"requests": 1, "replies": 1, "exceptions": 1}}


def test_metrics_have_the_counters(device: Stream, run: Run) -> None:
    metrics = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"]}
    appliance = run(configuration(device.url, metrics=metrics))
    ask(appliance, READ)

    with contextlib.closing(web.Client(endpoint(appliance, "metrics"))) as client:
        text = client.get("/metrics").body.decode()
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert samples["holdfast_link_requests_total", "bus", "replies"] == 1
    assert samples["holdfast_link_exceptions_total", "bus"] == 0
    assert samples["holdfast_link_waiting", "bus"] == 0
