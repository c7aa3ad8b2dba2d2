"""`holdfast bench`, and the load that it makes."""

from __future__ import annotations

import asyncio
import itertools
import math
import random
import re
import signal
import time
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.client.load import Latencies, Load
from support import cli, wire
from support.cli import answer, done, failure, invoke, usage_error
from support.fake_device import HANG_UP, FakeDevice, exception, registers
from support.terminal import Terminal

if TYPE_CHECKING:
    import holdfast

SHORT = ("--duration", "0.1")


def test_rate_latencies_and_histogram_are_shown(server: holdfast.Server) -> None:
    url = cli.url(server)
    head, _, *lines = done("bench", url, *SHORT, "--connections", "2", "--in-flight", "3")
    assert re.fullmatch(
        rf"{url}, unit 1: holding_registers 0 to 9, 2 connections, 3 in flight on each, \d\.\d s",
        head,
    )
    assert [line.split()[0] for line in lines[:7]] == [
        "requests", "rate", "p50", "p90", "p99", "max", "errors",
    ]  # fmt: skip
    assert lines[6].split() == ["errors", "none"]
    bars = [re.fullmatch(r"under +\S+ \S+ +(█*) +([0-9.]+) % +(\d+)", each) for each in lines[8:]]
    assert bars
    assert sum(int(bar[3]) for bar in bars if bar) == int(lines[0].split()[1])


def test_the_server_answers_as_many_as_are_counted(server: holdfast.Server) -> None:
    options = ("co:7", "100", "--connections", "3")
    found = answer("bench", cli.url(server), *SHORT, *options)
    assert found["ok"] is True
    counters = server.counters()
    assert counters["requests"] == {1: found["requests"] + 3}
    assert counters["connections"]["accepted"] == 3
    assert found["rate"] == pytest.approx(found["requests"] / found["seconds"], rel=0.05)
    times = found["latency_ms"]
    assert 0 < times["min"] <= times["p50"] <= times["p90"] <= times["p99"] <= times["max"]
    assert sum(bar["requests"] for bar in found["histogram"]) == found["requests"]


def test_errors_are_counted_by_kind() -> None:
    def are_counted(timeout: float) -> bool:
        numbers = itertools.count()

        def answers(pdu: bytes) -> bytes | None:
            number = next(numbers)
            if number == 3:
                return exception(pdu, 6)
            if number == 5:
                return None
            if number == 7:
                return b"\x03\x01\x00"
            # A read is repeated once when a connection ends that was used before.
            return HANG_UP if number in (9, 10) else registers(pdu)

        with FakeDevice(answers) as device:
            options = ("--timeout", str(timeout), "--duration", str(3 * timeout))
            found = answer("bench", device.url, *options)
        if next(numbers) < 12 or found["errors"]["timeout"] > 1:
            return False
        assert found["errors"] == {
            "exception 06 (Server Device Busy)": 1,
            "timeout": 1,
            "invalid response": 1,
            "connection lost": 1,
        }
        assert found["requests"] > 0
        return True

    wire.until_long_enough(are_counted, "one request is not answered")


def test_a_device_that_refuses_is_told_at_once(server: holdfast.Server) -> None:
    url = cli.url(server)
    assert failure("bench", url, "hr:1000") == [
        f"holdfast: {url}: exception 02 (Illegal Data Address)",
        f"hint: 'holdfast describe map {url}' finds the addresses that exist",
    ]
    assert answer("bench", url, "hr:1000", code=1)["code"] == 2
    assert failure("bench", "tcp://127.0.0.1:1")[0].startswith("holdfast: tcp://127.0.0.1:1: can't")


def test_no_answer_after_the_first_is_a_failure() -> None:
    numbers = itertools.count()

    def answers(pdu: bytes) -> bytes | None:
        return exception(pdu, 4) if next(numbers) else registers(pdu)

    with FakeDevice(answers) as device:
        result = invoke("bench", device.url, "hr:0", "10", *SHORT)
        numbers = itertools.count()
        found = answer("bench", device.url, "hr:0", "10", *SHORT, code=1)
    assert (found["ok"], found["reason"], found["code"]) == (False, "exception", 4)
    assert found["detail"] in found["errors"]
    assert set(found["latency_ms"].values()) == {None}
    assert result.exit_code == 1
    assert re.search(r"requests +0\n", result.stdout)
    assert "exception 04 (Server Device Failure)" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("tcp://127.0.0.1", "hr:0", "126"), "count is 126, allowed: 1 to 125."),
        (("tcp://127.0.0.1", "hr:65530", "10"), "the last address is 65535."),
        (
            ("udp://127.0.0.1", "--in-flight", "2"),
            "more than one request in flight requires tcp or tls.",
        ),
        (("rtu:///dev/ttyX", "--connections", "2"), "a serial line has one connection."),
        (("tcp://127.0.0.1", "x:0"), "'x' is not an area"),
        (("tcp://127.0.0.1", "--duration", "inf"), "'inf' is not a time"),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("bench", *arguments)


def test_the_help_warns() -> None:
    assert "THIS IS A LOAD TEST" in "\n".join(done("bench", "--help"))


def test_it_can_be_ended_earlier_with_what_was_measured(server: holdfast.Server) -> None:
    with Terminal("bench", cli.url(server), "--duration", "1000") as terminal:
        wire.until(lambda: server.counters()["requests"].get(3, 0) > 10, "it is loaded")
        terminal.until("Loading", "/s")
        assert terminal.end(signal.SIGINT) == 0
    assert "p99" in terminal.shown
    assert "█" in terminal.shown


def test_connections_are_limited() -> None:
    for connections in (0, 1001):
        with pytest.raises(ValueError, match="allowed: 1 to 1000"):
            Load("tcp://127.0.0.1", "coils", 0, 1, connections=connections)


def test_progress_is_told(server: holdfast.Server) -> None:
    load = Load(cli.url(server), "input_registers", 0, 5, seconds=0.3)
    seen: list[float] = []
    asyncio.run(load.run(lambda load: seen.append(load.elapsed)))
    assert seen == sorted(seen)
    assert load.elapsed >= 0.3
    assert load.rate > 0


def test_a_clock_that_seldom_ticks_does_not_measure(
    server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monotonic = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: monotonic() // 0.0156 * 0.0156)
    load = Load(cli.url(server), "input_registers", 0, 5, seconds=0.3)
    asyncio.run(load.run())
    assert load.latencies.least > 0


@given(st.lists(st.floats(1e-6, 1000), min_size=1))
def test_quantiles_are_right_to_2_percent(times: list[float]) -> None:
    latencies = Latencies()
    for each in times:
        latencies.add(each)
    for share in (0.01, 0.5, 0.9, 0.99, 1.0):
        true = sorted(times)[max(1, math.ceil(share * len(times))) - 1]
        assert latencies.quantile(share) == pytest.approx(true, rel=0.02)
    assert latencies.most == max(times)
    assert latencies.least == min(times)
    assert latencies.mean == pytest.approx(sum(times) / len(times))
    assert sum(number for _, _, number in latencies.histogram()) == len(times)


def test_a_histogram_has_no_gaps() -> None:
    latencies = Latencies()
    generator = random.Random(1)
    for _ in range(1000):
        latencies.add(generator.choice((0.00015, 0.003)))
    bars = latencies.histogram()
    assert [end for _, end, _ in bars] == pytest.approx([2e-4, 5e-4, 1e-3, 2e-3, 5e-3])
    assert [number > 0 for _, _, number in bars] == [True, False, False, False, True]


def test_nothing_was_measured_at_first() -> None:
    latencies = Latencies()
    assert (latencies.quantile(0.5), latencies.mean, latencies.histogram()) == (0, 0, [])
