"""A program that runs as a child process, and does not outlive this process."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from holdfast.runtime import exec_with_parent
from holdfast.runtime.stop import Stop

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.runtime.backoff import Backoff

if sys.platform == "win32":
    _FLAGS = subprocess.CREATE_NEW_PROCESS_GROUP
else:
    _FLAGS = 0

STOP_TIMEOUT_S = 10.0
"""Seconds that the program has to end, before it is killed."""

MAX_LINE_CHARACTERS = 1000
"""A longer line of output is passed on in parts."""


class ChildFailed(Exception):
    """The program ended before it was ready, or took too long. The message says why."""


class Output(Protocol):
    """Reads the output of the program, in the thread that runs it."""

    is_ready: bool
    """Whether the program serves, as far as its output says."""
    error: str
    """The last error that the program has reported; empty for none."""

    def begin(self) -> None:
        """Forgets what a former run has said."""

    def take(self, line: str) -> None:
        """Takes a line of output, standard or error."""


class ChildProcess:
    """A program that runs from `start` to `stop`, in a session of its own.

    One thread starts it and reads its output: on Linux the program ends with that thread, and so
    with this process, however it ends; on Windows with this process. With `restarts`, a program
    that was ready is started again whenever it ends, after a pause, which `ended` gets with the
    reason.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        output: Output,
        *,
        restarts: Backoff | None = None,
        ended: Callable[[str, float], None] | None = None,
        inherited: int | None = None,
    ) -> None:
        """The program keeps the descriptor `inherited`, a file that gets its process id."""
        self.restarts = 0
        """How often the program was started again."""
        self.end: str | None = None
        """Why the program has ended, if it is not started again."""
        self._name = Path(command[0]).stem
        self._command = list(command)
        self._output = output
        self._restarts, self._ended = restarts, ended
        self._inherited = inherited
        self._stop = Stop()
        self._ready = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def is_ready(self) -> bool:
        """Whether the program currently serves."""
        return self._ready.is_set()

    def start(self, within_s: float) -> None:
        """Returns when the program is ready. Raises `ChildFailed`; nothing runs then."""
        try:
            self._thread.start()
            deadline = time.monotonic() + within_s
            while not self._ready.wait(0.05):
                self.check()
                if time.monotonic() > deadline:
                    raise ChildFailed(f"{self._name} did not start within {within_s:g} s")
        except BaseException:
            self.stop()
            raise

    def check(self) -> None:
        """Raises `ChildFailed` if the program has ended, and is not started again."""
        if self.end is not None:
            raise ChildFailed(f"{self._name} ended: {self.end}")

    def terminate(self) -> None:
        """Ends the program. With `restarts`, it is started again as if it had ended by itself."""
        with self._lock:
            if self._process is not None:
                self._process.terminate()

    def stop(self) -> None:
        """Ends the program, and waits for that. Kills it if it takes too long."""
        self._stop.set()
        self.terminate()
        if self._thread.ident is None:
            return
        self._thread.join(STOP_TIMEOUT_S)
        with self._lock:
            if self._process is not None:
                self._process.kill()
        self._thread.join(STOP_TIMEOUT_S)

    def _run(self) -> None:
        was_ready = False
        reason = ""
        while not self._stop.is_set():
            began = time.monotonic()
            try:
                reason = self._once()
            except OSError as error:
                reason = str(error)
            was_ready = was_ready or self._ready.is_set()
            self._ready.clear()
            if self._stop.is_set() or not was_ready or self._restarts is None:
                break
            pause_s = self._restarts.failed(time.monotonic() - began)
            if self._ended is not None:
                self._ended(reason, pause_s)
            self._stop.wait(pause_s)
            self.restarts += 1
        self.end = reason

    def _once(self) -> str:
        """Runs the program until it ends. Returns why it has ended."""
        self._output.begin()
        with self._lock:
            if self._stop.is_set():
                return "stopped"
            process = self._process = self._started()
        assert process.stdout is not None
        with process.stdout as lines:
            while line := lines.readline(MAX_LINE_CHARACTERS):
                self._output.take(line.rstrip())
                if self._output.is_ready:
                    self._ready.set()
        code = process.wait()
        with self._lock:
            self._process = None
        ending = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
        error = self._output.error
        if not error:
            return ending
        # One that was ready may have said it long before, of something else.
        return f"{ending}; its last error: {error}" if self._output.is_ready else error

    def _started(self) -> subprocess.Popen[str]:
        command, inherited = self._command, self._inherited
        if sys.platform != "win32" and sys.executable:
            descriptor = -1 if inherited is None else inherited
            become = [sys.executable, "-I", "-S", exec_with_parent.__file__, str(descriptor)]
            command = [*become, str(os.getpid()), *command]
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            # Ctrl-C must not reach the program: this process still needs it for its last work.
            start_new_session=True,
            creationflags=_FLAGS,
            pass_fds=() if inherited is None or sys.platform == "win32" else (inherited,),
        )
        if sys.platform == "win32":
            from holdfast.runtime import windows_job

            try:
                windows_job.join(process)
            except OSError:
                process.kill()
                process.communicate()
                raise
        return process
