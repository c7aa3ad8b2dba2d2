"""The client against servers of others: pymodbus on every transport, and libmodbus.

What one of them does not know, or answers in its own way, is said where it differs.
"""

from __future__ import annotations

import asyncio
import shlex
import subprocess
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import holdfast
from support import wire
from support.faces import FACES, Dial, dialling
from support.lines import Cable
from support.machine import missing, tool
from support.pymodbus_server import FRAMERS, LONG, Pymodbus, tour

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


@pytest.fixture(params=FRAMERS)
def pymodbus(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Pymodbus]:
    with ExitStack() as stack:
        line = request.param in ("rtu", "ascii")
        server = Pymodbus(request.param, stack.enter_context(Cable(tmp_path)) if line else None)
        stack.callback(server.stop)
        yield server


def test_pymodbus_is_asked_everything(pymodbus: Pymodbus, dial: Dial) -> None:
    client = dial(pymodbus.url)

    tour(client)

    who = client.identify()
    assert (who.vendor_name, who.product_code, who.revision) == ("Acme", "P1", "1.2")
    assert (who.model_name, who.user_application_name) == tuple(LONG.values())
    assert client.report_server_id().data == b"Acme-P1-1.2\xff"
    assert client.diagnostics(0, [0x1234]) == [0x1234]
    assert len(client.diagnostics(11)) == 1
    assert client.event_counter()[0] is False
    # Its files and queues always have the same values.
    dummy = [int.from_bytes(pair) for pair in (b"SE", b"RV", b"ER", b" D", b"UM", b"MY", b" R")]
    assert client.read_file_record(4, 1, 10)[:7] == dummy
    assert [len(each) for each in client.read_file_records([(4, 1, 10), (3, 9, 10)])] == [10, 10]
    with pytest.raises(holdfast.InvalidResponse, match="length"):
        client.read_file_record(4, 1, 2)
    client.write_file_record(4, 7, [0x06AF, 0x04BE, 0x100D])
    assert client.read_fifo_queue(0x04DE) == [0, 1, 2, 3]
    assert client.read_exception_status() == 0
    log = client.event_log()
    assert (log.events, log.messages) == (client.event_counter()[1], client.diagnostics(11)[0])


def test_pymodbus_answers_several_tasks_one_after_the_other() -> None:
    server = Pymodbus("tcp")

    async def main() -> None:
        # Of requests that come together it answers only one.
        async with holdfast.Client(server.url, timeout=wire.DEADLINE, max_in_flight=1) as plc:
            calls = [plc.read_input_registers(at, 1) for at in range(100)]
            assert await asyncio.gather(*calls) == [[at] for at in range(100)]

    try:
        asyncio.run(main(), debug=True)
    finally:
        server.stop()


# libmodbus


@pytest.fixture(scope="module")
def libmodbus_server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The server, compiled."""
    flags = subprocess.run(
        [tool("pkg-config"), "--cflags", "--libs", "libmodbus"],
        capture_output=True,
        text=True,
        check=False,
    )
    if flags.returncode != 0:
        missing("libmodbus with its headers")
    program = tmp_path_factory.mktemp("libmodbus") / "server"
    source = Path(__file__).with_name("libmodbus_server.c")
    subprocess.run(
        [tool("cc"), "-Wall", "-o", program, source, *shlex.split(flags.stdout)], check=True
    )
    return program


@pytest.fixture(params=["tcp", "rtu"])
def libmodbus(
    request: pytest.FixtureRequest, libmodbus_server: Path, tmp_path: Path
) -> Iterator[str]:
    """The URL of a libmodbus server."""
    kind = request.param
    with ExitStack() as stack:
        cable = stack.enter_context(Cable(tmp_path)) if kind == "rtu" else None
        words = [kind, *([] if cable is None else [str(cable.devices[0])])]
        server = stack.enter_context(
            subprocess.Popen([libmodbus_server, *words], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(server.kill)
        assert server.stdout is not None
        port = int(server.stdout.readline())
        yield (
            f"tcp://127.0.0.1:{port}" if cable is None else f"rtu://{cable.devices[1]}?parity=none"
        )


def test_libmodbus_is_asked_everything(libmodbus: str, dial: Dial) -> None:
    client = dial(libmodbus)

    tour(client)

    answer = client.report_server_id()
    assert answer.running is True
    assert answer.additional.startswith(b"LMB")
    if libmodbus.startswith("tcp"):
        # On a line it does not answer what it does not know.
        with pytest.raises(holdfast.ModbusException, match="Illegal Function"):
            client.identify()


@pytest.mark.parametrize("libmodbus", ["tcp"], indirect=True)
def test_libmodbus_answers_many_requests_in_flight(libmodbus: str) -> None:
    async def main() -> None:
        async with holdfast.Client(libmodbus, timeout=wire.DEADLINE) as plc:
            calls = [plc.read_input_registers(at, 1) for at in range(500)]
            assert await asyncio.gather(*calls) == [[at] for at in range(500)]

    asyncio.run(main(), debug=True)
