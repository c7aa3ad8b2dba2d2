"""What a device is read into, when the device is gone: `stale`."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.events import log_lines
from support import event_streams, web, wire
from support.polled import Fake, configuration, counters, data, device, exception, read
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from support.running import Run

SOURCES = ["127.0.0.1"]
MORE: dict[str, Any] = {
    "listeners": {
        "scada": {
            "type": "modbus-tcp",
            "bind": "127.0.0.1:0",
            "rules": [{"sources": SOURCES, "units": {1: "mirror"}, "access": "read-write"}],
        },
    },
    "rest": {"bind": "127.0.0.1:0", "sources": SOURCES, "tokens": "none"},
    "metrics": {"bind": "127.0.0.1:0", "sources": SOURCES},
}
READS = [
    read("holding_registers", 0, 3, ("holding_registers", 10)),
    read("coils", 0, 8, ("coils", 100)),
]
"""The mirror has holding registers 10 to 12 and coils 100 to 107."""

AFTER = 0.3
REFUSES = {"after": AFTER, "answer": "exception"}
NEVER = {"after": 3600, "answer": "exception"}
DEAD = 0x0B


@pytest.fixture
def records() -> Iterator[web.Records]:
    handler = web.Records()
    log_lines.LOGGER.addHandler(handler)
    level = log_lines.LOGGER.level
    log_lines.LOGGER.setLevel("INFO")
    yield handler
    log_lines.LOGGER.removeHandler(handler)
    log_lines.LOGGER.setLevel(level)


class Meter(Fake):
    """A device whose items are all 7, until it is gone."""

    def __init__(self) -> None:
        self.is_gone = False
        self.refuses_coils = False
        super().__init__(self._answered)

    def _answered(self, request: wire.Frame) -> bytes | None:
        if self.is_gone:
            return None
        if self.refuses_coils and request.pdu[0] == 1:
            return exception(request, 4)
        return data(request, 7)


@pytest.fixture
def meter() -> Iterator[Meter]:
    with Meter() as fake:
        yield fake


def config(meter: Meter, stale: dict[str, Any] | None = REFUSES, **more: Any) -> str:
    retry = {"first": 0.05, "most": 0.05}
    settings = {"timeout": 0.1, "retry": retry, "stale": stale, **more}
    known = {key: value for key, value in settings.items() if value is not None}
    return configuration({"meter": device(meter.url, *READS, **known)}, **MORE)


@contextlib.contextmanager
def client(appliance: Appliance) -> Iterator[holdfast.SyncClient]:
    host, port = endpoint(appliance, "scada")
    with holdfast.SyncClient(f"tcp://{host}:{port}", timeout=wire.DEADLINE) as plc:
        yield plc


def code(call: Callable[[], object]) -> int | None:
    """The exception that a call is answered with; `None` for no exception."""
    try:
        call()
    except holdfast.ModbusException as error:
        return error.code
    return None


TOUCHES: dict[str, Callable[[holdfast.SyncClient], object]] = {
    "all registers": lambda plc: plc.read_holding_registers(10, 3),
    "its last register and what follows": lambda plc: plc.read_holding_registers(12, 50),
    "all coils": lambda plc: plc.read_coils(0, 200),
    "write beside it, read it": lambda plc: plc.read_write(0, 11, 1, [0]),
}


@pytest.mark.parametrize("touch", TOUCHES.values(), ids=TOUCHES)
def test_a_mirror_whose_device_is_gone_answers_with_an_exception_until_it_is_back(
    run: Run, meter: Meter, touch: Callable[[holdfast.SyncClient], object]
) -> None:
    with client(run(config(meter))) as plc:
        wire.until(lambda: code(lambda: touch(plc)) is None, "the device was read")
        meter.is_gone = True
        wire.until(lambda: code(lambda: touch(plc)) is not None, "the values are stale")
        assert code(lambda: touch(plc)) == DEAD
        assert plc.read_holding_registers(0, 10)[1:] == [0] * 9
        assert plc.read_holding_registers(13, 10) == [0] * 10
        assert plc.read_coils(0, 100) == [False] * 100
        meter.is_gone = False
        wire.until(lambda: code(lambda: touch(plc)) is None, "the device was read again")


def test_the_exception_status_of_a_stale_mirror_is_refused_too(run: Run, meter: Meter) -> None:
    status = {"memory": "mirror", "exception_status": {"area": "coils", "address": 93}}
    rule = {"sources": SOURCES, "units": {1: status}, "access": "read-only"}
    scada = {**MORE["listeners"]["scada"], "rules": [rule]}
    retry = {"first": 0.05, "most": 0.05}
    devices = {"meter": device(meter.url, *READS, timeout=0.1, retry=retry, stale=REFUSES)}
    appliance = run(configuration(devices, listeners={"scada": scada}))
    with wire.Connection(endpoint(appliance, "scada")) as raw:
        wire.until(lambda: raw.ask(b"\x07") == b"\x07\x80", "the device was read")
        meter.is_gone = True
        wire.until(lambda: raw.ask(b"\x07") == b"\x87\x0b", "the values are stale")


WRITES: dict[str, tuple[dict[str, Any], Callable[[holdfast.SyncClient], object], int]] = {
    "refused": ({}, lambda plc: plc.write_register(10, 1), 2),
    "local": ({"writes": "local"}, lambda plc: plc.write_register(10, 1), DEAD),
    "a local mask": (
        {"writes": "local"},
        lambda plc: plc.mask_write(10, and_mask=0, or_mask=1),
        DEAD,
    ),
    "sent to the device": ({"writes": "pass"}, lambda plc: plc.write_register(10, 1), DEAD),
}


@pytest.mark.parametrize(("more", "write", "expected"), WRITES.values(), ids=WRITES)
def test_a_write_into_a_stale_mirror_is_refused(
    run: Run,
    meter: Meter,
    more: dict[str, Any],
    write: Callable[[holdfast.SyncClient], object],
    expected: int,
) -> None:
    with client(run(config(meter, **more))) as plc:
        wire.until(lambda: code(lambda: plc.read_holding_registers(10, 3)) is None, "read")
        meter.is_gone = True
        wire.until(lambda: code(lambda: plc.read_holding_registers(10, 3)) == DEAD, "stale")
        assert code(lambda: write(plc)) == expected


@pytest.mark.parametrize("stale", [None, {"after": AFTER}, {"after": AFTER, "answer": "keep"}])
def test_by_default_the_last_values_stay(
    run: Run, meter: Meter, stale: dict[str, Any] | None
) -> None:
    appliance = run(config(meter, stale))
    with client(appliance) as plc:
        wire.until(lambda: plc.read_holding_registers(10, 3) == [7] * 3, "the device was read")
        meter.is_gone = True
        wire.until(lambda: counters(appliance, "meter")["age"] > 2 * AFTER, "the values are old")
        assert plc.read_holding_registers(10, 3) == [7] * 3


def test_before_the_first_read_there_is_no_value(run: Run, meter: Meter) -> None:
    meter.is_gone = True
    appliance = run(config(meter, NEVER))
    with client(appliance) as plc:
        assert code(lambda: plc.read_holding_registers(10, 1)) == DEAD
        meter.is_gone = False
        wire.until(lambda: code(lambda: plc.read_holding_registers(10, 1)) is None, "read")


def test_what_a_file_has_kept_is_stale_until_the_device_was_read(
    tmp_path: Path, meter: Meter
) -> None:
    file = tmp_path / "appliance.yaml"
    text = config(meter, NEVER)
    assert '"mirror": {' in text
    keep = '"keep": {"file": "kept.redb", "sync": 0}'
    file.write_text(text.replace('"mirror": {', f'"mirror": {{{keep}, '))
    with Appliance(load(file)) as appliance, client(appliance) as plc:
        wire.until(lambda: code(lambda: plc.read_holding_registers(10, 3)) is None, "read")
        plc.write_register(0, 5)
    meter.is_gone = True
    with Appliance(load(file)) as appliance, client(appliance) as plc:
        wire.until(lambda: counters(appliance, "meter")["failures"] > 1, "it is polled in vain")
        assert code(lambda: plc.read_holding_registers(10, 3)) == DEAD
        assert plc.read_holding_registers(0, 1) == [5]
        meter.is_gone = False
        wire.until(lambda: code(lambda: plc.read_holding_registers(10, 3)) is None, "read again")


def test_each_read_has_an_age_of_its_own(run: Run, meter: Meter) -> None:
    meter.refuses_coils = True
    with client(run(config(meter, NEVER))) as plc:
        wire.until(lambda: code(lambda: plc.read_holding_registers(10, 3)) is None, "read")
        assert code(lambda: plc.read_coils(100, 8)) == DEAD


def test_rest_refuses_with_stale_and_a_stream_says_so(run: Run, meter: Meter) -> None:
    appliance = run(config(meter))
    address = endpoint(appliance, "rest")
    query = "memory=mirror&area=holding_registers&address=10&count=3&min_interval=0.05"
    with contextlib.closing(web.Client(address)) as rest:

        def asked() -> web.Answer:
            return rest.read("holding_registers", 10, 3, "mirror")

        wire.until(lambda: asked().status == 200, "the device was read")
        opened = event_streams.opened(address, f"/api/v1/memory/changes?{query}")
        with contextlib.closing(opened) as stream:
            assert stream.next("values")["values"] == [7] * 3
            meter.is_gone = True
            wire.until(lambda: asked().status != 200, "the values are stale")
            answer = asked()
            assert (answer.status, answer.json["reason"]) == (503, "stale")
            assert rest.read("holding_registers", 13, 3, "mirror").json == {"values": [0] * 3}
            assert stream.next("unavailable")["reason"] == "stale"
            meter.is_gone = False
            assert stream.next("values")["values"] == [7] * 3


def is_logged(appliance: Appliance, records: web.Records, event: str) -> bool:
    appliance.log_events(timeout=0)
    return {"holding_registers", "coils"} == {each["area"] for each in records.of(event)}


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_status_metrics_and_log_say_since_when(
    run: Run, meter: Meter, records: web.Records
) -> None:
    appliance = run(config(meter, {"after": AFTER}))

    def mirrors() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = counters(appliance, "meter")["mirrors"]
        return found

    wire.until(lambda: all(each["stale_since"] is None for each in mirrors()), "read")
    registers, coils = mirrors()
    place = {"memory": "mirror", "area": "holding_registers", "address": 10, "count": 3}
    assert place.items() <= registers.items()
    assert coils["area"] == "coils"
    meter.is_gone = True
    wire.until(lambda: all(each["stale_since"] is not None for each in mirrors()), "stale")
    [before, _], [after, _] = mirrors(), mirrors()
    assert after["age"] >= AFTER
    assert after["stale_since"] == pytest.approx(before["stale_since"], abs=0.1)

    def metrics() -> str:
        with contextlib.closing(web.Client(endpoint(appliance, "metrics"))) as scraper:
            return scraper.get("/metrics").body.decode()

    labels = '{address="10",area="holding_registers",device="meter",memory="mirror"}'
    text = metrics()
    assert f"holdfast_mirror_stale{labels} 1.0" in text
    assert f"holdfast_mirror_stale_since_timestamp_seconds{labels}" in text
    wire.until(lambda: is_logged(appliance, records, "mirror_stale"), "it is logged")
    meter.is_gone = False
    wire.until(lambda: f"holdfast_mirror_stale{labels} 0.0" in metrics(), "read again")
    assert f"holdfast_mirror_stale_since_timestamp_seconds{labels}" not in metrics()
    wire.until(lambda: is_logged(appliance, records, "mirror_fresh"), "that is logged too")


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_stale_values_are_not_fresh_because_their_source_has_changed(
    tmp_path: Path, meter: Meter, records: web.Records
) -> None:
    file = tmp_path / "appliance.yaml"

    def loaded(**more: Any) -> Any:
        file.write_text(config(meter, {"after": AFTER}, **more))
        return load(file)

    with Appliance(loaded()) as appliance:

        def ages() -> list[float | None]:
            return [each["age"] for each in counters(appliance, "meter")["mirrors"]]

        wire.until(lambda: None not in ages(), "the device was read")
        meter.is_gone = True
        wire.until(lambda: is_logged(appliance, records, "mirror_stale"), "it is logged")
        appliance.reload(loaded(unit=2))
        assert ages() == [None, None], "another unit was not read yet"
        appliance.log_events(timeout=0)
        assert not records.of("mirror_fresh")
        meter.is_gone = False
        wire.until(lambda: is_logged(appliance, records, "mirror_fresh"), "it was read")


def test_the_clock_alone_makes_values_old() -> None:
    memory = holdfast.Memory(holding_registers=10)
    age = _core.MirrorAge(3600, refuses=True)
    memory.mirror([], [("holding_registers", 2, 4, age)])
    with pytest.raises(_core.Stale, match="older than allowed"):
        memory.read("holding_registers", 5, 1)
    with pytest.raises(_core.Stale):
        _core.Follower(memory, [("holding_registers", 0, 10)]).changes()
    assert memory.read("holding_registers", 6, 4) == [0] * 4
    assert (age.seconds, age.stale_for is None) == (None, False)


def test_ages_survive_a_reload_that_does_not_change_where_values_come_from(
    tmp_path: Path, meter: Meter
) -> None:
    file = tmp_path / "appliance.yaml"

    def loaded(stale: dict[str, Any] | None, **more: Any) -> Any:
        file.write_text(config(meter, stale, **more))
        return load(file)

    with Appliance(loaded(NEVER)) as appliance, client(appliance) as plc:

        def asked() -> int | None:
            return code(lambda: plc.read_holding_registers(10, 3))

        wire.until(lambda: asked() is None, "the device was read")
        meter.is_gone = True
        wire.until(lambda: counters(appliance, "meter")["failures"] > 0, "the device is gone")
        appliance.reload(loaded(NEVER, timeout=0.2))
        assert asked() is None
        appliance.reload(loaded({"after": 0.001, "answer": "exception"}))
        wire.until(lambda: asked() == DEAD, "the values are older than that")
        appliance.reload(loaded({"after": 3600, "answer": "exception"}))
        assert asked() is None
        appliance.reload(loaded(NEVER, unit=2))
        assert asked() == DEAD, "another unit was not read yet"
        appliance.reload(loaded(NEVER, enabled=False))
        assert asked() == DEAD
        appliance.reload(loaded(None))
        assert asked() is None


@pytest.mark.parametrize("writes", ["refuse", "pass"])
def test_the_ranges_of_a_device_that_a_reload_disables_are_stale_at_once(
    tmp_path: Path, meter: Meter, writes: str
) -> None:
    file = tmp_path / "appliance.yaml"

    def loaded(**more: Any) -> Any:
        file.write_text(config(meter, NEVER, writes=writes, **more))
        return load(file)

    with Appliance(loaded()) as appliance, client(appliance) as plc:

        def asked() -> int | None:
            return code(lambda: plc.read_holding_registers(10, 3))

        wire.until(lambda: asked() is None, "the device was read")
        appliance.reload(loaded(enabled=False))
        assert asked() == DEAD
        assert code(lambda: plc.write_register(10, 1)) == DEAD, "it would reach no device"
        appliance.reload(loaded())
        wire.until(lambda: asked() is None, "the device was read again")
