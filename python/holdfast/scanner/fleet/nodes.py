"""What the nodes of a fleet ask each other: to carry out commands, and to report their devices."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass
from itertools import count, islice
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import msgspec
from nats.errors import Error, NoRespondersError
from nats.errors import TimeoutError as NoAnswer

from holdfast.events import log_lines
from holdfast.net.nats.connection import nats_reason
from holdfast.runtime import tasks
from holdfast.scanner.errors import STOPPING, Moved, NotConfirmed, Refused
from holdfast.scanner.fleet.command_order import CommandOrder
from holdfast.scanner.fleet.partition_leases import PARTITION
from holdfast.scanner.fleet.questions import ask, subject
from holdfast.scanner.late_commands import SEND_AGAIN
from holdfast.scanner.messages.types import Answer
from holdfast.scanner.reports.variables import fitting, joined

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.msg import Msg

    from holdfast.replication.leases.bucket import Holding
    from holdfast.scanner.fleet.member import FleetMember
    from holdfast.scanner.fleet.questions import Reply
    from holdfast.scanner.placement import LocalCommands, LocalReports, LocalWrite
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry

ANSWER_TIMEOUT_S = 2.0
"""Time to wait for the answer of another node."""

RETRY_S = 0.1
"""Between attempts to find the node that polls a device."""

ENVELOPE_BYTES = 512
"""Bytes of an answer without devices."""


class Command(msgspec.Struct, kw_only=True):
    """A command for a device that the other node polls."""

    device: str
    tag: str
    text: str
    epoch: int
    """The revision of the lease that the sender knows. A node with an older one must not write."""
    within: float = 0.0
    """Seconds that it may wait to be sent to the device; one timeout of the device is added."""


class Executed(Answer, forbid_unknown_fields=True, kw_only=True):
    """The answer to a command."""

    not_confirmed: bool = False
    """With an error: it may have been carried out."""
    moved: bool = False
    """The node does not poll the device any more. Nothing was written."""


class ReportQuestion(msgspec.Struct, kw_only=True):
    """Asks for reports, or for variables, of devices that the other node polls."""

    devices: list[str]
    offset: int = 0
    """The number of variables of the first device to skip."""


class NodeReports(Answer, forbid_unknown_fields=True, kw_only=True):
    """The reports, or the variables, of some of the devices: as many as fit into a message."""

    devices: dict[str, Any] = msgspec.field(default_factory=dict)
    is_full: bool = False
    """Whether some did not fit: the next devices, or variables of the last one."""


class OtherNodes:
    """The other nodes, as one of them sees them."""

    def __init__(self, prefix: str, member: FleetMember) -> None:
        self._prefix = prefix
        self._member = member
        self._partition_leases = member.partition_leases
        self._move_timeout_s = 2 * self._partition_leases.settings.lease_times.ttl_s
        """How long a command waits for a node that polls its device, once it has found none: twice
        a takeover."""
        self._numbers = count()
        """Of commands, in the order in which they were received."""
        self._orders: WeakValueDictionary[str, CommandOrder] = WeakValueDictionary()
        """By device. Each of its commands keeps it."""

    async def write(
        self,
        device: ScannedDevice,
        tag: str,
        text: str,
        write_here: LocalWrite,
        remaining_s: Callable[[], float],
    ) -> None:
        """Has a command carried out by the node that polls the device. Raises `Refused`.

        See `Placement.write`. The commands to a device are carried out in the order in which they
        were received, or refused.
        """
        why, gives_up_at = f"no node polls {device.id} now", 0.0
        order = self._orders.setdefault(device.id, CommandOrder())
        number = next(self._numbers)
        may_be_written = True

        def last_moment() -> float:
            order.release(number)
            return remaining_s()

        def sent() -> None:
            if not gives_up_at:  # Else it may come back again: the next one waits for its answer.
                order.release(number)

        try:
            while True:
                changed = order.wait(number)
                if gives_up_at:
                    await asyncio.sleep(RETRY_S)
                while not (order.is_overtaken(number) or order.take(number)):
                    changed.clear()
                    await tasks.within(remaining_s(), changed.wait())
                # Each time: it may have waited, and the address of the device may change meanwhile.
                left, device = remaining_s(), self._member.known(device)
                if order.is_overtaken(number):
                    passed = f"a later command to {device.id} went before it"
                    raise Refused(f"not written: {passed}; {SEND_AGAIN}")
                owner = self._partition_leases.holder(device.partition)
                if self._member.is_own(device):
                    with contextlib.suppress(Moved):
                        await write_here(last_moment)
                        return
                elif owner is not None and self._partition_leases.is_other(owner):
                    flaw = await self._forward(owner, device, tag, text, left, sent)
                    if flaw is None:
                        return
                    why = flaw
                now = time.monotonic()
                gives_up_at = gives_up_at or now + self._move_timeout_s
                if now > gives_up_at:
                    raise Refused(f"not written: {why}")
        except Refused as refused:
            may_be_written = isinstance(refused, NotConfirmed)
            raise
        finally:
            order.end(number, may_be_written=may_be_written)

    async def _forward(
        self,
        owner: Holding,
        device: ScannedDevice,
        tag: str,
        text: str,
        left: float,
        sent: Callable[[], None],
    ) -> str | None:
        """Returns why another node did not carry out a command. Raises `Refused` if it tried."""
        holding = self._partition_leases.leases.seen.get(f"{PARTITION}{device.partition}")
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
            done = await self._ask(owner, "command", command, Executed, timeout, sent)
        except NoRespondersError:  # The only error that is certain: nobody has the command.
            return f"node {owner.node} is gone"
        except (Error, OSError):
            raise NotConfirmed(f"not confirmed: node {owner.node} did not answer") from None
        except asyncio.CancelledError:  # By the end of the responder.
            raise NotConfirmed(f"not confirmed: {STOPPING}") from None
        if done.moved:
            return f"{device.id} moves from node {owner.node} to another one"
        if done.error is not None:
            raise (NotConfirmed if done.not_confirmed else Refused)(done.error)
        if not done.success:
            raise NotConfirmed(f"not confirmed: node {owner.node} gives no reason")
        return None

    async def reports(
        self, what: str, devices: list[ScannedDevice], offset: int = 0
    ) -> tuple[dict[str, Any], set[str]]:
        """Returns what other nodes report of their devices, except nodes that don't answer.

        `offset` is how many variables of the first device to skip. Returns also the devices with
        which a message was full: what follows them must be asked for again.
        """
        of_process: dict[str, tuple[Holding, list[str]]] = {}
        for device in devices:
            owner = self._partition_leases.holder(device.partition)
            if owner is not None and self._partition_leases.is_other(owner):
                of_process.setdefault(owner.process, (owner, []))[1].append(device.id)
        found = await asyncio.gather(
            *(
                self._reports_of(what, node, ids, offset if ids[0] == devices[0].id else 0)
                for node, ids in of_process.values()
            )
        )
        reports = {device: report for each in found for device, report in each.devices.items()}
        return reports, {list(each.devices)[-1] for each in found if each.is_full and each.devices}

    async def _reports_of(
        self, what: str, node: Holding, devices: list[str], offset: int
    ) -> NodeReports:
        question = ReportQuestion(devices=devices, offset=offset)
        try:
            reports = await self._ask(node, what, question, NodeReports, ANSWER_TIMEOUT_S)
        except (Error, OSError) as error:
            reports = NodeReports(success=False, error=nats_reason(error))
        if not reports.success:
            log_lines.refused("node_silent", kind="fleet", node=node.node, reason=reports.error)
        return reports

    async def _ask(
        self,
        node: Holding,
        what: str,
        request: msgspec.Struct,
        kind: type[Reply],
        seconds: float,
        sent: Callable[[], None] = lambda: None,
    ) -> Reply:
        client = self._member.client
        if client is None:
            raise NoAnswer
        where = subject(self._prefix, node.node, what, node.process)
        return await ask(client, where, msgspec.json.encode(request), kind, seconds, sent)


@dataclass(eq=False)
class NodeAnswers:
    """Carries out commands, and reports devices, for other nodes."""

    _member: FleetMember
    _registry: Registry
    _commands: LocalCommands
    _reports: LocalReports

    async def command(self, message: Msg) -> bytes:
        """Carries out a command that another node has received."""
        command = msgspec.json.decode(message.data, type=Command)
        device = self._registry.devices.get(command.device)

        def remaining_s() -> float:
            # It has waited at the other node before, which says how long it may still wait.
            return min(self._commands.remaining_s(message), command.within)

        try:
            # The sender may know of a later lease, which this node has not heard of yet.
            if device is None or not self._member.is_current(device, command.epoch):
                return msgspec.json.encode(Executed(success=False, moved=True))
            await self._commands.write(command.device, command.tag, command.text, remaining_s)
            executed = Executed(success=True)
        except Moved:
            executed = Executed(success=False, moved=True)
        except Refused as refused:
            is_uncertain = isinstance(refused, NotConfirmed)
            executed = Executed(success=False, error=str(refused), not_confirmed=is_uncertain)
        return msgspec.json.encode(executed)

    async def browse(self, message: Msg) -> bytes:
        """Reports devices that this node polls."""
        question = msgspec.json.decode(message.data, type=ReportQuestion)
        encode = msgspec.json.encode
        texts = (
            encode(id) + b":" + encode(report)
            for id, report in self._reports.device_reports(question.devices)
        )
        return _answer(*joined(texts, self._reports.max_bytes - ENVELOPE_BYTES))

    async def variables(self, message: Msg) -> bytes:
        """Reports the values of devices that this node polls."""
        question = msgspec.json.decode(message.data, type=ReportQuestion)
        left = most = self._reports.max_bytes - ENVELOPE_BYTES
        devices: list[bytes] = []
        for id, values in self._reports.device_variables(question.devices):
            head = msgspec.json.encode(id) + b":["
            around = len(head) + len(b"],")
            offset = question.offset if id == question.devices[0] else 0
            texts = (fitting(each, most - around) for each in islice(values, offset, None))
            text, is_all = joined(texts, left - around)
            left -= around + len(text)
            if left < 0 or not (text or is_all):
                return _answer(b",".join(devices), False)
            devices.append(head + text + b"]")
            if not is_all:
                return _answer(b",".join(devices), False)
        return _answer(b",".join(devices), True)


def _answer(devices: bytes, is_all: bool) -> bytes:
    """Returns `NodeReports` as JSON."""
    is_full = b"false" if is_all else b"true"
    return b'{"success":true,"devices":{%b},"isFull":%b}' % (devices, is_full)
