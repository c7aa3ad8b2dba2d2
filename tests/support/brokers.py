"""Mosquitto and nats-server, as processes, for tests.

They listen only on the loopback interface, on free ports.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from abc import ABC, abstractmethod
from http.client import HTTPConnection
from pathlib import Path

from support import wire
from support.machine import missing, tool


def free_port(host: str = "127.0.0.1") -> int:
    """Returns a port that is currently free."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as taken:
        taken.bind((host, 0))
        return int(taken.getsockname()[1])


class Broker(ABC):
    """A broker of one test. It can restart with the same port and store."""

    name: str

    def __init__(self, folder: Path, host: str = "127.0.0.1") -> None:
        self.host = host
        self.port = 0
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        for _ in range(10):
            self.port = free_port(host)
            if self._starts():
                return
        raise AssertionError(f"{self.name} does not start: {self.log}")

    @abstractmethod
    def command(self) -> list[str]:
        """The program and its arguments."""

    @property
    def log(self) -> str:
        return self._log_file.read_text(errors="replace")

    @property
    def _log_file(self) -> Path:
        return self._folder / f"{self.name}.log"

    def start(self) -> None:
        """Starts the server and waits until it is ready."""
        assert self._starts(), self.log

    def _starts(self) -> bool:
        """Returns whether it runs and listens; the port may be taken."""
        with self._log_file.open("ab") as log:
            process = subprocess.Popen(self.command(), stdout=log, stderr=log)
        self._process = process
        wire.until(lambda: process.poll() is not None or self._listens(), f"{self.name} starts")
        if process.poll() is None:
            return True
        self._process = None
        return False

    def _listens(self) -> bool:
        try:
            socket.create_connection((self.host, self.port), 1).close()
        except OSError:
            return False
        return True

    def freeze(self) -> None:
        """Suspends the process; its connections stay open."""
        self._signal(signal.SIGSTOP)
        assert self._process is not None
        # Its threads run on until the system has stopped them all.
        os.waitid(os.P_PID, self._process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)

    def thaw(self) -> None:
        """Resumes the process."""
        self._signal(signal.SIGCONT)

    def reload(self) -> None:
        """Has it read its configuration again, with the access list."""
        self._signal(signal.SIGHUP)

    def _signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def kill(self) -> None:
        """Kills the broker without a clean shutdown."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()


class Mosquitto(Broker):
    """Mosquitto with these configuration lines; default: allows anonymous clients."""

    name = "mosquitto"

    def __init__(self, folder: Path, *options: str, host: str = "127.0.0.1") -> None:
        self._options = options or ("allow_anonymous true",)
        super().__init__(folder, host)

    @property
    def url(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"mqtt://{host}:{self.port}"

    def command(self) -> list[str]:
        file = self._folder / "mosquitto.conf"
        lines = [f"listener {self.port} {self.host}", "user root", *self._options]
        file.write_text("\n".join(lines) + "\n")
        return [tool("mosquitto"), "-v", "-c", str(file)]

    def publish(self, topic: str, message: str, *options: str) -> None:
        """Publishes with Mosquitto's own tool."""
        command = [tool("mosquitto_pub"), "-h", self.host, "-p", str(self.port), "-t", topic]
        subprocess.run([*command, "-m", message, *options], check=True, timeout=wire.DEADLINE)


class NatsServer(Broker):
    """nats-server with these options; by default with JetStream."""

    name = "nats"

    def __init__(self, folder: Path, *options: str, jetstream: bool = True) -> None:
        self._program = Path(sys.executable).parent / "nats-server"
        if not self._program.exists():
            missing("the program nats-server")
        self.options = (*options, *(("-js", "-sd", str(folder / "store")) if jetstream else ()))
        super().__init__(folder)

    @property
    def url(self) -> str:
        return f"nats://{self.host}:{self.port}"

    def restarted(self, *options: str) -> tuple[str, ...]:
        """Starts it again with other options; without any, JetStream is off. Returns the former."""
        self.kill()
        former, self.options = self.options, options
        self.start()
        return former

    def lose_store(self) -> None:
        """Removes everything that JetStream stored. The server must not run."""
        shutil.rmtree(self._folder / "store")

    @property
    def monitoring(self) -> str:
        """Where a server with the option `-m` answers HTTP."""
        address: str = re.findall(r"Starting http monitor on (\S+)", self.log)[-1]
        return f"http://{address}"

    def clients(self) -> list[str]:
        """The names of the connected clients, of a server with the option `-m`."""
        host, _, port = self.monitoring.removeprefix("http://").rpartition(":")
        # Without a resolver, which a test may have replaced.
        with socket.socket() as made, contextlib.closing(HTTPConnection(host)) as http:
            made.settimeout(wire.DEADLINE)
            made.connect((host, int(port)))
            http.sock = made
            http.request("GET", "/connz")
            return [each.get("name", "") for each in json.load(http.getresponse())["connections"]]

    def command(self) -> list[str]:
        self._before = self.log.count(READY)
        return [str(self._program), "-a", self.host, "-p", str(self.port), *self.options]

    def _listens(self) -> bool:
        return self.log.count(READY) > self._before


READY = "Server is ready"
"""The log line of nats-server when it is ready."""
