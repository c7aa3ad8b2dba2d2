"""A server whose process forks, and one that several threads start."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

import holdfast
from support import wire
from support.machine import has_ipv6

needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="needs IPv6")

FORKS = """
import os, sys, threading
import holdfast

memory = holdfast.Memory(holding_registers=10)
server = holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write").start()
poller = holdfast.Poller()
# Their memory is used again by threads of the child.
for _ in range(6):
    threading.Thread(target=threading.Event().wait, daemon=True).start()
child = os.fork()
if child == 0:
    together = threading.Barrier(8)
    threads = [threading.Thread(target=together.wait) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    server.stop()
    del server, poller
    sys.exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
print(*server.address, flush=True)
sys.stdin.read()
server.stop()
"""

STOPS_AFTER_A_FORK = """
import os, socket, sys
import holdfast

memory = holdfast.Memory(holding_registers=10)
kind, host = sys.argv[1:]
server = holdfast.Server({1: memory}, bind=f"{kind}://{host}:0", access="read-write")
server.start()
own = socket.create_server(("127.0.0.1", 0))
own.settimeout(60)
host, port = server.address
bind = f"{kind}://[{host}]:{port}" if ":" in host else f"{kind}://{host}:{port}"
print(port, own.getsockname()[1], flush=True)
sys.stdin.readline()
begun, begins = os.pipe()
child = os.fork()
if child == 0:
    os.close(1)  # Whoever reads it sees the end of the parent.
    os.write(begins, b"x")
    sys.stdin.readline()  # Until the parent has stopped its server.
    own.accept()
    os._exit(0)
os.read(begun, 1)
own.close()
server.stop()
again = holdfast.Server({1: memory}, bind=bind, access="read-write")
again.start()
print(*again.address, flush=True)
again.stop()
print("stopped", flush=True)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
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


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not fork")
@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "0.0.0.0", *(pytest.param(each, marks=needs_ipv6) for each in ("[::1]", "[::]"))],
)
@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_forked_child_keeps_neither_the_port_nor_the_connections_of_a_server(
    kind: str, host: str
) -> None:
    with subprocess.Popen(
        # Python 3.12 and later warn of a fork while threads run.
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", STOPS_AFTER_A_FORK, kind, host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as parent:
        try:
            assert parent.stdin is not None
            assert parent.stdout is not None
            port, other = map(int, parent.stdout.readline().split())
            address = ("::1" if host == "[::1]" else "127.0.0.1", port)
            with contextlib.ExitStack() as opened:
                client = None
                if kind == "tcp":
                    client = opened.enter_context(wire.Connection(address))
                    assert client.ask(WRITE) == WRITE
                parent.stdin.write("fork\n")
                parent.stdin.flush()
                started = parent.stdout.readline().split()
                assert started[1:] == [str(port)], "the port is free for the next server"
                assert parent.stdout.readline() == "stopped\n"
                if client is not None:
                    assert client.rest() == b""
                    with pytest.raises(ConnectionRefusedError):
                        wire.Connection(address)
            with socket.create_connection(("127.0.0.1", other), wire.DEADLINE):
                pass  # What does not belong to the server stays open.
            _, errors = parent.communicate("end\n", timeout=wire.DEADLINE)
            assert (parent.returncode, errors) == (0, "")
        finally:
            parent.kill()
