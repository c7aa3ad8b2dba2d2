"""`holdfast gateway` rereads the files of its options on SIGHUP, and ends with its terminal."""

from __future__ import annotations

import os
import pty
import re
import shutil
import signal
import ssl
import subprocess
import sys
from hashlib import sha256
from typing import TYPE_CHECKING

import pytest

from support import web, wire
from support.secured import Authority

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.certificates import Issued

OPTIONS = ("gateway", "--bind", "127.0.0.1:0", "--allow", "127.0.0.1:*")


class Running:
    """A running `holdfast gateway`, whose log can be read line by line."""

    def __init__(self, *options: str, stdin: int = subprocess.DEVNULL) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "holdfast", *OPTIONS, *options],
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        greeting = ""
        while "Ctrl-C" not in greeting:
            line = self.process.stdout.readline()
            assert line, self.process.communicate()
            greeting += line
        found = re.search(r"https?://([0-9.]+):([0-9]+)/", greeting)
        assert found
        self.address = found[1], int(found[2])

    def hang_up(self, event: str) -> str:
        """Sends SIGHUP. Returns the line of the log that has this event."""
        self.process.send_signal(signal.SIGHUP)
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if f" {event} " in line:
                return line
        raise AssertionError(self.process.communicate())

    def status(self, token: str) -> int:
        """The status of a request with that token, once it is answered."""
        head = web.head("GET", "/api/gateway", f"Authorization: Bearer {token}")
        found: list[int] = []

        def is_answered() -> bool:
            # A gateway with other tokens starts again: connections may be closed meanwhile.
            try:
                with wire.Connection(self.address) as client:
                    client.send(head)
                    reply = client.socket.recv(100)
            except OSError:
                return False
            found[:] = [int(reply.split()[1])] if reply else []
            return bool(found)

        wire.until(is_answered, "it answers")
        return found[0]

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    folder = tmp_path / "authority"
    folder.mkdir()
    return Authority(folder)


def line(name: str, token: str) -> str:
    return f"{name} {sha256(token.encode()).hexdigest()}\n"


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    file = tmp_path / "tokens"
    file.write_text(line("engineer", "one"))
    return file


@pytest.fixture
def running(tokens: Path) -> Iterator[Running]:
    made = Running("--tokens", str(tokens))
    yield made
    made.kill()


def test_tokens_are_read_anew(running: Running, tokens: Path) -> None:
    assert (running.status("one"), running.status("two")) == (200, 401)
    tokens.write_text(line("operator", "two"))
    assert "changed=gateway" in running.hang_up("reloaded")
    assert (running.status("one"), running.status("two")) == (401, 200)
    assert "changed=nothing" in running.hang_up("reloaded")


@pytest.mark.parametrize("content", ["", "engineer 12\n"])
def test_a_wrong_token_file_changes_nothing(running: Running, tokens: Path, content: str) -> None:
    tokens.write_text(content)
    assert str(tokens) in running.hang_up("reload_refused")
    assert (running.status("one"), running.status("two")) == (200, 401)


def test_a_token_file_that_is_gone_changes_nothing(running: Running, tokens: Path) -> None:
    tokens.unlink()
    assert "No such file" in running.hang_up("reload_refused")
    assert (running.status("one"), running.status("two")) == (200, 401)


def test_a_renewed_certificate_serves_the_next_connection(
    tmp_path: Path, authority: Authority
) -> None:
    own = tmp_path / "own.pem", tmp_path / "own.key"

    def install(issued: Issued) -> None:
        shutil.copy(issued.certificate, own[0])
        shutil.copy(issued.key, own[1])

    def served() -> str:
        context = ssl.create_default_context(cafile=str(authority.ca))
        with (
            wire.Connection(command.address) as client,
            context.wrap_socket(client.socket, server_hostname="127.0.0.1") as tls,
        ):
            found = tls.getpeercert()
            assert found is not None
            return str(found["serialNumber"])

    install(authority.issue("first", "IP:127.0.0.1"))
    command = Running("--https-cert", str(own[0]), "--https-key", str(own[1]))
    try:
        before = served()
        own[1].write_text("no key")
        assert "own.key" in command.hang_up("reload_refused")
        assert served() == before
        install(authority.issue("second", "IP:127.0.0.1"))
        assert "changed=gateway" in command.hang_up("reloaded")
        assert served() != before
    finally:
        command.kill()


def test_a_signal_reloads_in_a_terminal_and_a_closed_terminal_ends_it() -> None:
    terminal, theirs = pty.openpty()
    try:
        running = Running(stdin=theirs)
    finally:
        os.close(theirs)
    try:
        assert "changed=nothing" in running.hang_up("reloaded")
        os.close(terminal)
        running.process.send_signal(signal.SIGHUP)
        _, log = running.process.communicate(timeout=wire.DEADLINE)
        assert (running.process.returncode, log.splitlines()[-1].split()[2]) == (0, "stopped")
    finally:
        running.kill()
