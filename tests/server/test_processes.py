"""A server whose process forks, and one that several threads start."""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

import holdfast
from support import wire

FORKS = """
import os, sys
import holdfast

memory = holdfast.Memory(holding_registers=10)
server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write").start()
child = os.fork()
if child == 0:
    server.stop()
    sys.exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
print(*server.address, flush=True)
sys.stdin.read()
server.stop()
"""

WRITE = bytes.fromhex("0600070001")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not fork")
def test_a_forked_child_ends_and_leaves_the_server_to_its_parent() -> None:
    with subprocess.Popen(
        # Python 3.12 and later warn of a fork while threads run.
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        host, port = parent.stdout.readline().split()
        with wire.Connection((host, int(port))) as client:
            assert client.ask(WRITE) == WRITE
        _, errors = parent.communicate(timeout=wire.DEADLINE)
        assert (parent.returncode, errors) == (0, "")


def test_only_one_of_many_threads_starts_a_server() -> None:
    memory = holdfast.Memory(holding_registers=10)
    server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write")
    together = threading.Barrier(8)

    def start(_: int) -> bool:
        together.wait()
        try:
            server.start()
        except RuntimeError:
            return False
        return True

    with ThreadPoolExecutor(8) as threads:
        assert sorted(threads.map(start, range(8))) == [False] * 7 + [True]
    with wire.Connection(server.address) as client:
        assert client.ask(WRITE) == WRITE
    server.stop()
