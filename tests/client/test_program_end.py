"""A program that ends while clients are in use."""

from __future__ import annotations

import subprocess
import sys

import pytest

from support import wire
from support.brokers import free_port
from support.fake_device import ScriptedDevice, Stream, Udp, silent

IN_A_DAEMON_THREAD = """
import asyncio, sys, threading, holdfast
loop = asyncio.new_event_loop()
threading.Thread(target=loop.run_forever, daemon=True).start()
has_read = threading.Event()
async def poll():
    plc = holdfast.Client(sys.argv[1])
    while True:
        await plc.read_holding_registers(0, 10)
        has_read.set()
for _ in range(4):
    asyncio.run_coroutine_threadsafe(poll(), loop)
has_read.wait()
"""


POLLED_IN_A_DAEMON_THREAD = """
import asyncio, sys, threading, holdfast
poller = holdfast.Poller()
poller.add(sys.argv[1], {"x": ("holding_registers", 0)}, interval=0.01)
has_read = threading.Event()
async def poll():
    async for _ in poller:
        has_read.set()
threading.Thread(target=lambda: asyncio.run(poll()), daemon=True).start()
has_read.wait()
"""


AFTER_THE_MAIN_THREAD = """
import asyncio, sys, threading, holdfast
async def main():
    async with holdfast.Client(sys.argv[1]) as plc:
        assert await plc.read_holding_registers(7, 1) == [7]
    with holdfast.Poller() as poller:
        poller.add(sys.argv[1], {"x": ("holding_registers", 7)})
        async for batch in poller:
            assert [reading.value for reading in batch] == [7]
            print("read")
            break
def run():
    threading.main_thread().join()
    asyncio.run(main())
threading.Thread(target=run).start()
"""


DURING_THE_END_OF_THE_MAIN_THREAD = """
import asyncio, sys, threading, holdfast
has_read = threading.Event()
async def main():
    poller = holdfast.Poller()
    poller.add(sys.argv[1], {"x": ("holding_registers", 7)}, interval=0.01)
    async with holdfast.Client(sys.argv[1]) as plc:
        async for _ in poller:
            await plc.read_holding_registers(7, 1)
            has_read.set()
            if not threading.main_thread().is_alive():
                break
    print("read")
threading.Thread(target=lambda: asyncio.run(main())).start()
has_read.wait()
"""


AFTER_THE_END = """
import asyncio, atexit, sys
async def read():
    return await plc.read_holding_registers(7, 1)
@atexit.register
def read_too_late():
    try:
        asyncio.run(read())
    except RuntimeError as error:
        print(error)
import holdfast
plc = holdfast.Client(sys.argv[1])
assert asyncio.run(read()) == [7]
"""


CANCELLED = """
import asyncio, sys, holdfast
async def main():
    plc = holdfast.Client(sys.argv[1], timeout=3600)
    call = asyncio.create_task(plc.write_register(0, 1))
    await asyncio.to_thread(sys.stdin.readline)
    call.cancel()
asyncio.run(main())
"""


CALLED_IN_A_DAEMON_THREAD = """
import socket, sys, threading, holdfast
from holdfast._core import BlockingClient, Request
from holdfast.client.endpoint import endpoint
from holdfast.client.url import parse
has_begun = threading.Event()
listener = socket.create_server(("127.0.0.1", 0))
url = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
CALL
threading.Thread(target=call, daemon=True).start()
class Device:
    def __init__(self):
        self.connection, _ = listener.accept()
    def __del__(self, plc=plc):
        self.connection.sendall(b"x")
        self.connection.settimeout(0.01)
        for _ in range(500):  # Of a thread that waited for the interpreter, nothing is left.
            plc.close()  # After the call.
            try:
                if not self.connection.recv(260):
                    return
            except TimeoutError:
                pass
            except ConnectionResetError:
                return
sys.modules["device"] = Device()  # Is deleted when the interpreter has ended for other threads.
has_begun.wait()
"""

IS_TRACED = """
plc = holdfast.SyncClient(url, timeout=60, trace=lambda *_: has_begun.set())
call = lambda: plc.read_coils(0, 1)
"""

CAN_BE_CANCELLED = """
plc = BlockingClient(endpoint(parse(url + "?pause_after_connect=60")))
call = lambda: plc.call(Request.read("coils", 0, 1), 1, 90, has_begun.set)
"""


FAILS_AT_THE_END = """
import sys, holdfast
class Drive:
    def __init__(self):
        self.plc = holdfast.SyncClient(sys.argv[1])
    def __del__(self):
        self.plc.write_register(0, 0)
sys.modules["drive"] = Drive()  # Is deleted when nothing can be imported any more.
"""


def ended(program: str, url: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-c", program, url]
    return subprocess.run(command, capture_output=True, timeout=wire.DEADLINE, check=False)


@pytest.mark.parametrize("device", [Stream("rtu+tcp", silent), Udp(silent)], ids=["rtu+tcp", "udp"])
def test_a_program_does_not_wait_for_a_call_that_was_cancelled(device: ScriptedDevice) -> None:
    with device:
        command = [sys.executable, "-c", CANCELLED, device.url]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as program:
            try:
                device.await_requests(1)
                _, stderr = program.communicate(b"\n", timeout=wire.DEADLINE)
            finally:
                program.kill()
    assert (program.returncode, stderr) == (0, b"")


@pytest.mark.parametrize("program", [AFTER_THE_MAIN_THREAD, DURING_THE_END_OF_THE_MAIN_THREAD])
@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "udp"])
def test_a_thread_reads_on_when_the_main_thread_has_ended(kind: str, program: str) -> None:
    with Udp() if kind == "udp" else Stream(kind) as device:
        end = ended(program, device.url)
    assert (end.stdout, end.stderr, end.returncode) == (b"read\n", b"", 0)


def test_a_client_without_a_thread_at_the_end_of_the_program_says_so() -> None:
    with Stream("rtu+tcp") as device:
        end = ended(AFTER_THE_END, device.url)
    assert (end.stderr, end.returncode) == (b"", 0)
    assert end.stdout == b"the program ends: a client can't start its thread\n"


@pytest.mark.parametrize("program", [IN_A_DAEMON_THREAD, POLLED_IN_A_DAEMON_THREAD])
@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_program_ends_while_its_event_loop_reads_in_a_daemon_thread(
    kind: str, program: str
) -> None:
    with Stream(kind) as device:
        ends = [ended(program, device.url) for _ in range(8)]
    assert [(end.returncode, end.stderr) for end in ends] == [(0, b"")] * 8


@pytest.mark.parametrize("call", [IS_TRACED, CAN_BE_CANCELLED], ids=["trace", "is_cancelled"])
def test_a_call_in_a_daemon_thread_ends_with_the_interpreter(call: str) -> None:
    command = [sys.executable, "-c", CALLED_IN_A_DAEMON_THREAD.replace("CALL", call)]
    end = subprocess.run(command, capture_output=True, timeout=wire.DEADLINE, check=False)
    assert (end.returncode, end.stderr) == (0, b"")


def test_a_call_that_fails_at_the_end_of_the_interpreter_is_reported() -> None:
    end = ended(FAILS_AT_THE_END, f"tcp://127.0.0.1:{free_port()}")
    assert end.stderr.startswith(b"Exception ignored in")
    assert b"holdfast.errors.ConnectFailed: can't connect to" in end.stderr
    assert end.returncode == 0
