"""Answers what the other nodes of a fleet ask this one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from holdfast.scanner.errors import Refused
from holdfast.scanner.fleet.exchange import Command, Executed, ReportQuestion
from holdfast.scanner.fleet.reports import ENVELOPE_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from nats.aio.msg import Msg

    from holdfast.scanner.fleet.member import FleetMember
    from holdfast.scanner.placement import CommandHost, ReportHost
    from holdfast.scanner.subscriptions.registry import Registry


class NodeAnswers:
    """Carries out commands, and reports devices, for other nodes."""

    def __init__(
        self,
        member: FleetMember,
        registry: Registry,
        commands: CommandHost,
        reports: ReportHost,
    ) -> None:
        self._member = member
        self._registry = registry
        self._commands = commands
        self._reports = reports

    async def command(self, message: Msg) -> bytes:
        """Carries out a command that another node has received."""
        command = msgspec.json.decode(message.data, type=Command)
        device = self._registry.devices.get(command.device)

        def remaining_s() -> float:
            # It has waited at the other node before, which says how long it may still wait.
            return min(self._commands.remaining_s(message), command.within)

        try:
            # The sender may know of a later lease, which this node has not heard of yet.
            is_current = device is not None and self._member.is_current(device, command.epoch)
            done = is_current and await self._commands.write(
                command.device, command.tag, command.text, remaining_s
            )
            executed = Executed(moved=not done)
        except Refused as refused:
            executed = Executed(error=str(refused))
        return msgspec.json.encode(executed)

    async def browse(self, message: Msg) -> bytes:
        """Reports devices that this node polls."""
        question = msgspec.json.decode(message.data, type=ReportQuestion)
        return self._fitting(self._reports.device_reports(question.devices))

    async def variables(self, message: Msg) -> bytes:
        """Reports the values of devices that this node polls."""
        question = msgspec.json.decode(message.data, type=ReportQuestion)
        return self._fitting(self._reports.device_variables(question.devices))

    def _fitting(self, reports: Iterable[tuple[str, object]]) -> bytes:
        """Returns as many reports as fit into a message."""
        texts: list[bytes] = []
        room = self._reports.max_bytes - ENVELOPE_BYTES
        for id, content in reports:
            text = msgspec.json.encode(id) + b":" + msgspec.json.encode(content)
            room -= len(text) + 1
            if room < 0:
                break
            texts.append(text)
        return b'{"devices":{' + b",".join(texts) + b"}}"
