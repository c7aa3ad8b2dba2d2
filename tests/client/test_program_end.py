"""A program that ends while clients are in use."""

from __future__ import annotations

import subprocess
import sys

import pytest

from support import wire
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
        while True:
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


@pytest.mark.parametrize("program", [IN_A_DAEMON_THREAD, POLLED_IN_A_DAEMON_THREAD])
def test_a_program_ends_while_its_event_loop_reads_in_a_daemon_thread(program: str) -> None:
    with Stream("tcp") as device:
        command = [sys.executable, "-c", program, device.url]
        ends = [
            subprocess.run(command, capture_output=True, timeout=wire.DEADLINE, check=False)
            for _ in range(8)
        ]
    assert [(end.returncode, end.stderr) for end in ends] == [(0, b"")] * 8


@pytest.mark.parametrize("call", [IS_TRACED, CAN_BE_CANCELLED], ids=["trace", "is_cancelled"])
def test_a_call_in_a_daemon_thread_ends_with_the_interpreter(call: str) -> None:
    command = [sys.executable, "-c", CALLED_IN_A_DAEMON_THREAD.replace("CALL", call)]
    end = subprocess.run(command, capture_output=True, timeout=wire.DEADLINE, check=False)
    assert (end.returncode, end.stderr) == (0, b"")
