"""Writes that go to devices in place of a memory: each waits for its turn and for the answer.

A write that was not sent yet is withdrawn when its client has gone, also while the process was
stopped, and when the server ends. One that was sent is waited for, and recorded with the answer of
the device.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING

from holdfast.errors import ModbusError, ModbusException
from holdfast.ingest import Refused
from holdfast.polling.calls import Calls
from holdfast.protocol import PATH_UNAVAILABLE, TARGET_SILENT

if TYPE_CHECKING:
    from holdfast.ingest import Begun, MemoryAccess, Written
    from holdfast.net.http.requests import Request

MAX_WAITING = 16
"""The most writes that wait for one device: a silent one must not occupy all connections."""


class DeviceWrites:
    """The writes of one server that wait for devices."""

    def __init__(self, memory_access: MemoryAccess) -> None:
        self._memory_access = memory_access
        self._calls: Calls | None = None
        self._opening = asyncio.Lock()
        self._waiting: Counter[str] = Counter()
        self._tickets: set[int] = set()
        self._is_ending = False

    def end(self) -> None:
        """Withdraws all writes that were not sent yet. Called in the thread of the server."""
        self._is_ending = True
        if self._calls is not None:
            for ticket in self._tickets:
                self._calls.withdraw(ticket)
        self._close_after_last()

    async def carry_out(self, request: Request, begun: Begun) -> Written:
        """Carries out a write that goes to a device. Raises `Refused`."""
        device = begun.device
        assert device is not None
        with self._memory_access.reporting_refusals(begun):
            if self._waiting[device] >= MAX_WAITING:
                detail = f"{MAX_WAITING} writes wait for {device}, which is the limit"
                raise Refused("busy", detail, **begun.where)
            self._waiting[device] += 1
            try:
                return self._memory_access.finish_device_write(
                    begun, await self._answer(request, begun)
                )
            finally:
                self._waiting[device] -= 1
                self._close_after_last()

    async def _answer(self, request: Request, begun: Begun) -> int | None:
        """The answer of the device: the code of its exception, if any. Raises `Refused`."""
        if self._calls is None:
            async with self._opening:
                self._calls = self._calls or await Calls.opened()
        calls = self._calls
        if self._is_ending or not request.is_client_there():
            raise _withdrawn(begun)
        ticket = self._memory_access.call_device(begun, calls.caller)
        answer = calls.result(ticket)
        self._tickets.add(ticket)
        request.when_gone(partial(calls.withdraw, ticket))
        try:
            sent, result = await answer
        except asyncio.CancelledError:
            # Nobody waits for the answer any more: the record of the write must say so.
            with contextlib.suppress(Refused), self._memory_access.reporting_refusals(begun):
                if not calls.give_up(ticket, answer):
                    raise _withdrawn(begun) from None
                self._memory_access.finish_device_write(begun, TARGET_SILENT)
            raise
        finally:
            request.when_gone(None)
            self._tickets.discard(ticket)
        if not sent and result is None:
            raise _withdrawn(begun)
        if isinstance(result, ModbusException):
            return result.code
        if isinstance(result, ModbusError):
            return TARGET_SILENT if sent else PATH_UNAVAILABLE
        return None

    def _close_after_last(self) -> None:
        if self._is_ending and self._calls is not None and not any(self._waiting.values()):
            self._calls.close()


def _withdrawn(begun: Begun) -> Refused:
    detail = f"not sent to {begun.device}: the client has gone, or REST has ended"
    return Refused("withdrawn", detail, **begun.where)
