"""Slow connections by the thousands beside authenticated sessions, which notice nothing.

`HOLDFAST_TORTURE=1` opens 10,000 of them.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.certificates import Certificates, named
from support.cli import ServingCommand
from support.config_folder import written
from support.machine import missing
from support.tls_peer import READ, ZERO, Peer, context

if TYPE_CHECKING:
    import ssl
    from collections.abc import Iterator
    from pathlib import Path

COUNT = 10_000 if os.environ.get("HOLDFAST_TORTURE") else 1_000
SESSIONS = 20
CLIENT = "extendedKeyUsage=clientAuth"


class Plant:
    """A running appliance with a TLS listener, in a process of its own."""

    def __init__(self, folder: Path, authority: Certificates, **listener: Any) -> None:
        server = authority.issue("server", "DNS:localhost,IP:127.0.0.1")
        secure = {
            "type": "modbus-tls",
            "bind": "127.0.0.1:0",
            "tls": {
                "cert_file": str(server.certificate),
                "key_file": str(server.key),
                "ca_file": str(authority.ca),
            },
            "rules": [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}],
            # All peers have one address, which may take all places.
            "max_connections_per_source": None,
            **listener,
        }
        file = folder / "plant.yaml"
        memories = {"plant": {"holding_registers": 10}}
        metrics = {"bind": "127.0.0.1:0"}
        log = {"level": "error"}
        listeners = {"secure": secure}
        text = {"memories": memories, "listeners": listeners, "metrics": metrics, "log": log}
        file.write_text(written(text))
        self.command = ServingCommand("run", str(file))
        greeting = self.command.wait_for_greeting()
        found = re.findall(r"(secure|metrics) .*?([0-9.]+):([0-9]+)", greeting)
        self.addresses = {name: (host, int(port)) for name, host, port in found}

    def __enter__(self) -> Plant:
        return self

    def __exit__(self, *_: object) -> None:
        self.command.process.kill()
        self.command.process.communicate()

    def counted(self, metric: str, **labels: str) -> float:
        """A metric of the listener; 0 if there is none."""
        host, port = self.addresses["metrics"]
        with urllib.request.urlopen(f"http://{host}:{port}/metrics") as reply:
            text = reply.read().decode()
        pairs = {"listener": "secure", **labels}
        for line in text.splitlines():
            name, _, value = line.rpartition(" ")
            if name.startswith(f"{metric}{{") and all(
                f'{key}="{label}"' in name for key, label in pairs.items()
            ):
                return float(value)
        return 0.0


class Sessions:
    """Authenticated sessions that ask all the time, in turns, in a thread of their own."""

    def __init__(self, address: tuple[str, int], trust: ssl.SSLContext) -> None:
        self._opened = contextlib.ExitStack()
        self.peers = [self._opened.enter_context(Peer(address, trust)) for _ in range(SESSIONS)]
        for peer in self.peers:
            assert peer.shake().ask(READ) == ZERO
        self.asked = SESSIONS
        self.failed: list[BaseException] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()

    def _ask(self) -> None:
        try:
            while not self._over.is_set():
                for peer in self.peers:
                    assert peer.ask(READ) == ZERO
                    self.asked += 1
        except BaseException as error:
            self.failed.append(error)

    def wait_for(self, more: int) -> None:
        """Waits until so many further requests are answered."""
        until = self.asked + more
        wire.until(lambda: self.asked >= until or bool(self.failed), "requests are answered")
        assert self.failed == []

    def finish(self) -> int:
        """Returns how many requests were answered: all of them."""
        self._over.set()
        self._thread.join()
        assert self.failed == []
        return self.asked

    def __enter__(self) -> Sessions:
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._opened.close()


@pytest.fixture
def enough_files() -> Iterator[None]:
    """Open files for all connections: as many here as in the process of the server."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < COUNT + 500:
        missing(f"a limit of {COUNT + 500} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("enough_files")
@pytest.mark.parametrize("held", [True, False], ids=["held", "displaced"])
def test_sessions_do_not_notice_thousands_of_slow_connections(tmp_path: Path, held: bool) -> None:
    """The listener holds all of them until their handshake is complete, or few that change."""
    authority = Certificates(tmp_path)
    extensions = (CLIENT, named("operator"))
    operator = authority.issue("operator", "DNS:operator", extensions=extensions)
    trust = context(authority.ca, operator)
    # None of them is closed because it is slow, or refused because there is no place for a session.
    # There is room for as many handshakes as connections, at least 256.
    most = COUNT + SESSIONS if held else SESSIONS + 1
    places = {"max_connections": most, "request_timeout": 3600}
    with contextlib.ExitStack() as opened:
        plant = opened.enter_context(Plant(tmp_path, authority, **places))
        address = plant.addresses["secure"]
        sessions = opened.enter_context(Sessions(address, trust))
        hello = opened.enter_context(Peer(address, trust)).hello()
        slow: list[wire.Connection] = []
        for number in range(COUNT):
            slow.append(opened.enter_context(wire.Connection(address)))
            # Every fourth is silent, the others send a byte now and then.
            with contextlib.suppress(ConnectionError):
                if number % 4:
                    slow[-1].send(hello[: number % 4])
                slow[number // 2].send(hello[number % 4 : number % 4 + 1])
            if number % 100 == 0:
                sessions.wait_for(SESSIONS)
        wire.until(
            lambda: plant.counted("holdfast_connections_accepted_total") > COUNT, "all have come"
        )
        sessions.wait_for(10 * SESSIONS)

        displaced = plant.counted("holdfast_connections_closed_total", reason="evicted_handshake")
        still_open = plant.counted("holdfast_connections_open")
        asked = sessions.finish()
        assert plant.counted("holdfast_requests_total", function="3") == asked
        assert plant.counted("holdfast_connections_closed_total", reason="evicted") == 0
        assert plant.counted("holdfast_connections_refused_total", reason="full") == 0
        assert all(peer.ask(READ) == ZERO for peer in sessions.peers), "the same sessions"
        if held:
            assert displaced == 0
            assert still_open > COUNT
        else:
            assert displaced >= COUNT - max(most, 256)
