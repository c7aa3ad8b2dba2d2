"""Requests to a running appliance from its own machine: reload, list sessions, end one.

A local socket (on Windows a named pipe) that only the user of the appliance, and root, can open.
Its name follows from the path of the configuration. Requests and answers are JSON objects.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.runtime.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from multiprocessing.connection import Listener

    Handler = Callable[..., Mapping[str, Any]]

MAX_REQUEST_BYTES = 64 * 1024
MAX_ANSWER_BYTES = 64 * 1024 * 1024
"""The size limits of messages."""

TIMEOUT_S = 5.0
IN_TURN_TIMEOUT_S = 0.5
"""Seconds in which a request must arrive: usually, and while callers, and a stop, wait for it."""

ANSWER_S = 3.0
"""Seconds in which an appliance must answer, unless the request takes longer."""

RELOAD_TIMEOUT_S = 60.0
"""Seconds in which a reload must be complete."""

FIRST_PAUSE_S = 0.05
MAX_PAUSE_S = 1.0
"""Pauses while no connection can be accepted, for example without free file descriptors: Linux
returns that error at once."""

MODE = 0o700

RUN = Path("/run")
"""Only root makes folders in it; those in `user` are then the user's that they are named after."""


class NotRunning(Exception):
    """No appliance with that configuration can be reached from here."""


class Control:
    """Answers requests until `close`. Raises `OSError` if the socket can't be created."""

    def __init__(self, file: Path, handlers: Mapping[str, Handler]) -> None:
        self._handlers: Mapping[str, Handler] = {
            "ping": lambda: {"path": _path(file).hex()},
            **handlers,
        }
        self._closed = threading.Event()
        address, *others = _own_addresses(file)
        self._listeners = {address: _listen(address)}
        for address in others:
            # Without it, only callers who name the file as it was named here are answered.
            with contextlib.suppress(OSError):
                self._listeners[address] = _listen(address)
        self._threads = [
            threading.Thread(
                target=self._accept, args=(listener,), name="holdfast-control", daemon=True
            )
            for listener in self._listeners.values()
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Frees the sockets."""
        self._closed.set()
        for address in self._listeners:
            _is_alive(address)  # Connecting wakes the thread, as callers do that still wait for it.
        for thread in self._threads:
            thread.join(TIMEOUT_S)
        for listener in self._listeners.values():
            listener.close()

    def _accept(self, listener: Listener) -> None:
        backoff = Backoff(FIRST_PAUSE_S, MAX_PAUSE_S, jitter=False)
        while not self._closed.is_set():
            try:
                connection = listener.accept()
            except (OSError, EOFError, ImportError):  # An import, too, takes descriptors.
                self._closed.wait(backoff.failed())
                continue
            backoff.succeeded()
            serving = threading.Thread(
                target=self._serve,
                args=(connection, TIMEOUT_S),
                name="holdfast-control",
                daemon=True,
            )
            try:
                serving.start()
            except RuntimeError:  # No new thread can start. Meanwhile, callers wait for each other.
                self._serve(connection, IN_TURN_TIMEOUT_S)

    # A connection is of another type on Windows.
    def _serve(self, connection: Any, timeout: float) -> None:
        with contextlib.suppress(OSError, EOFError), connection:
            if not connection.poll(timeout):
                return
            answer = self._answer(connection.recv_bytes(MAX_REQUEST_BYTES))
            connection.send_bytes(json.dumps(answer).encode())

    def _answer(self, body: bytes) -> Mapping[str, Any]:
        try:
            request = json.loads(body)
            handler = self._handlers[request.pop("do")]
            return handler(**request)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            return {"error": f"invalid request: {error}"}


def is_running(file: Path) -> bool:
    """Whether a process that this user has started with this path still runs, or may do so: one
    that hangs does not answer, and goes on later.

    Another path to the same file does not count: with relative paths in it, its appliance is
    another one. Nor does a stream, such as /dev/stdin, which has another content for each process.
    """
    if file.absolute().is_relative_to("/dev") or file.absolute().is_relative_to("/proc"):
        return False
    try:
        return ask(file, "ping").get("path") == _path(file).hex()
    except NotRunning:
        return any(map(_is_alive, _addresses(file)))


def ask(
    file: Path,
    do: str,
    *,
    within_s: float = ANSWER_S,
    ping_s: float = ANSWER_S,
    **fields: object,
) -> dict[str, Any]:
    """Sends a request to the appliance that runs this configuration. Raises `NotRunning`.

    If the answer may take longer than `ping_s`, a ping is sent first: an appliance that hangs
    does not answer it.
    """
    if within_s > ping_s:
        ask(file, "ping", within_s=ping_s, ping_s=ping_s)
    request = json.dumps({"do": do, **fields}).encode()
    found: list[dict[str, Any] | NotRunning] = []
    # An appliance that hangs does not accept, and no timeout covers that on every system.
    asking = threading.Thread(target=lambda: found.append(_answered(file, request)), daemon=True)
    asking.start()
    asking.join(within_s)
    if not found:
        raise NotRunning(f"{file}: the appliance has not answered within {within_s:g} s")
    if isinstance(found[0], NotRunning):
        raise found[0]
    return found[0]


def _answered(file: Path, request: bytes) -> dict[str, Any] | NotRunning:
    own, others = _addresses(file), _addresses_of_others(file)
    connection = next(filter(None, map(_connected, own)), None)
    if connection is None:
        alive = {Path(each).parent: found for each in others if (found := _connected(each))}
        if len(alive) > 1:  # Every user can say so. Who is right is not known.
            folders = ", ".join(map(str, alive))
            return NotRunning(f"{file}: several users say that they run it, in {folders}")
        connection = next(iter(alive.values()), None)
    if connection is not None:
        with connection:
            try:
                connection.send_bytes(request)
                answer = json.loads(connection.recv_bytes(MAX_ANSWER_BYTES))
            except (OSError, EOFError):
                return NotRunning(f"{file}: the appliance ended the connection")
            except ValueError:
                answer = None
        return answer if isinstance(answer, dict) else NotRunning(f"{file}: not an appliance")
    tried = ", ".join((*own, *others))
    # An appliance can run a file that is gone, so this is looked at last.
    none = f"{_obstacle(file)}no appliance of this user runs it on this machine"
    return NotRunning(f"{file}: {none} (tried {tried})")


def _obstacle(file: Path) -> str:
    """Why the file is probably not the one that was meant, or this user not the right one."""
    try:
        file.stat()
    except PermissionError:
        pass
    except (OSError, ValueError):
        return "no such file, and "
    else:
        if os.access(file, os.R_OK):
            return ""
    return "this user may not read it (try sudo), and "


class _UnixListener:
    """The `Listener` of Unix. `multiprocessing` is imported for the first caller: most appliances
    have none, and it takes a megabyte."""

    _address: str
    _socket: socket.socket

    def __init__(self, address: str) -> None:
        if sys.platform == "win32":
            raise AssertionError("only used on other systems")
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.bind(address)
            Path(address).chmod(0o600)
            self._socket.listen(1)
        except OSError:
            self._socket.close()
            raise

    def accept(self) -> Any:
        return _connection(self._socket.accept()[0])

    def close(self) -> None:
        self._socket.close()
        Path(self._address).unlink(missing_ok=True)


def _connection(connected: socket.socket) -> Any:
    """The connection of a socket, which is closed if there can be none."""
    with connected:
        from multiprocessing.connection import Connection

        return Connection(connected.detach())


def _listen(address: str) -> Listener | _UnixListener:
    if sys.platform == "win32":
        from multiprocessing.connection import Listener

        return Listener(address)
    try:
        return _UnixListener(address)
    except OSError:
        if _is_alive(address):
            raise
        # An appliance that was killed has left it.
        Path(address).unlink(missing_ok=True)
        return _UnixListener(address)


def _is_alive(address: str) -> bool:
    """Connects, without waiting. Returns whether somebody listens there."""
    if sys.platform == "win32":
        from multiprocessing.connection import Client

        with contextlib.suppress(OSError, EOFError), Client(address):
            return True
        return False
    try:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.setblocking(False)
            connection.connect(address)
    except BlockingIOError:
        return True  # As many callers as may wait do: one more would wait until one is accepted.
    except OSError:
        return False
    return True


def _connected(address: str) -> Any:  # A connection, of another type on Windows; or None.
    if sys.platform == "win32":
        from multiprocessing.connection import Client

        try:
            return Client(address)
        except OSError:
            return None
    connected = socket.socket(socket.AF_UNIX)
    try:
        connected.connect(address)
    except OSError:
        connected.close()
        return None
    return _connection(connected)


def _own_addresses(file: Path) -> list[str]:
    """The addresses to listen at: in the first folder that this user can write to."""
    if sys.platform == "win32":
        return _names(file)
    problem: OSError | None = None
    for folder in _folders():
        try:
            folder.mkdir(mode=MODE, exist_ok=True)
            if folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK):
                return [str(folder / name) for name in _names(file)]
        except OSError as error:
            problem = error
    raise problem or PermissionError("no folder for the control socket")


def _addresses(file: Path) -> list[str]:
    """The addresses where the appliance of a configuration can be."""
    if sys.platform == "win32":
        return _names(file)
    folders = (folder for folder in _folders() if not _is_forged(folder))
    return [str(folder / name) for folder in folders for name in _names(file)]


def _addresses_of_others(file: Path) -> list[str]:
    """The addresses where that of another user or unit can be, for root."""
    if sys.platform == "win32" or _user() != 0:
        return []
    own = list(_folders())
    folders = (folder for folder in _folders_of_others() if folder not in own)
    return [str(folder / name) for folder in folders for name in _names(file)]


def _is_forged(folder: Path) -> bool:
    """Whether somebody else has made the folder that this user has for temporary files."""
    if folder != _temporary():
        return False
    with contextlib.suppress(OSError):
        return folder.lstat().st_uid != _user()
    return False


def _temporary() -> Path:
    # Not `tempfile.gettempdir`, which passes over a folder on a full disk: a socket can be there.
    return Path(os.environ.get("TMPDIR") or "/tmp", f"holdfast-{_user()}")


def _user() -> int:
    if sys.platform == "win32":
        raise AssertionError("only called on other systems")
    return os.getuid()


def _folders() -> Iterator[Path]:
    given = os.environ.get("RUNTIME_DIRECTORY")
    if given:
        yield Path(given.split(":")[0])
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        yield Path(runtime) / "holdfast"
    yield RUN / "holdfast"
    yield _temporary()


def _folders_of_others() -> Iterator[Path]:
    """The folders of other units and users, for root, who may open their sockets."""
    yield from sorted(RUN.glob("holdfast-*"))
    named = [(folder, folder.parent.name) for folder in RUN.glob("user/*/holdfast")]
    for folder in _temporary().parent.glob("holdfast-*"):
        named.append((folder, folder.name.removeprefix("holdfast-")))
    for folder, user in sorted(named):
        # Anybody can make folders for temporary files, with the number of somebody else.
        with contextlib.suppress(OSError):
            if str(folder.lstat().st_uid) == user:
                yield folder


def _path(file: Path) -> bytes:
    # In bytes: as text, it depends on the locale of a process.
    return os.fsencode(os.path.normpath(file.absolute()))


def _names(file: Path) -> list[str]:
    """The names for a path as it is given, and for the file that its symbolic links lead to.

    The first one stays the same when a link is replaced, the second one finds an appliance that was
    started with another path to the same file.
    """
    paths = dict.fromkeys((_path(file), os.fsencode(file.resolve())))
    digests = [hashlib.sha256(path).hexdigest()[:16] for path in paths]
    if sys.platform == "win32":
        return [rf"\\.\pipe\holdfast-{digest}" for digest in digests]
    return [f"{digest}.sock" for digest in digests]
