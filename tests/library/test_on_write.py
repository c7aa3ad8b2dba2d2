"""`Memory.on_write` calls a function for every write, and never holds up a writer."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import threading
from queue import Queue
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from support import wire

if TYPE_CHECKING:
    from support.running import Serve

Call = tuple[str, int, list[int]]

FORKS = """
import os, sys, threading, holdfast
memory = holdfast.Memory(holding_registers=100)
writing = memory.on_write(lambda area, address, values: None)
def write():
    while True:
        memory.write("holding_registers", 0, [1] * 100)
threading.Thread(target=write, daemon=True).start()
for _ in range(100):
    child = os.fork()
    if not child:
        sys.exit(writing.dropped)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
"""


NO_THREAD = """
import threading, holdfast
def start(self):
    raise RuntimeError("can't start new thread")
threading.Thread.start = start
try:
    holdfast.Memory(coils=1).on_write(print)
except RuntimeError as error:
    print(error)
"""


class Calls:
    """A callback that keeps its calls."""

    def __init__(self) -> None:
        self._calls: Queue[Call] = Queue()

    def __call__(self, area: str, address: int, values: list[int]) -> None:
        self._calls.put((area, address, values))

    def next(self) -> Call:
        return self._calls.get(timeout=wire.DEADLINE)

    @property
    def is_empty(self) -> bool:
        return self._calls.empty()


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(coils=20, holding_registers=65536)


def test_writes_of_modbus_and_of_the_program_are_called_in_order(
    memory: holdfast.Memory, serve: Serve
) -> None:
    calls = Calls()
    port = serve({1: memory}).address[1]
    with (
        memory.on_write(calls) as writing,
        holdfast.SyncClient(f"tcp://127.0.0.1:{port}", timeout=wire.DEADLINE) as plc,
    ):
        memory.write("coils", 3, [1, 0, True])
        plc.write_registers(10, [1, 65535])
        plc.write_coil(19, True)
        plc.mask_write(10, and_mask=0xFF00, or_mask=0x0002)
        memory.write_many([("coils", 0, [1]), ("holding_registers", 5, [6])])
        with pytest.raises(holdfast.ModbusException):
            plc.write_coil(20, True)
        memory.write("coils", 0, [1])
        assert [calls.next() for _ in range(7)] == [
            ("coils", 3, [1, 0, 1]),
            ("holding_registers", 10, [1, 65535]),
            ("coils", 19, [1]),
            ("holding_registers", 10, [2]),
            ("coils", 0, [1]),
            ("holding_registers", 5, [6]),
            ("coils", 0, [1]),
        ]
        assert writing.dropped == 0


def test_only_clients_so_that_a_callback_may_write(memory: holdfast.Memory, serve: Serve) -> None:
    done = threading.Event()
    calls = Calls()

    def answer(area: str, address: int, values: list[int]) -> None:
        calls(area, address, values)
        memory.write("holding_registers", 100, [values[0] + 1])
        if values == [2]:
            done.set()

    port = serve({1: memory}).address[1]
    with (
        memory.on_write(answer, clients_only=True),
        holdfast.SyncClient(f"tcp://127.0.0.1:{port}", timeout=wire.DEADLINE) as plc,
    ):
        plc.write_register(0, 1)
        plc.write_register(0, 2)
        assert done.wait(wire.DEADLINE)
    assert [calls.next(), calls.next()] == [
        ("holding_registers", 0, [1]),
        ("holding_registers", 0, [2]),
    ]
    assert calls.is_empty
    assert memory.read("holding_registers", 100, 1) == [3]


def test_a_slow_callback_holds_up_nobody_and_loses_the_oldest(
    memory: holdfast.Memory, serve: Serve
) -> None:
    calls, go = Calls(), threading.Event()

    def slow(area: str, address: int, values: list[int]) -> None:
        go.wait(wire.DEADLINE)
        calls(area, address, values)

    port = serve({1: memory}).address[1]
    with memory.on_write(slow) as writing:
        for number in range(6000):
            memory.write("holding_registers", 0, [number])
        with holdfast.SyncClient(f"tcp://127.0.0.1:{port}", timeout=wire.DEADLINE) as plc:
            plc.write_register(0, 60000)
        dropped = writing.dropped
        assert dropped > 0
        go.set()
        numbers: list[int] = []
        while not numbers or numbers[-1] != 60000:
            numbers.append(calls.next()[2][0])
    assert numbers == sorted(numbers)
    assert len(numbers) == 6001 - dropped


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, GeneratorExit])
def test_an_exception_of_a_callback_is_reported_and_the_next_call_follows(
    error: type[BaseException], memory: holdfast.Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: Queue[Any] = Queue()
    monkeypatch.setattr(threading, "excepthook", reported.put)
    calls = Calls()

    def fails(area: str, address: int, values: list[int]) -> None:
        if values == [0]:
            raise error
        calls(area, address, values)

    with memory.on_write(fails):
        memory.write("coils", 0, [0])
        memory.write("coils", 0, [1])
        assert reported.get(timeout=wire.DEADLINE).exc_type is error
        assert calls.next() == ("coils", 0, [1])


def test_a_callback_that_exits_is_printed_and_the_next_call_follows(
    memory: holdfast.Memory, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.__excepthook__)
    calls = Calls()

    def exits(area: str, address: int, values: list[int]) -> None:
        calls(area, address, values)
        sys.exit("no pump")

    with memory.on_write(exits):
        memory.write("coils", 0, [0])
        memory.write("coils", 0, [1])
        assert [calls.next(), calls.next()] == [("coils", 0, [0]), ("coils", 0, [1])]
        assert "exits at 0x" in (told := capsys.readouterr().err)
        assert "raised SystemExit('no pump')" in told


class AwaitedCalls:
    async def __call__(self, area: str, address: int, values: list[int]) -> None: ...


async def awaited(area: str, address: int, values: list[int]) -> None: ...


@pytest.mark.parametrize(
    "callback",
    [awaited, AwaitedCalls(), functools.partial(awaited, "coils")],
    ids=["function", "object", "partial"],
)
def test_an_async_def_is_no_callback(callback: Any, memory: holdfast.Memory) -> None:
    with pytest.raises(TypeError, match="an async def, allowed: a plain function"):
        memory.on_write(callback)


def test_after_close_nothing_is_called(memory: holdfast.Memory) -> None:
    first, second = Calls(), Calls()
    writing = memory.on_write(first)
    memory.on_write(second)
    memory.write("coils", 0, [1])
    assert first.next() == second.next() == ("coils", 0, [1])
    writing.close()
    writing.close()
    memory.write("coils", 1, [1])
    assert second.next() == ("coils", 1, [1])
    assert first.is_empty


def test_a_callback_can_close_itself(memory: holdfast.Memory) -> None:
    calls = Calls()

    def once(area: str, address: int, values: list[int]) -> None:
        writing.close()
        calls(area, address, values)

    writing = memory.on_write(once)
    memory.write("coils", 0, [1])
    memory.write("coils", 1, [1])
    assert calls.next() == ("coils", 0, [1])
    wire.until(lambda: "holdfast-on-write" not in threads(), "the thread has ended")
    assert calls.is_empty


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate()]


def test_the_thread_ends_with_the_memory() -> None:
    memory = holdfast.Memory(coils=8)
    memory.on_write(Calls())
    assert "holdfast-on-write" in threads()
    del memory
    wire.until(lambda: "holdfast-on-write" not in threads(), "the thread has ended")


def test_a_program_ends_with_a_callback_that_waits() -> None:
    code = (
        "import holdfast; m = holdfast.Memory(coils=8); m.on_write(print); m.write('coils', 0, [1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, timeout=wire.DEADLINE * 3
    )
    assert (done.returncode, done.stderr) == (0, b"")


def test_without_a_thread_nothing_is_left_for_the_end_of_the_program() -> None:
    command = [sys.executable, "-c", NO_THREAD]
    done = subprocess.run(command, check=False, capture_output=True, timeout=wire.DEADLINE * 3)
    assert (done.stdout, done.stderr) == (b"can't start new thread\n", b"")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="requires fork")
def test_a_forked_child_ends_whatever_the_threads_of_its_parent_do() -> None:
    # Python 3.12 and later warn of a fork while threads run.
    words = ["-W", "ignore::DeprecationWarning", "-c", FORKS]
    done = subprocess.run(
        [sys.executable, *words], check=False, capture_output=True, timeout=wire.DEADLINE * 3
    )
    assert (done.returncode, done.stderr) == (0, b"")


def test_what_is_no_function_is_refused(memory: holdfast.Memory) -> None:
    with pytest.raises(TypeError, match="callback is 7, allowed: a function"):
        memory.on_write(7)  # type: ignore[arg-type]
