"""Links of an appliance in its diagnostics, over REST and as metrics."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from holdfast.adapters.rest.operations import document
from holdfast.config import load
from holdfast.events import log_lines
from support import web, wire
from support.fake_device import Serial, Stream, exception, silent
from support.lines import RTU
from support.routed import Held, await_count, configuration, counters
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300050001")
FIVE = bytes.fromhex("03020005")
WRITE = bytes.fromhex("0600051234")
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
) | {"error": None}


@pytest.fixture
def device() -> Iterator[Stream]:
    with Stream("tcp") as made:
        yield made


@pytest.fixture
def records(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> Iterator[web.Records]:
    """What is logged; changes of links at once, not only once a second."""
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0.0)
    handler = web.Records()
    log_lines.LOGGER.addHandler(handler)
    with caplog.at_level("INFO"):
        yield handler
    log_lines.LOGGER.removeHandler(handler)


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


def test_the_log_has_why_a_link_fails_once_and_that_it_works_again(
    run: Run, records: web.Records
) -> None:
    def logged() -> list[str]:
        appliance.log_events(timeout=0)
        return [entry["event"] for entry in records.fields if entry.get("link") == "bus"]

    with Stream("tcp") as device:
        device.stop()
        appliance = run(configuration(device.url))
        assert logged() == []
        for _ in range(2):
            assert ask(appliance, READ) == exception(READ, 0x0A)
            assert logged() == ["link_down"]
        [down] = records.of("link_down")
        assert device.url in down["error"]
        assert counters(appliance)["error"] == down["error"]
        device.start()
        wire.until(lambda: ask(appliance, READ) == FIVE, "the device is asked again")
        assert logged() == ["link_down", "link_back"]
        assert counters(appliance)["error"] is None


@pytest.mark.parametrize("moves", ["to the address of the other", "away"])
def test_a_reload_names_a_link_after_the_device_that_is_behind_it_then(
    run: Run, records: web.Records, tmp_path: Path, moves: str
) -> None:
    """Also if the device that it was named after is behind another link now."""

    def written(pump: Stream, valve: Stream) -> str:
        devices = {"pump": {"url": pump.url, "unit": 1}, "valve": {"url": valve.url, "unit": 1}}
        units: dict[int | str, Any] = {1: {"route": "pump"}, 2: {"route": "valve"}}
        return configuration("tcp://127.0.0.1:1", units=units, devices=devices)

    with Stream("tcp") as first, Stream("tcp") as second, Stream("tcp") as third:
        appliance = run(written(first, second))
        for unit in (1, 2):
            assert ask(appliance, READ, unit) == FIVE
        file = tmp_path / "moved.yaml"
        file.write_text(written(third if moves == "away" else second, first))
        appliance.reload(load(file))
        for unit in (1, 2):
            assert ask(appliance, READ, unit) == FIVE
        first.stop()
        wire.until(lambda: ask(appliance, READ, 2) == exception(READ, 0x0A), "the device is gone")
        appliance.log_events(timeout=0)

        [down] = records.of("link_down")
        assert (down["link"], first.url in down["error"]) == ("valve", True)
        links = appliance.diagnostics.stats()["links"]
        assert {name: link["error"] is None for name, link in links.items()} == {
            "bus": True,
            "pump": True,
            "valve": False,
        }


def test_a_reload_withdraws_what_waits_for_a_device_that_it_changes_and_nothing_else(
    device: Stream, run: Run, tmp_path: Path
) -> None:
    units = {"moved": 1, "kept": 2, "unrouted": 3, "removed": 4}
    devices: dict[str, Any] = {
        name: {"url": device.url, "unit": 1, "timeout": wire.DEADLINE} for name in units
    }
    writes = {name: bytes((6, 0, unit, 0, 7)) for name, unit in units.items()}
    held = Held()
    device.script = [held]

    def reload(*routes: str) -> None:
        file = tmp_path / "changed.yaml"
        behind: dict[int | str, Any] = {units[name]: {"route": name} for name in routes}
        file.write_text(configuration("tcp://127.0.0.1:1", units=behind, devices=devices))
        appliance.reload(load(file))

    def waits(number: int) -> None:
        await_count(appliance, "waiting", number, "moved")

    behind: dict[int | str, Any] = {unit: {"route": name} for name, unit in units.items()}
    appliance = run(configuration("tcp://127.0.0.1:1", units=behind, devices=devices))
    with contextlib.ExitStack() as stack, Stream("tcp") as other:
        clients = {
            name: stack.enter_context(wire.Connection(endpoint(appliance, "scada")))
            for name in ("under way", *units)
        }
        clients["under way"].send(wire.frame(READ))
        device.await_requests(1)
        for number, (name, unit) in enumerate(units.items(), 2):
            clients[name].send(wire.frame(writes[name], unit))
            waits(number)
        # A route with another timeout is still the same one.
        devices["moved"]["timeout"] = wire.DEADLINE + 1
        reload("moved", "kept", "removed")
        devices["moved"]["url"] = other.url
        del devices["removed"]
        reload("moved", "kept")
        held.release()
        replies = {name: client.receive().pdu for name, client in clients.items()}
        refused = dict.fromkeys(("moved", "removed"), exception(b"\6", 0x0A))
        assert replies == {"under way": FIVE, **writes, **refused}
        sent = [asked.pdu for asked in device.requests]
        assert sent == [READ, writes["kept"], writes["unrouted"]]
        assert ask(appliance, writes["moved"]) == writes["moved"]
        assert [asked.pdu for asked in other.requests] == [writes["moved"]]


def test_the_log_has_that_a_device_does_not_answer(run: Run, records: web.Records) -> None:
    with Stream("tcp", then=silent) as device:
        appliance = run(configuration(device.url, link={"timeout": 0.1}))
        for number in range(3):
            assert ask(appliance, READ, unit=number) == exception(READ, 0x0B)
            appliance.log_events(timeout=0)
            assert len(records.of("link_down")) == number // 2


def broadcast(appliance: Appliance) -> None:
    """Sends a write to all units of a line, and waits until it is sent."""
    sent = counters(appliance)["replies"] + 1
    with wire.Connection(endpoint(appliance, "scada")) as client:
        client.send(wire.frame(WRITE, unit=0))
        await_count(appliance, "replies", sent)


def test_a_broadcast_is_no_answer_of_a_line(run: Run, tmp_path: Path) -> None:
    with Serial(RTU, tmp_path / "line", then=silent) as device:
        appliance = run(configuration(device.url, link={"timeout": 0.1}))
        for unit in (1, 2, 3):
            assert counters(appliance)["error"] is None
            broadcast(appliance)
            assert ask(appliance, READ, unit) == exception(READ, 0x0B)
        broadcast(appliance)
        assert counters(appliance)["error"] == "no reply within 0.1 s"


def test_a_broadcast_shows_that_a_line_can_be_opened_again(run: Run, tmp_path: Path) -> None:
    with Serial(RTU, tmp_path / "line", then=silent) as device:
        name = tmp_path / "name"
        url = device.url.replace(str(device.terminal.device), str(name))
        appliance = run(configuration(url))
        assert ask(appliance, READ) == exception(READ, 0x0A)
        assert str(name) in counters(appliance)["error"]
        name.symlink_to(device.terminal.device)
        with wire.Connection(endpoint(appliance, "scada")) as client:

            def is_mended() -> bool:
                client.send(wire.frame(WRITE, unit=0))
                return counters(appliance)["error"] is None

            wire.until(is_mended, "the line is opened")


def test_the_log_has_that_a_queue_was_full(
    device: Stream, run: Run, records: web.Records, tmp_path: Path
) -> None:
    held = Held()
    device.script = [held]
    text = configuration(device.url, link={"queue": 1})
    appliance = run(text)
    with wire.Connection(endpoint(appliance, "scada")) as first:
        first.send(wire.frame(READ))
        device.await_requests(1)
        with wire.Connection(endpoint(appliance, "scada")) as second:
            assert second.ask(READ) == exception(READ, 6)
        for _ in range(2):
            appliance.log_events(timeout=0)
        held.release()
        assert first.receive().pdu == FIVE

    file = tmp_path / "renamed.yaml"
    file.write_text(text.replace('"bus"', '"line"'))
    appliance.reload(load(file))
    assert counters(appliance, "line")["refused_full"] == 1
    appliance.log_events(timeout=0)
    assert [(each["link"], each["count"]) for each in records.of("link_full")] == [("bus", 1)]


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
