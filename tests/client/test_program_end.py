"""A program that ends while daemon threads use clients."""

from __future__ import annotations

import subprocess
import sys

from support import wire
from support.fake_device import Stream

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


def test_a_program_ends_while_its_event_loop_reads_in_a_daemon_thread() -> None:
    with Stream("tcp") as device:
        command = [sys.executable, "-c", IN_A_DAEMON_THREAD, device.url]
        ends = [
            subprocess.run(command, capture_output=True, timeout=wire.DEADLINE, check=False)
            for _ in range(8)
        ]
    assert [(end.returncode, end.stderr) for end in ends] == [(0, b"")] * 8
