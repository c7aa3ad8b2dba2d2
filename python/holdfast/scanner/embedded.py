"""Runs a NATS server as a child process, on the loopback interface only."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Self

from holdfast.nats_server.program import MISSING, find_program

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

HOST = "127.0.0.1"
STARTING = 15.0
"""Seconds to wait for the server to start."""

ENDING = 5.0
"""Seconds to wait for the server to stop."""

DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""


class EmbeddedFailed(Exception):
    """The server did not start, or ended. The message says why."""


class Embedded:
    """A server with JetStream, as a context manager.

    Port 0 chooses a free port. `store` is the folder of JetStream's data; without it the data is
    lost when the server stops. Raises `EmbeddedFailed`.
    """

    def __init__(self, port: int, store: Path | None = None) -> None:
        self._port = port
        self._store = store
        self.url = ""
        """The URL of the server."""

    def __enter__(self) -> Self:
        program = find_program()
        if program is None:
            raise EmbeddedFailed(MISSING)
        self._folder = tempfile.TemporaryDirectory(prefix="holdfast-nats-")
        folder = Path(self._folder.name)
        self._log = folder / "log"
        store = self._store or folder / "store"
        command = [program, "-a", HOST, "-p", str(self._port or -1), "-js", "-sd", str(store)]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*command, "--ports_file_dir", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Ctrl-C must not reach the server: the scanner sends its last messages first.
                start_new_session=True,
                preexec_fn=_die_with_parent(),
            )
        try:
            self.url = self._started(folder)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def check(self) -> None:
        """Raises `EmbeddedFailed` if the server has ended."""
        if self._process.poll() is not None:
            raise EmbeddedFailed(f"nats-server ended: {self._reason()}")

    def _started(self, folder: Path) -> str:
        """Waits until the server is ready. Returns its URL."""
        deadline = time.monotonic() + STARTING
        while time.monotonic() < deadline:
            self.check()
            for file in folder.glob("*.ports"):
                try:
                    urls = json.loads(file.read_bytes())["nats"]
                except ValueError:
                    continue  # The file is incomplete.
                return str(urls[0])
            time.sleep(0.01)
        raise EmbeddedFailed(f"nats-server did not start within {STARTING:g} s")

    def _reason(self) -> str:
        """Returns the last error in the server's log, or its signal or exit code."""
        lines = self._log.read_text(errors="replace").splitlines()
        for line in reversed(lines):
            if "[FTL]" in line or "[ERR]" in line or not line.startswith("["):
                return line
        code = self._process.returncode
        return f"killed by signal {-code}" if code < 0 else f"exit code {code}"

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()


def _die_with_parent() -> Callable[[], None] | None:
    """Returns a function that makes the child end with this process, even after SIGKILL.

    Returns `None` on systems other than Linux.
    """
    if not sys.platform.startswith("linux"):
        return None
    import ctypes
    import signal

    libc = ctypes.CDLL(None)

    def prepare() -> None:
        libc.prctl(DIE_WITH_PARENT, signal.SIGTERM)

    return prepare
