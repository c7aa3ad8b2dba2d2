"""Scanner processes that are stopped, killed, drained and started at random, judged by the devices.

In short by default; with HOLDFAST_TORTURE=1 for long, and with the times that the documentation
promises.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.cli import invoke
from support.judges import Judges
from support.nats_bus import Caller

if TYPE_CHECKING:
    from collections.abc import Iterator

    from nats.aio.msg import Msg

    from support.brokers import NatsServer
    from support.judges import Judge

IS_LONG = os.environ.get("HOLDFAST_TORTURE") == "1"
DEVICES = 60 if IS_LONG else 12
ROUNDS = 40 if IS_LONG else 4
GAP = 5.0
"""Seconds without a scan that are promised, for devices that are scanned every second."""

FROZEN = 5.0
PARTITIONS = 64


class Scanners:
    """The nodes, as processes."""

    def __init__(self, server: NatsServer, folder: Path) -> None:
        self._server = server
        self._folder = folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._count = 0

    def start(self) -> str:
        self._count += 1
        name = f"n{self._count}"
        options = ["--fleet", "plant", "--node", name, "--partitions", str(PARTITIONS)]
        command = [sys.executable, "-m", "holdfast", "scan", "--nats", self._server.url, *options]
        with (self._folder / f"{name}.log").open("wb") as log:
            self.running[name] = subprocess.Popen(command, stdout=log, stderr=log)
        return name

    def freeze(self, name: str) -> set[int]:
        """Stops a process. Returns the ports of its connections."""
        process = self.running[name]
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        return ports_of(process.pid)

    def thaw(self, name: str) -> None:
        self.running[name].send_signal(signal.SIGCONT)

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        process.wait()

    def drain(self, name: str) -> None:
        result = invoke("fleet", "drain", "plant", name, "--nats", self._server.url)
        assert result.exit_code == 0, result.output
        assert self.running.pop(name).wait(wire.DEADLINE) == 0

    def nodes(self) -> list[str]:
        result = invoke("fleet", "status", "plant", "--nats", self._server.url, "--json")
        if result.exit_code:
            return []
        found = json.loads(result.stdout)["nodes"]
        return sorted(each["node"] for each in found if each["partitions"])

    def have_replaced(self, name: str) -> bool:
        return name not in self.nodes()

    def settle(self) -> None:
        wire.until(lambda: self.nodes() == sorted(self.running), "all nodes have partitions")

    def stop(self) -> None:
        for process in self.running.values():
            process.kill()
            process.wait()


def ports_of(pid: int) -> set[int]:
    """The local ports of the TCP sockets of a process."""
    sockets = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        target = str(entry.readlink())
        if target.startswith("socket:["):
            sockets.add(target[8:-1])
    lines = Path(f"/proc/{pid}/net/tcp").read_text().splitlines()[1:]
    fields = (line.split() for line in lines)
    return {int(each[1].split(":")[1], 16) for each in fields if each[9] in sockets}


def are_polled(judges: Judges, more_than: list[int]) -> bool:
    pairs = zip(judges.devices, more_than, strict=True)
    return all(len(judge.polls) > count for judge, count in pairs)


def wanted(judge: Judge, number: int) -> dict[str, object]:
    tag = {"id": f"t{number}", "address": 0, "functionCode": "holding", "datatype": "uint16"}
    return {
        "deviceId": f"d{number}",
        "host": "127.0.0.1",
        "port": judge.port,
        "scanRate": 1000,
        "timeout": 1000,
        "subscriberId": "hmi",
        "tags": [tag],
    }


@pytest.fixture
def scanners(own_nats: NatsServer, tmp_path: Path) -> Iterator[Scanners]:
    scanners = Scanners(own_nats, tmp_path)
    yield scanners
    scanners.stop()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_devices_are_scanned_by_one_node_at_a_time_whatever_happens_to_nodes(
    own_nats: NatsServer, scanners: Scanners
) -> None:
    chance = random.Random(int(os.environ.get("HOLDFAST_SEED", "18")))
    with Judges(DEVICES) as judges, Caller(own_nats.url) as caller, ExitStack() as ending:
        for _ in range(3):
            scanners.start()
        scanners.settle()
        for number, judge in enumerate(judges.devices):
            reply = caller.request("modbus.subscribe", wanted(judge, number))
            assert reply["success"], reply
        published = Published(caller)
        commands = Commands(caller, judges)
        ending.callback(commands.stop)
        kinds = ["freeze", "kill", "drain", "start"] * (ROUNDS // 4)
        chance.shuffle(kinds)
        for kind in kinds:
            began = time.monotonic()
            names = sorted(scanners.running)
            if kind == "start" or len(names) < 2:
                scanners.start()
            elif kind == "drain":
                scanners.drain(chance.choice(names))
            elif kind == "kill":
                scanners.kill(chance.choice(names))
                scanners.start()
            else:
                name = chance.choice(names)
                ports = scanners.freeze(name)
                # All that it has sent has been received when the others have taken over.
                wire.until(partial(scanners.have_replaced, name), "taken over")
                threading.Event().wait(max(began + FROZEN - time.monotonic(), 0))
                before = [len(judge.polls) for judge in judges.devices]
                scanners.thaw(name)
                scanners.settle()
                for judge, count in zip(judges.devices, before, strict=True):
                    late = [number for _, number in judge.polls[count:]]
                    assert not [each for each in late if judge.peers[each] in ports]
            scanners.settle()
            counts = [len(judge.polls) + 1 for judge in judges.devices]
            wire.until(partial(are_polled, judges, counts), "all devices are scanned")
            if IS_LONG:
                assert max(judge.longest_gap(began) for judge in judges.devices) <= GAP, kind
        commands.stop()
        for judge in judges.devices:
            assert not judge.overlaps
            assert not judge.returns()
        assert caller.request("modbus.browse", "")["count"] == DEVICES
        commands.check()
        assert published.count
        assert not published.returns


class Published:
    """Notes values of a node after those of one that has taken the device over from it."""

    def __init__(self, caller: Caller) -> None:
        self._leases: dict[str, int] = {}
        self.count = 0
        self.returns: list[tuple[str, int, int]] = []

        async def listen() -> None:
            await caller.client.subscribe("modbus.data.>", cb=self._take)
            await caller.client.flush()

        caller.do(listen())

    async def _take(self, message: Msg) -> None:
        self.count += 1
        assert message.headers is not None
        lease, latest = int(message.headers["Holdfast-Lease"]), self._leases.get(message.subject, 0)
        if lease < latest:
            self.returns.append((message.subject, lease, latest))
        self._leases[message.subject] = max(lease, latest)


class Commands:
    """Sends commands all the time, and checks that answers are true."""

    def __init__(self, caller: Caller, judges: Judges) -> None:
        self._caller = caller
        self._judges = judges
        self._ended = threading.Event()
        self._answers: dict[tuple[int, int], str] = {}
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        value = 0
        while not self._ended.wait(0.2):
            value += 1
            number = value % len(self._judges.devices)
            try:
                reply = self._caller.request(f"modbus.command.d{number}.t{number}", str(value))
            except Exception as error:
                reply = {"success": False, "error": f"not confirmed: {error!r}"}
            said = "done" if reply["success"] else reply["error"]
            self._answers[number, value] = said

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def check(self) -> None:
        assert self._answers
        for (number, value), said in self._answers.items():
            times = [each for _, each in self._judges.devices[number].writes].count(value)
            if said == "done":
                assert times == 1, (number, value)
            elif said.startswith("not written"):
                assert times == 0, (number, value)
            else:
                assert said.startswith("not confirmed"), said
                assert times <= 1, (number, value)
