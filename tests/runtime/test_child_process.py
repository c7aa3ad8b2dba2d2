"""Programs that run as child processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from holdfast.runtime import child_process
from holdfast.runtime.backoff import Backoff
from holdfast.runtime.child_process import ChildFailed, ChildProcess
from support import wire
from support.machine import is_over

SERVE = "import os, signal; print(os.getpid()); print('ready', flush=True); signal.pause()"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {SERVE}"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals")


class Lines:
    """Keeps all lines. A program is ready when it says so."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.begin()

    def begin(self) -> None:
        self.is_ready, self.error = False, ""

    def take(self, line: str) -> None:
        self.lines.append(line)
        self.is_ready = line == "ready"
        if line.startswith("error: "):
            self.error = line

    @property
    def process(self) -> int:
        """The id of the last process that was started."""
        return [int(line) for line in self.lines if line.isdigit()][-1]


def child(program: str, output: Lines, **more: object) -> ChildProcess:
    return ChildProcess("a test", [sys.executable, "-c", program], output, **more)  # type: ignore[arg-type]


def test_a_program_runs_from_the_start_to_the_stop() -> None:
    output = Lines()
    running = child(SERVE, output)
    running.start(wire.DEADLINE)
    assert running.is_ready
    assert not is_over(output.process)
    running.check()
    running.stop()
    assert is_over(output.process)
    assert not running.is_ready


def test_a_program_that_ends_before_it_is_ready_failed_for_the_reason_that_it_gave() -> None:
    program = "print('error: no space'); print('bye'); raise SystemExit(3)"
    for text, reason in ((program, "error: no space"), ("raise SystemExit(3)", "exit code 3")):
        with pytest.raises(ChildFailed, match=rf"^python\S* ended: {reason}$"):
            child(text, Lines(), restarts=Backoff(0.0, 0.0, jitter=False)).start(wire.DEADLINE)


def test_a_program_that_is_not_ready_in_time_is_ended() -> None:
    output = Lines()
    running = child(SERVE.replace("ready", "wait"), output)
    with pytest.raises(ChildFailed, match=r"^python\S* did not start within 0\.01 s$"):
        running.start(0.01)
    assert not output.lines or is_over(output.process)


def test_a_program_that_ignores_the_request_to_end_is_killed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(child_process, "STOP_TIMEOUT_S", 0.1)
    output = Lines()
    running = child(STUBBORN, output)
    running.start(wire.DEADLINE)
    running.stop()
    wire.until(lambda: is_over(output.process), "it is killed")
    wire.until(lambda: running.end == "killed by signal 9", "its end is known")


def test_a_program_that_is_not_restarted_is_known_to_have_ended() -> None:
    output = Lines()
    running = child(SERVE, output)
    running.start(wire.DEADLINE)
    os.kill(output.process, signal.SIGKILL)
    wire.until(lambda: running.end is not None, "it has ended")
    with pytest.raises(ChildFailed, match="ended: killed by signal 9"):
        running.check()
    running.stop()


def test_a_program_is_restarted_after_pauses_that_grow() -> None:
    output = Lines()
    ended: list[tuple[str, float]] = []
    backoff = Backoff(0.01, 60.0, jitter=False)
    running = child(SERVE, output, restarts=backoff, ended=lambda *told: ended.append(told))
    running.start(wire.DEADLINE)
    output.error = "error: no space"
    for times in (1, 2):
        before = output.process
        os.kill(before, signal.SIGKILL)
        wire.until(lambda: running.is_ready and running.restarts == times, "it is back")  # noqa: B023
        assert output.process != before
    running.check()
    running.stop()
    # What a run has said is no reason for the end of the next one.
    assert ended == [
        ("killed by signal 9; its last error: error: no space", 0.01),
        ("killed by signal 9", 0.02),
    ]


def test_a_program_that_is_terminated_is_restarted() -> None:
    output = Lines()
    running = child(SERVE, output, restarts=Backoff(0.01, 60.0, jitter=False))
    running.start(wire.DEADLINE)
    before = output.process
    running.terminate()
    wire.until(lambda: running.is_ready and running.restarts == 1, "it is back")
    assert is_over(before)
    running.stop()
    assert is_over(output.process)


def test_a_stop_ends_the_pause_before_a_restart() -> None:
    output = Lines()
    paused = threading.Event()
    hour = Backoff(3600.0, 3600.0, jitter=False)
    running = child(SERVE, output, restarts=hour, ended=lambda *_: paused.set())
    running.start(wire.DEADLINE)
    os.kill(output.process, signal.SIGKILL)
    assert paused.wait(wire.DEADLINE)
    running.stop()
    assert running.end == "killed by signal 9"


def test_a_program_that_does_not_exist_failed() -> None:
    running = ChildProcess("a test", ["/does/not/exist"], Lines())
    with pytest.raises(ChildFailed, match=r"^exist ended: "):
        running.start(wire.DEADLINE)


def test_the_process_id_is_in_the_file_that_the_program_keeps(tmp_path: Path) -> None:
    file = tmp_path / "lock"
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT)
    output = Lines()
    program = f"import os; os.fstat({descriptor}); {SERVE}"
    running = child(program, output, inherited=descriptor)
    running.start(wire.DEADLINE)
    assert int(file.read_text()) == output.process
    running.stop()
    os.close(descriptor)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends it at once")
def test_a_program_ends_with_a_process_that_is_killed() -> None:
    text = f"""
import sys, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_child_process import SERVE, Lines, child
output = Lines()
running = child(SERVE, output)
running.start(60)
print(output.process, flush=True)
time.sleep(600)
"""
    path = os.pathsep.join(sys.path)
    with subprocess.Popen(
        [sys.executable, "-c", text],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as parent:
        assert parent.stdout is not None
        process = int(parent.stdout.readline())
        assert not is_over(process)
        parent.kill()
    wire.until(lambda: is_over(process), "it has ended too")
