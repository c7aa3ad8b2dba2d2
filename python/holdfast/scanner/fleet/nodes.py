"""Asks the other nodes of a fleet: to carry out commands, and to report devices that they poll."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
from nats.errors import Error, NoRespondersError
from nats.errors import TimeoutError as NoAnswer

from holdfast import logs
from holdfast.scanner.errors import Refused
from holdfast.scanner.fleet.exchange import (
    Command,
    Executed,
    NodeReports,
    ReportQuestion,
    subject,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast.leases import Holding
    from holdfast.scanner.fleet.member import FleetMember
    from holdfast.scanner.subscriptions.device import ScannedDevice

Reply = TypeVar("Reply", bound=msgspec.Struct)

ANSWER_TIMEOUT_S = 2.0
"""Time to wait for the answer of another node."""

RETRY_S = 0.1
"""Between attempts to find the node that polls a device."""


class OtherNodes:
    """The other nodes, as one of them sees them."""

    def __init__(self, prefix: str, member: FleetMember) -> None:
        self._prefix = prefix
        self._member = member
        self._fleet = member.fleet
        self._move_timeout_s = 2 * self._fleet.settings.lease_times.ttl_s
        """How long a command waits for a node that polls its device: twice a takeover."""
        self._client: Client | None = None

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._client = client

    async def write(
        self,
        device: ScannedDevice,
        tag: str,
        text: str,
        own: Callable[[], Awaitable[bool]],
        remaining_s: Callable[[], float],
    ) -> None:
        """Has a command carried out by the node that polls the device. Raises `Refused`.

        `own` carries it out here. It returns false, and writes nothing, if the device has moved.
        `remaining_s` refuses it if it is too late, and returns how many seconds it may wait.
        """
        end = time.monotonic() + self._move_timeout_s
        why = f"no node polls {device.id} now"
        while True:
            left = remaining_s()  # Each time: this loop may run for seconds.
            owner = self._fleet.holder(device.partition)
            if self._member.is_own(device):
                if await own():
                    return
            elif owner is not None and self._fleet.is_other(owner):
                sent = await self._forward(owner, device, tag, text, left)
                if sent is None:
                    return
                why = sent
            if time.monotonic() > end:
                raise Refused(f"not written: {why}")
            await asyncio.sleep(RETRY_S)

    async def _forward(
        self, owner: Holding, device: ScannedDevice, tag: str, text: str, left: float
    ) -> str | None:
        """Returns why another node did not carry out a command. Raises `Refused` if it tried."""
        holding = self._fleet.leases.seen.get(f"partition.{device.partition}")
        command = Command(
            device=device.id,
            tag=tag,
            text=text,
            epoch=0 if holding is None else holding.revision,
            within=min(left, self._move_timeout_s),
        )
        # After this, it waits one timeout of the device for its turn, and one for the reply.
        timeout = self._move_timeout_s + 2 * device.source.timeout / 1000 + ANSWER_TIMEOUT_S
        try:
            done = await self._ask(owner, "command", command, Executed, timeout)
        except NoRespondersError:  # The only error that is certain: nobody has the command.
            return f"node {owner.node} is gone"
        except (Error, OSError):
            raise Refused(f"not confirmed: node {owner.node} did not answer") from None
        if done.moved:
            return f"{device.id} moves from node {owner.node} to another one"
        if done.error is not None:
            raise Refused(done.error)
        return None

    async def reports(self, what: str, devices: list[ScannedDevice]) -> dict[str, Any]:
        """Returns what other nodes report of their devices, except nodes that don't answer."""
        of_process: dict[str, tuple[Holding, list[str]]] = {}
        for device in devices:
            owner = self._fleet.holder(device.partition)
            if owner is not None and self._fleet.is_other(owner):
                of_process.setdefault(owner.process, (owner, []))[1].append(device.id)
        found = await asyncio.gather(
            *(self._reports_of(what, *each) for each in of_process.values())
        )
        return {device: report for each in found for device, report in each.items()}

    async def _reports_of(self, what: str, node: Holding, devices: list[str]) -> dict[str, Any]:
        try:
            return (
                await self._ask(
                    node, what, ReportQuestion(devices=devices), NodeReports, ANSWER_TIMEOUT_S
                )
            ).devices
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
