"""The part of a scanner that makes it a node of a fleet.

All nodes know all subscriptions, so any of them answers any request. A device is polled by the node
that has the lease of its partition.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import msgspec
from nats.errors import Error, NoRespondersError
from nats.errors import TimeoutError as NoAnswer
from nats.js.errors import NoStreamResponseError

from holdfast import logs, tasks
from holdfast.client.url import connection_of
from holdfast.heartbeat import Heartbeat
from holdfast.leases import Outdated
from holdfast.scanner.errors import Refused
from holdfast.scanner.fleet.desired_state import Want, Wants
from holdfast.scanner.fleet.exchange import About, Command, Executed, Told, subject
from holdfast.scanner.fleet.fleet import Fleet

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast import _core
    from holdfast.leases import Connect, Holding, StartThread
    from holdfast.scanner.fleet.agreement import FleetSettings, Terms
    from holdfast.scanner.subscriptions.device import ScannedDevice

Reply = TypeVar("Reply", bound=msgspec.Struct)

OPENED = 0.5
"""Seconds between attempts to open the buckets."""

RETRIED = 10.0
"""Seconds between attempts to carry out a subscription of another node that is refused here."""

CHANGES = 20
"""Attempts to store a device that other nodes change at the same time."""

ASKED = 2.0
"""Seconds to wait for the answer of another node."""

AGAIN = 0.1
"""Seconds between attempts to find the node that polls a device."""

HANGING = 5.0
"""Seconds without a sign of life of the event loop after which leases are not renewed."""


class Host(Protocol):
    """What the scanner does for its fleet."""

    async def adopt(self, device: str, want: Want | None, renewed: set[str]) -> None:
        """Makes the subscriptions of a device those of the bucket. Raises `Refused`."""

    def want(self, device: str) -> list[bytes]:
        """The requests that make the subscriptions of a device."""

    def timed(self, device: str) -> Iterable[str]:
        """The subscribers of a device with a `ttl`."""

    def turn(self, device: str) -> asyncio.Lock:
        """The lock that serializes changes of a device."""

    def begin(self, device: ScannedDevice) -> None:
        """Polls a device from now on."""

    def end(self, device: ScannedDevice) -> None:
        """Polls a device no more."""


class FleetPart:
    """Joins the fleet, follows what is wanted, and knows who polls which device."""

    def __init__(
        self,
        settings: FleetSettings,
        terms: Terms,
        prefix: str,
        host: Host,
        about: Callable[[], dict[str, Any]],
        connect: Connect,
        start_thread: StartThread,
    ) -> None:
        """`connect` makes a connection for the leases alone, `start_thread` starts their thread."""
        self.fleet = Fleet(
            settings,
            terms,
            about,
            self._gained,
            self._lost,
            connect=connect,
            withheld=self._withheld,
            start_thread=start_thread,
        )
        self._heartbeat = Heartbeat()
        self.wants = Wants(settings.name, self._changed, self._replaced)
        self._moving_s = 2 * settings.lease_times.ttl_s
        """How long a command waits for a node that polls its device: twice a takeover."""
        self._check_interval_s = settings.check_interval_s
        self._prefix = prefix
        self._host = host
        self._client: Client | None = None
        self._is_new = asyncio.Event()
        self._news = asyncio.Event()
        self._touched: set[str] = set()
        self._failed: set[str] = set()
        self._renewed: dict[tuple[str, str], int] = {}
        self._applied: dict[str, int] = {}
        """The revision of each device that is carried out here. Only that one may be replaced: one
        that is newer has what others have changed."""
        self._devices: dict[int, dict[str, ScannedDevice]] = {}
        self.is_joined = False

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._client = client
        self._is_new.set()
        if client is not None:
            self.fleet.connected()

    def _withheld(self) -> str | None:
        """Why this node can't publish values; then others should have its devices."""
        if self._client is None:
            return "the other connection to NATS was lost"
        if self._heartbeat.age > HANGING:
            return f"the event loop hangs for {HANGING:g} s"
        return None

    async def run(self, ready: asyncio.Event) -> None:
        """Is a node of the fleet until it is cancelled. Raises `FleetRefused`.

        Sets `ready` when it knows what is wanted.
        """
        running: list[asyncio.Task[None]] = []
        self.fleet.start()
        try:
            async with self._heartbeat.kept():
                await self._open(ready)
                works = (self.fleet.run(), self._open_again(), self._follow())
                running += [asyncio.create_task(work) for work in works]
                done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
        finally:
            await tasks.end(running)
            await self.fleet.stop()

    async def _open(self, ready: asyncio.Event) -> None:
        """Joins the fleet, and reads what is wanted."""
        while not self.is_joined:
            client, leases = self._client, self.fleet.leases
            if client is None or leases.reason is not None or not leases.is_read:
                await asyncio.sleep(AGAIN)
                continue
            try:
                fleet = self.fleet
                await self.wants.open(client, fleet.terms, fleet.has_terms, has_joined=False)
                self._is_new.clear()
                await fleet.join()
                await self.wants.agree(fleet.terms, fleet.has_terms, may_replace=True)
                await self._read(ready)
                self.is_joined = True
            except (Error, OSError) as error:
                logs.refused("fleet_unavailable", kind="fleet", reason=str(error) or repr(error))
                await asyncio.sleep(OPENED)

    async def _read(self, ready: asyncio.Event) -> None:
        await self.wants.is_read.wait()
        for device in self.wants.devices:
            await self._adopt(device)
        ready.set()

    async def _open_again(self) -> None:
        """Follows the bucket anew after each reconnect, and whenever nothing comes from it.

        The server may have forgotten who follows it, or have lost the bucket.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._check_interval_s):
                    await self._is_new.wait()
            client = self._client
            if client is None:
                await asyncio.sleep(AGAIN)
                continue
            if not self._is_new.is_set():
                with contextlib.suppress(Error, OSError):
                    if await self.wants.is_followed():
                        continue
            self._is_new.clear()
            try:
                await self.wants.open(client, self.fleet.terms, lambda _: True, has_joined=True)
            except (Error, OSError) as error:
                logs.refused("fleet_unavailable", kind="fleet", reason=str(error) or repr(error))
                await asyncio.sleep(OPENED)
                self._is_new.set()

    async def _follow(self) -> None:
        """Carries out what other nodes have stored."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETRIED):
                    await self._news.wait()
                    self._news.clear()
            if not self._touched:
                self._touched, self._failed = self._failed, set()
            touched, self._touched = self._touched, set()
            for device in touched:
                await self._adopt(device)

    def _replaced(self) -> None:
        self._applied.clear()

    def _changed(self, device: str) -> None:
        self._touched.add(device)
        self._news.set()

    async def _adopt(self, device: str) -> None:
        async with self._host.turn(device):
            await self._adopt_now(device)

    async def _adopt_now(self, device: str) -> Refused | None:
        """Returns why it is refused here."""
        revision, want = self.wants.value(device)
        times = {} if want is None else want.renewed
        renewed = {each for each, at in times.items() if self._renewed.get((device, each)) != at}
        try:
            await self._host.adopt(device, want, renewed)
        except Refused as refused:
            logs.refused("not_restored", kind="fleet", device=device, reason=str(refused))
            self._failed.add(device)
            return refused
        self._applied[device] = revision
        self._renewed |= {(device, each): at for each, at in times.items()}
        return None

    async def store(
        self, device: str, change: Callable[[], Awaitable[object]], subscriber: str | None = None
    ) -> None:
        """Makes a change of the subscriptions of a device, here and in the bucket.

        The lock of the device is held. `subscriber` has renewed its subscription. Raises `Refused`;
        then nothing has changed.
        """
        for _ in range(CHANGES):
            await change()
            now = int(time.time() * 1000)
            renewed = {
                each: now if each == subscriber else self._renewed.get((device, each), now)
                for each in self._host.timed(device)
            }
            requests = [msgspec.Raw(each) for each in self._host.want(device)]
            want = Want(requests=requests, renewed=renewed) if requests else None
            try:
                self._check_size(device, want)
                revision = self._applied.get(device, 0)
                self._applied[device] = await self.wants.store(device, want, revision)
            except Outdated:
                with contextlib.suppress(Error, OSError):
                    await self.wants.read(device)
                if (refused := await self._adopt_now(device)) is not None:
                    raise Refused(f"the fleet's subscriptions of {device}: {refused}") from None
                continue
            except Refused:
                await self._adopt_now(device)
                raise
            except (Error, OSError) as error:
                self._is_new.set()  # The bucket may be lost.
                await self._adopt_now(device)
                reason = str(error) or type(error).__name__
                is_certain = isinstance(error, NoStreamResponseError)
                said = "not stored in" if is_certain else "not confirmed by"
                raise Refused(f"{said} {self.wants.bucket}: {reason}") from None
            self._renewed |= {(device, each): at for each, at in renewed.items()}
            return
        raise Refused(f"{device} was changed by other nodes {CHANGES} times meanwhile: try again")

    def _check_size(self, device: str, want: Want | None) -> None:
        client = self._client
        if want is None or client is None:
            return
        size, most = len(msgspec.json.encode(want)), client.max_payload - 1024
        if size > most:
            raise Refused(
                f"the subscriptions of {device} take {size} bytes, a fleet stores at most {most}: "
                "use fewer tags, or set max_payload of the NATS server"
            )

    def added(self, device: ScannedDevice) -> None:
        """A device is known from now on."""
        device.partition = self.fleet.partition(connection_of(device.source.target))
        self._devices.setdefault(device.partition, {})[device.id] = device

    def dropped(self, device: ScannedDevice) -> None:
        """A device is known no more."""
        of_partition = self._devices.get(device.partition, {})
        if of_partition.get(device.id) is device:
            del of_partition[device.id]

    def is_own(self, device: ScannedDevice) -> bool:
        """Whether this node polls a device, now."""
        return self.fleet.is_own(device.partition)

    def fence(self, device: ScannedDevice) -> _core.Fence:
        """The fence of a device."""
        return self.fleet.fence(device.partition)

    def is_current(self, device: ScannedDevice, epoch: int) -> bool:
        """Whether this node has the lease of a device since that revision, or a later one."""
        return self.is_own(device) and self.fleet.revision(device.partition) >= epoch

    @property
    def own(self) -> Iterator[ScannedDevice]:
        """The devices that this node polls."""
        for partition in self.fleet.partitions:
            yield from self._devices.get(partition, {}).values()

    def _gained(self, partition: int) -> None:
        for device in list(self._devices.get(partition, {}).values()):
            self._host.begin(device)

    def _lost(self, partition: int) -> None:
        for device in list(self._devices.get(partition, {}).values()):
            self._host.end(device)

    async def command(
        self,
        device: ScannedDevice,
        tag: str,
        text: str,
        own: Callable[[], Awaitable[bool]],
        check: Callable[[], float],
    ) -> None:
        """Has a command carried out by whoever polls the device. Raises `Refused`.

        `own` carries it out here. It returns false, and writes nothing, if the device has moved.
        `check` refuses it if it is too late, and returns how many seconds it may wait.
        """
        end = time.monotonic() + self._moving_s
        why = f"no node polls {device.id} now"
        while True:
            left = check()
            owner = self.fleet.holder(device.partition)
            if self.is_own(device):
                if await own():
                    return
            elif owner is not None and self.fleet.is_other(owner):
                sent = await self._send(owner, device, tag, text, left)
                if sent is None:
                    return
                why = sent
            if time.monotonic() > end:
                raise Refused(f"not written: {why}")
            await asyncio.sleep(AGAIN)

    async def _send(
        self, owner: Holding, device: ScannedDevice, tag: str, text: str, left: float
    ) -> str | None:
        """Returns why another node did not carry out a command. Raises `Refused` if it tried."""
        holding = self.fleet.leases.seen.get(f"partition.{device.partition}")
        command = Command(
            device=device.id,
            tag=tag,
            text=text,
            epoch=0 if holding is None else holding.revision,
            within=min(left, self._moving_s),
        )
        # After this, it waits one timeout of the device for its turn, and one for the reply.
        timeout = self._moving_s + 2 * device.source.timeout / 1000 + ASKED
        try:
            done = await self._ask(owner, "command", command, Executed, timeout)
        except NoRespondersError:
            return f"node {owner.node} is gone"
        except (Error, OSError):
            raise Refused(f"not confirmed: node {owner.node} did not answer") from None
        if done.moved:
            return f"{device.id} moves from node {owner.node} to another one"
        if done.error is not None:
            raise Refused(done.error)
        return None

    async def told(self, what: str, devices: list[ScannedDevice]) -> dict[str, Any]:
        """What other nodes tell of their devices; nothing of nodes that don't answer."""
        of_process: dict[str, tuple[Holding, list[str]]] = {}
        for device in devices:
            owner = self.fleet.holder(device.partition)
            if owner is not None and self.fleet.is_other(owner):
                of_process.setdefault(owner.process, (owner, []))[1].append(device.id)
        found = await asyncio.gather(*(self._tell(what, *each) for each in of_process.values()))
        return {device: report for each in found for device, report in each.items()}

    async def _tell(self, what: str, node: Holding, devices: list[str]) -> dict[str, Any]:
        try:
            return (await self._ask(node, what, About(devices=devices), Told, ASKED)).devices
        except (Error, OSError) as error:
            reason = str(error) or type(error).__name__
            logs.refused("node_silent", kind="fleet", node=node.node, reason=reason)
            return {}

    async def _ask(
        self, node: Holding, what: str, request: msgspec.Struct, kind: type[Reply], seconds: float
    ) -> Reply:
        client = self._client
        if client is None:
            raise NoAnswer
        where = subject(self._prefix, node.node, what, node.process)
        answer: Msg = await client.request(where, msgspec.json.encode(request), timeout=seconds)
        try:
            return msgspec.json.decode(answer.data, type=kind)
        except msgspec.DecodeError as error:
            raise OSError(f"node {node.node} sent a malformed answer: {error}") from None

    async def leave(self) -> None:
        """Hands everything over."""
        if self.is_joined:
            logs.write(logging.INFO, "fleet_leaving", fleet=self.fleet.settings.name)
            await self.fleet.leave()
