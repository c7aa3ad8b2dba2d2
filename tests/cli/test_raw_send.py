"""`holdfast raw-send`, as people and programs use it."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from holdfast import raw_ingest
from holdfast.cli import main
from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from click.testing import Result

    Answer = Callable[[bytes], tuple[str, list[bytes]]]

THREE = "52490103000100000003006400c8012c"


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["raw-send", *arguments])


def usage_error(*arguments: str) -> str:
    """The last line of what wrong usage is answered with."""
    result = run(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("Usage: main raw-send")
    return result.stderr.splitlines()[-1]


@pytest.fixture
def answering() -> Iterator[Answer]:
    """A receiver with a fixed reply; where it is, and the packets that it gets."""
    with contextlib.ExitStack() as running:

        def start(reply: bytes) -> tuple[str, list[bytes]]:
            listening = running.enter_context(socket.create_server(("127.0.0.1", 0)))
            listening.settimeout(wire.DEADLINE)
            packets: list[bytes] = []

            def serve() -> None:
                with contextlib.suppress(OSError), listening.accept()[0] as connection:
                    packets.append(connection.recv(65536))
                    connection.sendall(reply)

            thread = threading.Thread(target=serve)
            running.callback(thread.join)
            running.callback(listening.shutdown, socket.SHUT_RDWR)
            thread.start()
            return f"127.0.0.1:{listening.getsockname()[1]}", packets

        yield start


def test_a_packet_is_written(answering: Answer) -> None:
    to, packets = answering(b"\x00")
    result = run(to, "holding_registers", "0", "100", "0xC8", "0x12c", "--unit", "1")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == "Written: holding_registers from address 0, one packet of 16 bytes.\n"
    assert [packet.hex() for packet in packets] == [THREE]


def test_a_packet_is_written_for_a_program(answering: Answer) -> None:
    to, _ = answering(b"\x00")
    result = run(to, "coils", "0x10", "1", "0", "--memory-id", "0x1", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {
        "ok": True,
        "target": f"raw://{to}",
        "area": "coils",
        "address": 16,
        "bytes": 17,
    }


def test_a_refusal_is_told(answering: Answer) -> None:
    to, _ = answering(b"\x01")
    result = run(to, "coils", "0", "1", "--unit", "1")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == f"holdfast: {to} refused the packet; nothing was written\n"


@pytest.mark.parametrize(
    ("reply", "reason", "maybe_written"),
    [(b"\x01", "refused", False), (b"\x07", "failed", True), (b"", "failed", True)],
)
def test_a_failure_is_told_to_a_program(
    answering: Answer, reply: bytes, reason: str, maybe_written: bool
) -> None:
    to, _ = answering(reply)
    result = run(to, "coils", "0", "1", "--unit", "1", "--json")
    answer = json.loads(result.stdout)
    assert (result.exit_code, result.stderr, answer["ok"]) == (1, "", False)
    assert (answer["reason"], answer["maybe_written"]) == (reason, maybe_written)
    assert answer["detail"].startswith(to)


def test_silence_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        to = f"127.0.0.1:{silent.getsockname()[1]}"
        result = run(to, "coils", "0", "1", "--unit", "1", "--timeout", "0.1", "--json")
    answer = json.loads(result.stdout)
    assert (result.exit_code, answer["reason"], answer["maybe_written"]) == (1, "timeout", True)


def test_an_address_without_a_colon_is_never_another_address() -> None:
    for words in (("hr100", "1", "5"), ("hr1:0-5",)):
        told = usage_error("raw://127.0.0.1:1", *words, "--unit", "1")
        assert f"{words[0].partition(':')[0]!r} is not an area, allowed: coils, " in told


@pytest.mark.parametrize(
    ("arguments", "packet"),
    [
        (("holding_registers", "0", "100", "200", "300", "--unit", "1"), THREE),
        (
            ("holding_registers", "0", "100", "200", "300", "--memory-id", "1"),
            "524901000300000100000003006400c8012c30b3535f",
        ),
        (
            ("holding_registers", "0", "100", "200", "300", "--memory-id", "1", "--no-crc"),
            "524901000300000100000003006400c8012c",
        ),
        (
            ("discrete_inputs", "0", "1", "0", "1", "1", "0", "--unit", "1"),
            "524901020001000000050d",
        ),
    ],
)
def test_a_dry_run_prints_the_packet_and_sends_nothing(
    arguments: tuple[str, ...], packet: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(raw_ingest, "send_packet_sync", None)
    assert run("127.0.0.1:9000", *arguments, "--dry-run").stdout == f"{packet}\n"
    result = run("127.0.0.1:9000", *arguments, "--dry-run", "--json")
    assert (result.exit_code, json.loads(result.stdout)["packet"]) == (0, packet)


RIGHT = ("127.0.0.1:9000", "coils", "0", "1", "--unit", "1")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (RIGHT[:4], "Error: Give either --unit (format v1) or --memory-id (format crc)."),
        (
            (*RIGHT, "--memory-id", "1"),
            "Error: Give either --unit (format v1) or --memory-id (format",
        ),
        ((*RIGHT, "--no-crc"), "Error: --no-crc requires --memory-id."),
        ((*RIGHT[:3], "--unit", "1"), "Error: found 0 values, allowed: 1 to 65535."),
        ((*RIGHT[:3], "2", "--unit", "1"), "Error: values[0] is 2, allowed: 0, 1, False, True."),
        ((*RIGHT[:3], "1.0", "--unit", "1"), "Error: '1.0' is not"),
        ((*RIGHT[:3], "1_0", "--unit", "1"), "Error: '1_0' is not"),
        ((*RIGHT[:2], "70000", *RIGHT[3:]), "Error: ADDRESS is '70000', allowed: 0 to 65535"),
        (
            (*RIGHT[:2], "0xg", *RIGHT[3:]),
            "Error: ADDRESS is '0xg', allowed: 0 to 65535",
        ),
        (
            ("a:1", "colis", *RIGHT[2:]),
            "Error: 'colis' is not an area, allowed: coils, discrete_inputs",
        ),
        (("::1:9000", *RIGHT[1:]), "Error: Invalid value for 'HOST:PORT': '::1:9000': an IPv6 ad"),
        (("plant", *RIGHT[1:]), "Error: Invalid value for 'HOST:PORT': 'plant' is not HOST:PORT,"),
        ((":9000", *RIGHT[1:]), "Error: Invalid value for 'HOST:PORT': ':9000' is not HOST:PORT,"),
        (("a:0", *RIGHT[1:]), "Error: Invalid value for 'HOST:PORT': 'a:0': port 0 is outside 1 t"),
        (("a..b:9000", *RIGHT[1:]), "Error: 'a..b' is not a host name."),
        ((*RIGHT, "--timeout", "0"), "Error: Invalid value for '--timeout': '0' is not a time"),
        ((*RIGHT[:4], "--unit", "65536"), "Error: Invalid value for '--unit': 65536 is outside 0"),
    ],
)
def test_wrong_usage_is_explained(arguments: tuple[str, ...], told: str) -> None:
    assert usage_error(*arguments).startswith(told)


@pytest.mark.usefixtures("ipv6")
def test_an_ipv6_address_is_given_in_brackets() -> None:
    with socket.create_server(("::1", 0), family=socket.AF_INET6) as silent:
        to = f"[::1]:{silent.getsockname()[1]}"
        result = run(to, *RIGHT[1:], "--timeout", "0.1")
    assert (
        result.stderr
        == f"holdfast: {to}: no reply within 0.1 s; the packet may have been written\n"
    )


def test_it_works_as_a_process() -> None:
    command = [sys.executable, "-m", "holdfast", "raw-send", *RIGHT, "--dry-run"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "5249010100010000000101\n", "")
