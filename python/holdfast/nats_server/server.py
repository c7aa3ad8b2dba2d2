"""Runs nats-server as a child process, and starts it again if it ends."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

from holdfast import logs
from holdfast.nats_server import becoming
from holdfast.nats_server.folder import Folder, ServerUnusable
from holdfast.nats_server.program import MISSING, find_program
from holdfast.runtime.backoff import Backoff
from holdfast.stop import Stop

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.nats_server.folder import Access

FIRST_PAUSE = 0.2
MAX_PAUSE = 30.0
"""Seconds before a server that has ended is started again. Each time doubles the pause."""

PROVEN = 60.0
"""After running at least this many seconds, the pauses start from the first again."""

STARTING = 60.0
"""Seconds to wait for the server at the start: it reads all that it has stored."""

ENDING = 10.0
"""Seconds that the server has to end, before it is killed."""

MAX_LINE = 1000
"""A longer line of the server is shown in parts."""

_LINE = re.compile(r"\[\d+\] [\d/]+ [\d:.]+ \[(?P<level>[A-Z]{3})\] ?(?P<text>.*)")
_LEVELS = {"INF": logging.DEBUG, "WRN": logging.WARNING, "ERR": logging.ERROR, "FTL": logging.ERROR}
_READY = "Server is ready"


class NatsServer:
    """A server with JetStream, which runs from `start` to `stop`.

    One thread starts it each time and reads its log: on Linux the server ends with that thread, and
    so with this process, however it ends.
    """

    def __init__(self, name: str, path: Path, access: Access) -> None:
        self.restarts = 0
        """How often the server was started again."""
        self._name = name
        self._path = path
        self._access = access
        self._stop = Stop()
        self._ready = threading.Event()
        self._over = threading.Event()
        self._reason = ""
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._folder: Folder | None = None
        self._thread = threading.Thread(target=self._run, name=f"holdfast-nats-{name}", daemon=True)

    def start(self) -> None:
        """Returns when the server is ready. Raises `ServerUnusable`; nothing runs then."""
        program = find_program()
        if program is None:
            raise ServerUnusable(MISSING)
        self._folder = Folder(self._path)
        try:
            if self._folder.ended is not None:
                logs.write(
                    logging.WARNING,
                    "log_server_left_over",
                    log=self._name,
                    process=self._folder.ended,
                )
            file = self._folder.configured(self._access)
            self._command = [program, "-c", str(file)]
            self._thread.start()
            self._wait()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Ends the server, and waits for that."""
        self._stop.set()
        with self._lock:
            if self._process is not None:
                self._process.terminate()
        if self._thread.ident is not None:
            self._thread.join(ENDING)
            with self._lock:
                if self._process is not None:
                    self._process.kill()
            self._thread.join(ENDING)
        if self._folder is not None:
            self._folder.close()

    def status(self) -> dict[str, Any]:
        """Whether the server runs, and how often it was started again."""
        return {"running": self._ready.is_set(), "restarts": self.restarts}

    def _wait(self) -> None:
        deadline = time.monotonic() + STARTING
        while not self._ready.wait(0.05):
            if self._over.is_set():
                raise ServerUnusable(f"nats-server ended: {self._reason}")
            if time.monotonic() > deadline:
                raise ServerUnusable(f"nats-server did not start within {STARTING:g} s")

    def _run(self) -> None:
        backoff = Backoff(FIRST_PAUSE, MAX_PAUSE, jitter=False, proven_s=PROVEN)
        was_ready = False
        while not self._stop.is_set():
            began = time.monotonic()
            try:
                self._once()
            except OSError as error:
                self._reason = str(error)
            was_ready = was_ready or self._ready.is_set()
            self._ready.clear()
            if self._stop.is_set() or not was_ready:
                break
            pause = backoff.failed(time.monotonic() - began)
            logs.write(
                logging.ERROR, "log_server_ended", log=self._name, error=self._reason, pause=pause
            )
            self._stop.wait(pause)
            self.restarts += 1
        self._over.set()

    def _once(self) -> None:
        """Runs the server until it ends."""
        with self._lock:
            if self._stop.is_set():
                return
            process = self._process = self._started()
        self._reason = ""
        assert process.stdout is not None
        with process.stdout as lines:
            while line := lines.readline(MAX_LINE):
                self._pass_on(line.rstrip())
        code = process.wait()
        with self._lock:
            self._process = None
        self._reason = self._reason or (
            f"killed by signal {-code}" if code < 0 else f"exit code {code}"
        )

    def _started(self) -> subprocess.Popen[str]:
        assert self._folder is not None, "start has locked the folder"
        command, inherited = self._command, self._folder.inherited
        if sys.platform != "win32" and sys.executable:
            become = [sys.executable, "-I", "-S", becoming.__file__, str(inherited)]
            command = [*become, str(os.getpid()), *command]
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            # Ctrl-C must not reach the server: the appliance still needs it for its last writes.
            start_new_session=True,
            pass_fds=() if sys.platform == "win32" else (inherited,),
        )

    def _pass_on(self, line: str) -> None:
        """Logs a line of the server's log."""
        match = _LINE.fullmatch(line)
        text = line if match is None else match["text"]
        if not text.strip():
            return
        level = logging.ERROR if match is None else _LEVELS.get(match["level"], logging.DEBUG)
        if level >= logging.ERROR:
            self._reason = text
        if text == _READY:
            self._ready.set()
        if level >= logging.WARNING:
            logs.limited(level, "log_server", kind=self._name, log=self._name, text=text)
        else:
            logs.write(level, "log_server", log=self._name, text=text)
