"""Child processes on Windows: they end with this process."""

from __future__ import annotations

import ctypes
import sys
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.runtime import windows_job
from holdfast.runtime.child_process import ChildFailed, ChildProcess
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.runtime.child_process import Output

JOB, PROCESS = 2**40 + 1, 2**40 + 2


class Kernel:
    """The functions of Windows for jobs."""

    def __init__(self) -> None:
        self.flags: dict[int, int] = {}
        self.joined: list[tuple[int, int]] = []
        self.CreateJobObjectW = Function(lambda *_: JOB)
        self.allows = True

    def SetInformationJobObject(self, job: Any, kind: int, limits: Any, size: int) -> int:
        content = ctypes.string_at(limits, size)
        assert (job.value, kind, size) == (JOB, 9, 144)
        self.flags[job.value] = int.from_bytes(content[16:20], sys.byteorder)
        return 1

    def AssignProcessToJobObject(self, job: Any, process: Any) -> int:
        self.joined.append((job.value, process.value))
        return int(self.allows)


class Function:
    """A function of a library, whose result has a type."""

    def __init__(self, call: Any) -> None:
        self._call = call
        self.restype: Any = None

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Iterator[Kernel]:
    made = Kernel()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "WinDLL", lambda *_, **__: made, raising=False)
    monkeypatch.setattr(ctypes, "get_last_error", lambda: 5, raising=False)
    monkeypatch.setattr(ctypes, "WinError", lambda code: OSError(code, "denied"), raising=False)
    windows_job._job.cache_clear()
    yield made
    windows_job._job.cache_clear()


def process() -> Any:
    return SimpleNamespace(_handle=PROCESS)


def test_all_processes_are_in_one_job_that_ends_them(kernel: Kernel) -> None:
    windows_job.join(process())
    windows_job.join(process())
    assert kernel.flags == {JOB: 0x2000}
    assert kernel.joined == [(JOB, PROCESS)] * 2


def test_a_process_that_can_not_join_is_an_error(kernel: Kernel) -> None:
    kernel.allows = False
    with pytest.raises(OSError, match="denied"):
        windows_job.join(process())


class Ready:
    """The output of a program that is ready at once."""

    is_ready, error = True, ""

    def begin(self) -> None:
        pass

    def take(self, line: str) -> None:
        pass


@pytest.mark.parametrize("allows", [True, False])
def test_a_child_process_joins_or_does_not_run(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch, *, allows: bool
) -> None:
    kernel.allows = allows
    started: list[Any] = []

    def join(process: Any) -> None:
        started.append(process)
        process._handle = PROCESS
        joined(process)

    joined = windows_job.join
    monkeypatch.setattr(windows_job, "join", join)
    output: Output = Ready()
    program = "import time; print(1, flush=True); time.sleep(1000)"
    running = ChildProcess("a test", [sys.executable, "-c", program], output)
    if allows:
        running.start(wire.DEADLINE)
        running.stop()
    else:
        with pytest.raises(ChildFailed, match="denied"):
            running.start(wire.DEADLINE)
    [process] = started
    assert kernel.joined == [(JOB, PROCESS)]
    assert process.poll() is not None
