"""Clients whose process forks."""

from __future__ import annotations

import subprocess
import sys

import pytest

from support import wire
from support.fake_device import Stream, good

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows does not fork")

FORK = """
import asyncio, copy, os, sys
from holdfast import Client, SyncClient
class Equal(SyncClient):
    def __eq__(self, other):
        return isinstance(other, Equal)
    def __hash__(self):
        return 0
MADE, URL = sys.argv[1:]
clients = eval(MADE)
def read(address):
    call = clients[-1].read_holding_registers(address, 1)
    return call if isinstance(call, list) else asyncio.run(waited(call))
async def waited(call):
    return await call
assert read(1) == [1]
child = os.fork()
addresses = range(100, 120) if child else range(200, 220)
found = [read(address) for address in addresses]
if child:
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert found == [[address] for address in addresses], found
os._exit(found != [[address] for address in addresses])
"""

FORK_DURING_A_CALL = """
import os, sys, threading, holdfast
client = holdfast.SyncClient(sys.argv[1], timeout=10)
waiting = threading.Thread(target=client.read_holding_registers, args=(1, 1))
waiting.start()
sys.stdin.readline()
child = os.fork()
if not child:
    os._exit(client.read_holding_registers(2, 1) != [2])
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
print("released", flush=True)
waiting.join()
"""

FORK_WITH_A_POLLER = """
import asyncio, os, sys, holdfast
poller = holdfast.Poller()
name = poller.add(sys.argv[1], {"x": ("holding_registers", 0)})
async def first():
    async for batch in poller:
        return batch
assert poller.take() is not None
child = os.fork()
if child:
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    poller.write(name, "x", 1)
    poller.close()
else:
    for use in (
        lambda: poller.add(sys.argv[1], {"y": ("coils", 0)}),
        lambda: poller.write(name, "x", 1),
        lambda: poller.remove(name),
        lambda: next(iter(poller)),
        lambda: asyncio.run(first()),
        poller.counters,
        poller.take,
    ):
        try:
            use()
        except RuntimeError as error:
            print(error)
    poller.close()
"""


def python(script: str, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        # Python 3.12 and later warn of a fork while threads run.
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", script, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    "made",
    [
        "[SyncClient(URL)]",
        "[Client(URL)]",
        "[copy.copy(SyncClient(URL))]",
        "[copy.copy(Client(URL))]",
        "[Equal(URL), Equal(URL)]",
    ],
)
@pytest.mark.parametrize("transport", ["tcp", "rtu+tcp"])
def test_a_forked_child_has_a_connection_of_its_own(made: str, transport: str) -> None:
    with Stream(transport) as device, python(FORK, made, device.url) as parent:
        _, errors = parent.communicate(timeout=wire.DEADLINE)
        assert (parent.returncode, errors) == (0, "")
        assert device.connections > 1


def test_a_child_that_is_forked_during_a_call_of_another_thread_has_its_own() -> None:
    with Stream("tcp") as device:
        device.script = [lambda _: None, good]
        with python(FORK_DURING_A_CALL, device.url) as parent:
            device.await_requests(1)
            assert parent.stdin is not None
            assert parent.stdout is not None
            parent.stdin.write("fork\n")
            parent.stdin.flush()
            assert parent.stdout.readline() == "released\n"
            parent.kill()


def test_a_poller_says_in_a_forked_child_that_it_is_of_its_parent() -> None:
    with Stream("tcp") as device, python(FORK_WITH_A_POLLER, device.url) as parent:
        try:
            output, errors = parent.communicate(timeout=wire.DEADLINE)
        finally:
            parent.kill()
    assert (parent.returncode, errors) == (0, "")
    said = "this poller works in the process that has made it, not in a child"
    assert output.splitlines() == [said] * 7
