"""Nodes of a fleet as processes, and what watches them from outside."""

from __future__ import annotations

import asyncio
import itertools
import json
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from nats.errors import Error

from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from holdfast.scanner.fleet.partition_leases import PARTITION, leases_of
from support import wire
from support.cli import invoke
from support.leases import make_settled
from support.scanner_process import freeze

if TYPE_CHECKING:
    from collections.abc import Sequence

    from nats.aio.msg import Msg

    from support.judges import Judge
    from support.nats_bus import Caller

FLEET = "plant"

REPEATED_S = 3.0
"""Time for the answer to a request, before it is sent again."""


def prepare(url: str, partitions: int, replicas: int = 1) -> None:
    """Leaves a server as a fleet does that has ended: its next nodes wait for no former one."""
    keys = (f"{PARTITION}{number}" for number in range(partitions))
    make_settled(url, leases_of(FLEET), keys, replicas)


class Nodes:
    """The nodes, as processes."""

    def __init__(self, urls: Sequence[str], folder: Path, partitions: int) -> None:
        self._urls = urls
        self._folder = folder
        self._partitions = partitions
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._numbers = itertools.count(1)

    def start(self, name: str | None = None) -> None:
        name = name or f"n{next(self._numbers)}"
        options = ["--fleet", FLEET, "--node", name, "--partitions", str(self._partitions)]
        command = [sys.executable, "-m", "holdfast", "scan", *_servers(self._urls), *options]
        with (self._folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def freeze(self, name: str) -> set[tuple[int, int]]:
        """Stops a process. Returns the ports of its connections: its own, and the other one."""
        freeze(self.running[name])
        return ports_of(self.running[name].pid)

    def thaw(self, name: str) -> None:
        self.running[name].send_signal(signal.SIGCONT)

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        process.wait()

    def drain(self, name: str) -> None:
        result = invoke("fleet", "drain", FLEET, name, *_servers(self._urls))
        assert result.exit_code == 0, result.output
        assert self.running.pop(name).wait(wire.DEADLINE) == 0

    def shown(self) -> list[str]:
        """The nodes that have partitions, as `holdfast fleet status` shows them."""
        result = invoke("fleet", "status", FLEET, *_servers(self._urls), "--json")
        if result.exit_code:
            return []
        found = json.loads(result.stdout)["nodes"]
        return sorted(each["node"] for each in found if each["partitions"])

    def have_replaced(self, name: str) -> bool:
        shown = self.shown()
        return bool(shown) and name not in shown

    def settle(self) -> None:
        wire.until(lambda: self.shown() == sorted(self.running), "all nodes have partitions")

    def stop(self) -> None:
        for process in self.running.values():
            process.kill()
            process.wait()


def _servers(urls: Sequence[str]) -> list[str]:
    return [word for url in urls for word in ("--nats", url)]


def ports_of(pid: int) -> set[tuple[int, int]]:
    """The ports of both ends of the TCP connections of a process."""
    sockets = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            target = str(entry.readlink())
            if target.startswith("socket:["):
                sockets.add(target[8:-1])
    lines = Path(f"/proc/{pid}/net/tcp").read_text().splitlines()[1:]
    fields = (line.split() for line in lines)
    return {(_port(each[1]), _port(each[2])) for each in fields if each[9] in sockets}


def _port(address: str) -> int:
    return int(address.split(":")[1], 16)


def wanted(judge: Judge, number: int, **more: object) -> dict[str, object]:
    """A request for the tag of a device, once a second."""
    tag = {"id": f"t{number}", "address": 0, "functionCode": "holding", "datatype": "uint16"}
    return {
        "deviceId": f"d{number}",
        "host": "127.0.0.1",
        "port": judge.port,
        "scanRate": 1000,
        "timeout": 1000,
        "subscriberId": "hmi",
        "tags": [tag],
        **more,
    }


def subscribed(caller: Caller, number: int, judge: Judge, **more: object) -> None:
    """Subscribes to a device, as often as it takes: a fleet refuses it while it has no storage."""

    request = wanted(judge, number, **more)

    def is_subscribed() -> bool:
        # With a server that ends, a request or its answer may be lost.
        with suppress(Error, TimeoutError):
            return bool(caller.request("modbus.subscribe", request, REPEATED_S)["success"])
        return False

    wire.until(is_subscribed, f"d{number} is subscribed")


def known(caller: Caller) -> dict[str, list[str]]:
    """The subscribers of each device, as any node tells them."""
    found: dict[str, list[str]] = {}
    offset: int | None = 0
    while offset is not None:
        page = caller.request("modbus.browse", {"offset": offset})
        for device in page["devices"]:
            found[device["deviceId"]] = [each["id"] for each in device["subscribers"]]
        offset = page.get("next")
    return found


class Published:
    """Notes values of a node after those of one that has taken the device over from it."""

    def __init__(self, caller: Caller) -> None:
        self._latest: dict[str, tuple[int, int]] = {}
        """The number and the time of the newest value of each tag."""
        self.count = 0
        self.returns: list[tuple[str, int, int]] = []
        self.older: list[tuple[str, int]] = []
        """Values behind newer ones with the same number."""

        async def listen() -> None:
            await caller.client.subscribe("modbus.data.>", cb=self._take)
            await caller.client.flush()

        caller.do(listen())

    async def _take(self, message: Msg) -> None:
        self.count += 1
        assert message.headers is not None
        found = int(message.headers["Holdfast-Lease"]), int(json.loads(message.data)["timestamp"])
        latest = self._latest.setdefault(message.subject, found)
        if found[0] < latest[0]:
            self.returns.append((message.subject, found[0], latest[0]))
        elif found < latest:
            self.older.append((message.subject, latest[1] - found[1]))
        self._latest[message.subject] = max(found, latest)


class Commands:
    """Sends commands all the time, each with another value, and checks that answers are true."""

    def __init__(
        self, caller: Caller, judges: Sequence[Judge], rate: float, times: LeaseTimes = LEASE_TIMES
    ) -> None:
        """Sends `rate` commands a second to a fleet with these times."""
        self._timeout_s = 4 * times.ttl_s  # The fleet looks for a node for half of it.
        self._caller = caller
        self._judges = judges
        self._pause = 1 / rate
        self._answers: dict[tuple[int, int], str] = {}
        self._sent: set[asyncio.Task[None]] = set()
        self._is_ended = False
        self._running = asyncio.run_coroutine_threadsafe(self._run(), caller.loop)

    async def _run(self) -> None:
        for value in itertools.count(1):
            if self._is_ended:
                break
            number = value % len(self._judges)
            task = asyncio.create_task(self._send(number, value))
            self._sent.add(task)
            task.add_done_callback(self._sent.discard)
            await asyncio.sleep(self._pause)
        await asyncio.gather(*self._sent)

    async def _send(self, number: int, value: int) -> None:
        subject, text = f"modbus.command.d{number}.t{number}", str(value).encode()
        try:
            reply = await self._caller.client.request(subject, text, timeout=self._timeout_s)
            answer = json.loads(reply.data)
        except (Error, OSError) as error:
            answer = {"success": False, "error": f"not confirmed: {error!r}"}
        said = "done" if answer["success"] else answer["error"]
        self._answers[number, value] = said

    def stop(self) -> None:
        self._is_ended = True
        self._running.result(wire.DEADLINE)

    def check(self) -> dict[str, int]:
        """Returns how often there was which answer."""
        counts: dict[str, int] = {}
        assert self._answers
        for (number, value), said in self._answers.items():
            times = [each for _, each in self._judges[number].writes].count(value)
            kind = said.partition(":")[0]
            counts[kind] = counts.get(kind, 0) + 1
            if said == "done":
                assert times == 1, (number, value, times)
            elif kind == "not written":
                assert times == 0, (number, value, said)
            else:
                assert kind == "not confirmed", said
                assert times <= 1, (number, value, times)
        assert counts.get("done"), counts
        return counts


def are_polled(judges: Sequence[Judge], more_than: Sequence[int]) -> bool:
    """Whether each device has had more polls than that."""
    return all(len(judge.polls) > count for judge, count in zip(judges, more_than, strict=True))
