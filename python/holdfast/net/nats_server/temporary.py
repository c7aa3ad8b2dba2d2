"""A NATS server for the time of one command, on the loopback interface only."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Self

from holdfast.net.nats_server.folder import ServerUnusable
from holdfast.net.nats_server.log import ServerLog
from holdfast.net.nats_server.server import require_program
from holdfast.runtime.child_process import ChildFailed, ChildProcess

HOST = "127.0.0.1"

START_TIMEOUT_S = 15.0
"""Seconds to wait for the server to start."""


class TemporaryServer:
    """A server with JetStream and without credentials, as a context manager.

    Port 0 chooses a free port. `store` is the folder of JetStream's data; without it the data is
    lost when the server stops. Raises `ServerUnusable`.
    """

    def __init__(self, port: int, store: Path | None = None) -> None:
        self._port = port
        self._store = store
        self.url = ""
        """The URL of the server."""

    def __enter__(self) -> Self:
        program = require_program()
        self._folder = tempfile.TemporaryDirectory(prefix="holdfast-nats-")
        store = self._store or Path(self._folder.name)
        command = [program, "-a", HOST, "-p", str(self._port or -1), "-js", "-sd", str(store)]
        log = ServerLog()
        self._child = ChildProcess("holdfast-nats", command, log)
        try:
            self._child.start(START_TIMEOUT_S)
        except BaseException as error:
            self._folder.cleanup()
            if isinstance(error, ChildFailed):
                raise ServerUnusable(str(error)) from None
            raise
        self.url = f"nats://{log.address}"
        return self

    def __exit__(self, *_: object) -> None:
        self._child.stop()
        self._folder.cleanup()

    def check(self) -> None:
        """Raises `ServerUnusable` if the server has ended."""
        try:
            self._child.check()
        except ChildFailed as error:
            raise ServerUnusable(str(error)) from None
