"""Processes of `holdfast` that start fast: imports take most of the time of a start.

Each process of pytest has a server that has imported all commands, and forks for each start.
Signals, exit codes and terminals are those of any process.
"""

from __future__ import annotations

import atexit
import fcntl
import functools
import json
import os
import select
import shlex
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import termios
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from holdfast.appliance.services import supervision
from holdfast.cli import COMMANDS, CommandWithSubcommands, main

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

LONG_TIMEOUTS = {
    name: {"timeout": "60"}
    for name in ("read", "write", "watch", "describe", "describe map", "describe identify", "bench")
}
"""Seconds to wait for a device: on a loaded machine, the default of 1 may not be enough."""

NUMBER = struct.Struct("i")


class Command:
    """A running `holdfast`, with the methods of `subprocess.Popen` whose output is text in pipes.

    With `terminal`, that is its input and output, and controls it.
    """

    def __init__(
        self,
        *arguments: str,
        terminal: int | None = None,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        request = {
            "arguments": arguments,
            "environment": dict(environment),
            "folder": str(Path.cwd()),
            "has_terminal": terminal is not None,
        }
        self.returncode: int | None = None
        self.stdout: TextIO | None = None
        self.stderr: TextIO | None = None
        self._status, status = os.pipe()
        if terminal is None:
            ours, theirs = zip(os.pipe(), os.pipe(), strict=True)
            self.stdout, self.stderr = (os.fdopen(each, encoding="utf-8") for each in ours)
            files = [os.open(os.devnull, os.O_RDONLY), *theirs]
        else:
            files = [os.dup(terminal) for _ in range(3)]
        try:
            socket.send_fds(
                _fork_server(), [json.dumps(request).encode() + b"\n"], [*files, status]
            )
        finally:
            for each in (*files, status):
                os.close(each)
        self.pid = self._number()

    def _number(self) -> int:
        number: int
        (number,) = NUMBER.unpack(os.read(self._status, NUMBER.size))
        return number

    def poll(self) -> int | None:
        if self.returncode is None and select.select([self._status], [], [], 0)[0]:
            self.returncode = self._number()
            os.close(self._status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            select.select([self._status], [], [], timeout)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired("holdfast", timeout or 0)
        return code

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Reads the rest of the output, and waits for the end."""
        streams = [stream for stream in (self.stdout, self.stderr) if stream is not None]
        with ThreadPoolExecutor(2) as threads:
            reading = [threads.submit(stream.read) for stream in streams if not stream.closed]
            try:
                self.wait(timeout)
            except subprocess.TimeoutExpired:
                self.kill()
                raise
        for stream in streams:
            stream.close()
        output, log = [each.result() for each in reading] or ("", "")
        return output, log

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


SCRIPT = """\
#!/bin/sh
'''exec' {python} -IS "$0" "$@"
'''
import json, os, signal, socket, struct, sys

def forward(number, _):
    os.kill(pid, number)

server = socket.socket(socket.AF_UNIX)
server.connect({address!r})
request = {{
    "arguments": sys.argv[1:],
    "environment": dict(os.environ),
    "folder": os.getcwd(),
    "has_terminal": False,
}}
socket.send_fds(server, [json.dumps(request).encode() + b"\\n"], [0, 1, 2])
[pid] = struct.unpack("i", server.recv(4))
for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
    signal.signal(number, forward)
[code] = struct.unpack("i", server.recv(4))
sys.exit(code if code >= 0 else 128 - code)
"""


def write_script(file: Path) -> None:
    """Writes a program `holdfast` for shells, which starts as fast."""
    _fork_server()
    file.write_text(SCRIPT.format(python=shlex.quote(sys.executable), address=str(_address())))
    file.chmod(0o755)


@functools.cache
def _address() -> Path:
    """Where the server listens for scripts."""
    folder = tempfile.TemporaryDirectory(prefix="holdfast-")
    atexit.register(folder.cleanup)
    return Path(folder.name) / "server"


@functools.cache
def _fork_server() -> socket.socket:
    """The connection to the server."""
    ours, theirs = socket.socketpair()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(_address()))
    listener.listen()
    with theirs, listener:
        numbers = [theirs.fileno(), listener.fileno()]
        process = subprocess.Popen(
            [sys.executable, "-P", __file__, *map(str, numbers)],
            stdin=subprocess.DEVNULL,
            pass_fds=numbers,
        )

    def end() -> None:
        ours.close()
        process.wait()

    atexit.register(end)
    return ours


def _serve(requests: socket.socket, listener: socket.socket) -> None:
    """Forks for each request. Returns in the children, which run a command."""
    context = click.Context(main)
    for name in COMMANDS:
        command = main.get_command(context, name)
        if isinstance(command, CommandWithSubcommands):
            for subcommand in command.subcommands:
                command.subcommand(subcommand)
    # A loaded machine could leave threads of the lowest priority without any time for minutes.
    supervision.NICE = 0
    # Ctrl-C is for the tests.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while True:
        ready, _, _ = select.select([requests, listener], [], [])
        if requests in ready:
            request, files = _received(requests)
        else:
            script, _ = listener.accept()
            request, files = _received(script)
            files.append(script.detach())
        if os.fork() == 0:
            requests.close()
            listener.close()
            *standard, status = files
            _fork_and_wait(standard, status)
            _become(request, standard)
            return
        for each in files:
            os.close(each)


def _received(sender: socket.socket) -> tuple[dict[str, Any], list[int]]:
    """A request, and its files. Ends the process with the one that has started it."""
    data, files = b"", list[int]()
    while not data.endswith(b"\n"):
        piece, more, _, _ = socket.recv_fds(sender, 1 << 20, 4)
        if not piece:
            sys.exit()
        data, files = data + piece, files + more
    return json.loads(data), files


def _fork_and_wait(standard: Sequence[int], status: int) -> None:
    """Returns in a child, whose process id and exit code are written."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    child = os.fork()
    if child == 0:
        os.close(status)
        return
    for each in standard:
        os.close(each)
    os.write(status, NUMBER.pack(child))
    _, ended = os.waitpid(child, 0)
    os.write(status, NUMBER.pack(os.waitstatus_to_exitcode(ended)))
    os._exit(0)


def _become(request: dict[str, Any], standard: Sequence[int]) -> None:
    """Takes over files, environment and arguments, as a new interpreter does."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # The tests may run under `nohup` or in the background.
    for ignored in (signal.SIGHUP, signal.SIGQUIT):
        signal.signal(ignored, signal.SIG_DFL)
    if request["has_terminal"]:
        os.setsid()
        fcntl.ioctl(standard[0], termios.TIOCSCTTY, 0)
    for number, each in enumerate(standard):
        os.dup2(each, number)
        os.close(each)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    encoding = os.environ.get("PYTHONIOENCODING", "utf-8")
    sys.stdin = os.fdopen(0, encoding=encoding, closefd=False)
    sys.stdout = os.fdopen(1, "w", encoding=encoding, closefd=False)
    sys.stderr = os.fdopen(2, "w", 1, encoding, "backslashreplace", closefd=False)
    sys.argv = ["holdfast", *request["arguments"]]


if __name__ == "__main__":
    _serve(*(socket.socket(fileno=int(number)) for number in sys.argv[1:]))
    main(prog_name="python -m holdfast", default_map=LONG_TIMEOUTS)
