"""The folder of a NATS server: its data, its configuration, and who uses it."""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holdfast.events.file_lock import lock
from holdfast.net.nats_server.storage_limit import possible_limit
from holdfast.net.secret_file import read_secret
from holdfast.runtime.whole_files import SECRET, replace

LEFT_OVER_END_TIMEOUT_S = 10.0
"""Seconds that a server which has lost its appliance has to end."""

_HASH = re.compile(r"\$2[abxy]\$\d{2}\$", re.ASCII)
"""How a secret begins that nats-server takes for a hash, and compares with that of what it gets."""


class ServerUnusable(OSError):
    """The server can't be started. The message says why."""


class TemporarilyUnusable(ServerUnusable):
    """Another start may succeed: the disk is full, or the server has not started."""


class InUse(TemporarilyUnusable):
    """Another process uses the folder."""


@dataclass(frozen=True)
class Access:
    """Where a server listens, and what its clients show.

    A token file in the folder of the server is made if it does not exist.
    """

    host: str
    port: int
    username: str | None = None
    password_file: Path | None = None
    token_file: Path | None = None


class Folder:
    """A folder that one process uses, from the constructor to `close`.

    Two files are locked: `holdfast.lock` by this process, and `nats-server.lock` by the server,
    which inherits the lock. A server that has lost its appliance is found by its lock, and ended.
    """

    def __init__(self, path: Path) -> None:
        """Creates the folder if it does not exist. Raises `ServerUnusable`."""
        self.path = path
        self.ended: int | None = None
        """The process id of a server that was left over."""
        self.store = path / "store"
        """Where the server stores its data."""
        self.limit = 0
        """How many bytes it may store, as it was configured last."""
        self._own = self._server = -1
        try:
            path.mkdir(mode=0o700, exist_ok=True)
            self._own = _opened(path / "holdfast.lock")
            self._server = _opened(path / "nats-server.lock")
            self._lock()
        except BaseException as error:
            self.close()
            if isinstance(error, OSError) and not isinstance(error, ServerUnusable):
                raise _unusable(path, error) from error
            raise

    @property
    def inherited(self) -> int:
        """The descriptor of the lock that the server inherits."""
        return self._server

    def configured(self, access: Access) -> Path:
        """Writes the server's configuration. Returns its file."""
        file = self.path / "nats-server.conf"
        try:
            limit = possible_limit(self.store)
            settings = json.dumps(self._settings(access, limit), indent=2, ensure_ascii=False)
            replace(file, f"{settings}\n".encode(), SECRET)
            self.limit = limit
        except OSError as error:
            raise _unusable(error.filename or file, error) from error
        return file

    def close(self) -> None:
        """Unlocks the folder."""
        for descriptor in (self._own, self._server):
            if descriptor >= 0:
                os.close(descriptor)
        self._own = self._server = -1

    def _lock(self) -> None:
        if not lock(self._own):
            raise InUse(f"{self.path} is in use by another process")
        deadline = time.monotonic() + LEFT_OVER_END_TIMEOUT_S
        while not lock(self._server):
            left = _process_of(self._server)
            if left is None or (self.ended is not None and time.monotonic() > deadline):
                shown = "" if left is None else f", process {left}"
                raise InUse(f"{self.path} is in use by another nats-server{shown}")
            self.ended = left
            with suppress(ProcessLookupError):
                os.kill(left, signal.SIGTERM)
            time.sleep(0.05)

    def _settings(self, access: Access, limit: int) -> dict[str, Any]:
        return {
            "server_name": "holdfast",
            "host": access.host,
            "port": access.port,
            # A confirmed write is on the disk, as there is no other server that has it.
            "jetstream": {
                "store_dir": str(self.store),
                "sync_interval": "always",
                "max_file_store": limit,
            },
            "authorization": self._authorization(access),
        }

    def _authorization(self, access: Access) -> dict[str, str]:
        if access.username is not None:
            secret = "" if access.password_file is None else _plain(access.password_file)
            return {"user": access.username, "password": secret}
        assert access.token_file is not None, "clients show something"
        if access.token_file.parent == self.path and not access.token_file.exists():
            replace(access.token_file, f"{secrets.token_hex(32)}\n".encode(), SECRET)
        return {"token": _plain(access.token_file)}


def _plain(file: Path) -> str:
    """The password or token in a file. Raises `OSError` for one that would let nobody in."""
    secret = read_secret(file)
    if _HASH.match(secret):
        problem = "its secret begins like a bcrypt hash, and nats-server takes it for one"
        raise OSError(errno.EINVAL, problem, str(file))
    return secret


def _unusable(file: Path | str, error: OSError) -> ServerUnusable:
    kind = TemporarilyUnusable if error.errno in {errno.ENOSPC, errno.EDQUOT} else ServerUnusable
    return kind(f"{file} can't be used: {error.strerror or error}")


def _opened(file: Path) -> int:
    return os.open(file, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o600)


def _process_of(descriptor: int) -> int | None:
    """The process that has locked the file, as it has noted itself."""
    if sys.platform == "win32":
        return None
    text = os.pread(descriptor, 20, 0)
    return int(text) if text.strip().isdigit() else None
