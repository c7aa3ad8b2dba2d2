"""`holdfast proxy` as a user has it: a process, its output, its signals, its exit codes."""

from __future__ import annotations

import json
import signal
import socket
from typing import TYPE_CHECKING, Protocol

import pytest

from support import wire
from support.cli import ProxyCommand, ServingCommand, invoke, usage_error
from support.fake_device import Serial, Stream, exception, silent
from support.lines import RTU

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

READ = bytes.fromhex("0300050001")
FIVE = bytes.fromhex("03020005")
WRITE = bytes.fromhex("0600051234")
VENDOR = bytes.fromhex("4101020304")
NOBODY = "tcp://127.0.0.1:1"


class Proxy(Protocol):
    """Starts a proxy that is stopped when the test ends."""

    def __call__(self, *arguments: str) -> ProxyCommand: ...


@pytest.fixture
def proxy() -> Iterator[Proxy]:
    started: list[ProxyCommand] = []

    def start(*arguments: str) -> ProxyCommand:
        started.append(ProxyCommand(*arguments))
        return started[-1]

    yield start
    for each in started:
        each.process.kill()
        each.process.communicate()


@pytest.fixture
def device() -> Iterator[Stream]:
    """Unit 1, whose holding register N holds N."""
    with Stream("tcp") as made:
        yield made


def test_it_says_what_is_served_where_for_whom_and_what_to_try(
    device: Stream, proxy: Proxy
) -> None:
    running = proxy(device.url)
    host, port = running.wait_until_it_serves()

    first, _, rights, _, _, _, command, *_ = running.greeting.splitlines()
    assert first == f"{device.url} is served at tcp://{host}:{port}:"
    assert rights == "  unit ids 0-255 pass through; read-write for 127.0.0.0/8, ::1/128"
    assert command == f"  holdfast read tcp://{host}:{port} hr 0 --unit 1"
    result = invoke(*command.split()[1:])
    assert (result.exit_code, result.stderr) == (0, "")


def test_clients_reach_the_device_over_one_connection(device: Stream, proxy: Proxy) -> None:
    address = proxy(device.url).wait_until_it_serves()
    with wire.Connection(address) as one, wire.Connection(address) as other:
        assert [one.ask(READ), other.ask(WRITE)] == [FIVE, WRITE]
        assert one.ask(READ, unit=200) == exception(READ, 0x0B)
    assert [asked.unit for asked in device.requests] == [1, 1, 200]
    assert device.connections == 1


def test_unit_sends_everything_to_one_device(device: Stream, proxy: Proxy) -> None:
    with wire.Connection(proxy(device.url, "--unit", "1").wait_until_it_serves()) as client:
        assert [client.ask(READ, unit) for unit in (0, 7, 255)] == [FIVE] * 3
    assert [asked.unit for asked in device.requests] == [1] * 3


def test_read_only_refuses_writes(device: Stream, proxy: Proxy) -> None:
    with wire.Connection(
        proxy(device.url, "--access", "read-only").wait_until_it_serves()
    ) as client:
        assert client.ask(WRITE) == exception(WRITE, 1)
        assert client.ask(READ) == FIVE
    assert [asked.pdu for asked in device.requests] == [READ]


def test_functions_are_all_that_passes(device: Stream, proxy: Proxy) -> None:
    device.is_modelled = False
    device.then = lambda asked: asked.answer(asked.pdu)
    running = proxy(device.url, "--functions", "6,65")
    with wire.Connection(running.wait_until_it_serves()) as client:
        assert [client.ask(pdu) for pdu in (WRITE, VENDOR)] == [WRITE, VENDOR]
        assert client.ask(READ) == exception(READ, 1)


def test_cache_answers_equal_reads(device: Stream, proxy: Proxy) -> None:
    running = proxy(device.url, "--cache", "3600", "--unit", "1", "--in-flight", "auto")
    with wire.Connection(running.wait_until_it_serves()) as client:
        assert [client.ask(READ) for _ in range(3)] == [FIVE] * 3
    assert len(device.requests) == 1


def test_timeout_limits_the_wait_for_the_device(device: Stream, proxy: Proxy) -> None:
    device.then = silent
    running = proxy(device.url, "--timeout", "0.1")
    with wire.Connection(running.wait_until_it_serves()) as client:
        assert client.ask(READ) == exception(READ, 0x0B)


def test_a_serial_line_has_broadcasts(proxy: Proxy, tmp_path: Path) -> None:
    with Serial(RTU, tmp_path / "line", silent) as device:
        running = proxy(device.url)
        with wire.Connection(running.wait_until_it_serves()) as client:
            client.send(wire.frame(WRITE, unit=0))
            assert client.ask(READ) == FIVE
            assert client.ask(READ, unit=248) == exception(READ, 0x0B)
    assert "unit ids 0-247 pass through" in running.greeting
    assert [(asked.unit, asked.pdu) for asked in device.requests] == [(0, WRITE), (1, READ)]


def test_unit_may_be_a_reserved_id_of_a_serial_line(proxy: Proxy, tmp_path: Path) -> None:
    with Serial(RTU, tmp_path / "line", then=lambda asked: asked.answer(FIVE)) as device:
        running = proxy(device.url, "--unit", "248")
        with wire.Connection(running.wait_until_it_serves()) as client:
            assert client.ask(READ) == FIVE
    assert [(asked.unit, asked.pdu) for asked in device.requests] == [(248, READ)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_exit_code_0(
    device: Stream, proxy: Proxy, number: signal.Signals
) -> None:
    running = proxy(device.url, "--log-format", "json")
    with wire.Connection(running.wait_until_it_serves()) as client:
        assert client.ask(READ) == FIVE
        code, log = running.end(number)
    events = [json.loads(line)["event"] for line in log.splitlines()]
    assert (code, events) == (0, ["started", "listening", "stopped"])


def test_a_port_that_is_taken_is_one_line_and_exit_code_1() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        process = ServingCommand("proxy", NOBODY, "--bind", f"127.0.0.1:{port}").process
        out, log = process.communicate(timeout=wire.DEADLINE)
    assert (process.returncode, out) == (1, "")
    assert log.startswith("holdfast: listener proxy: ")
    assert f"127.0.0.1:{port}" in log
    assert log.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["plc"], "Error: Invalid value for 'DEVICE-URL': 'plc' is not the URL of a device, "),
        ([NOBODY, "--bind", "localhost:1"], "Error: Invalid value for '--bind': found "
         "'localhost:1', allowed: address:port with an IP address, as in 127.0.0.1:502 or, with "
         "quotes, '[::1]:502'."),
        ([NOBODY, "--bind", "0.0.0.0:1"], "Error: --bind 0.0.0.0:1 is reachable from other "
         "machines: name the clients that may connect with --source NETWORK."),
        ([NOBODY, "--source", "10.0.0.1/8"], "Error: Invalid value for '--source': found "
         "'10.0.0.1/8', which has host bits set: the network is 10.0.0.0/8."),
        ([NOBODY, "--unit", "256"], "Error: Invalid value for '--unit': found 256, allowed: 0 to "
         "255."),
        (["rtu:///dev/none", "--unit", "0"], "Error: Unit id 0 is the broadcast on a serial line: "
         "nobody answers it."),
        ([NOBODY, "--timeout", "0"], "Error: Invalid value for '--timeout': '0' is not a time, as "
         "in 500ms, 2s or 2 (seconds): from 0.001, up to 31622400 s."),
        ([NOBODY, "--timeout", "nan"], "Error: Invalid value for '--timeout': 'nan' is not a time, "
         "as in 500ms, 2s or 2 (seconds): from 0.001, up to 31622400 s."),
        ([NOBODY, "--cache", "-1"], "Error: Invalid value for '--cache': '-1' is not a time, as in "
         "500ms, 2s or 2 (seconds): 0, or from 0.001, up to 31622400 s."),
        ([NOBODY, "--in-flight", "1025"], "Error: Invalid value for '--in-flight': '1025' is not "
         "auto or a number from 1 to 1024."),
        (["rtu:///dev/none", "--in-flight", "4"], "Error: --in-flight 4 requires tcp or tls."),
        (["udp://plc", "--in-flight", "4"], "Error: --in-flight 4 requires tcp or tls."),
        ([NOBODY, "--functions", "3,128"], "Error: Invalid value for '--functions': '128' is not "
         "a function code from 1 to 127."),
        ([NOBODY, "--functions", "3,3"], "Error: Invalid value for '--functions': function 3 is "
         "given twice."),
        ([NOBODY, "--functions", "3,65", "--access", "read-only"], "Error: --functions 65 may write"
         ": omit it, or --access read-only."),
        (["tls://plc?ca=/none.pem"], "Error: "),
    ],
)  # fmt: skip
def test_wrong_usage_is_explained(arguments: list[str], error: str) -> None:
    assert usage_error("proxy", *arguments).startswith(error)


def test_sighup_reads_the_files_of_the_url_anew() -> None:
    with Stream("tcp") as device:
        command = ProxyCommand(device.url)
        try:
            address = command.wait_until_it_serves()
            command.process.send_signal(signal.SIGHUP)
            assert command.process.stderr is not None
            log = iter(command.process.stderr)
            assert next(line for line in log if " reload" in line).split()[2] == "reloaded"
            with wire.Connection(address) as client:
                assert client.ask(bytes.fromhex("0300000001"))[0] == 3
        finally:
            command.process.kill()
            command.process.communicate()
