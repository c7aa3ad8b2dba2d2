"""Writes of tags: outputs request them, the native poller sends them, the audit log has them."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.client.requests import write_typed
from holdfast.events import log_lines
from holdfast.events.audit import Unrecorded
from holdfast.outputs.device_access import NotWritten
from holdfast.polling.faults import fault_text, fault_word
from holdfast.polling.write_ttl import WRITE_TTL_S
from holdfast.tags.text import value_from
from holdfast.values import ConversionError, codec_for

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast._core import Poller, Request
    from holdfast.events.audit import Audit
    from holdfast.tags import Tag

MAX_WAITING = 1000
"""The most writes that wait for their devices."""

_WAIT_S = 1.0
"""How long one wait for outcomes takes."""


class _Write(NamedTuple):
    """A write on its way."""

    record: dict[str, Any]
    done: Callable[[NotWritten | None], None]


class TagWrites:
    """Sends writes, and reports their outcomes in a thread of its own. Ends with the poller."""

    def __init__(
        self, poller: Poller, audit: Audit | None, find: Callable[[str, str], Tag | None]
    ) -> None:
        self._poller, self._audit, self._find = poller, audit, find
        self._results = poller.receiver()
        self._lock = threading.Lock()
        self._pending: dict[int, _Write] = {}
        self._thread = threading.Thread(target=self._run, name="holdfast-writes", daemon=True)

    def write(
        self,
        device: str,
        name: str,
        text: str,
        by: str,
        peer: str,
        done: Callable[[NotWritten | None], None],
        *,
        states: bool = True,
    ) -> None:
        """Writes a value, as text or, with `states`, as a name.

        Raises `NotWritten` if nothing was sent. `by` and `peer` are who has requested it, for the
        audit log.
        """
        record: dict[str, Any] = {"listener": by, "peer": peer, "function": "write"}
        record |= {"device": device, "tag": name}
        try:
            tag = self._find(device, name)
            request, values = _request(tag, text, states=states)
            assert tag is not None, "there is no request for no tag"
            record |= {"area": tag.area, "address": tag.address, "values": values}
            self._send(device, request, _Write(record, done))
        except NotWritten as refused:
            if self._audit is not None:
                self._audit.write(**record, outcome=refused.reason)
            raise

    def join(self, timeout: float) -> None:
        """Waits for the thread, which ends with the poller."""
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def _send(self, device: str, request: Request, write: _Write) -> None:
        if self._audit is not None:
            try:
                self._audit.require()
            except Unrecorded:
                detail = "the audit log can't be written, and no write is carried out without it"
                raise NotWritten("unrecorded", detail) from None
        with self._lock:
            if len(self._pending) >= MAX_WAITING:
                raise NotWritten("busy", f"{MAX_WAITING} writes wait for their devices")
            try:
                number = self._poller.write(device, request, self._results, within=WRITE_TTL_S)
            except (ValueError, RuntimeError) as error:
                raise NotWritten("unknown_device", str(error)) from None
            self._pending[number] = write
            if self._thread.ident is None:
                self._thread.start()

    def _run(self) -> None:
        while (taken := self._results.take(_WAIT_S)) is not None:
            for number, fault in taken[1]:
                with self._lock:
                    write = self._pending.pop(number, None)
                if write is not None:
                    try:
                        self._report(write, fault)
                    except Exception:  # A fault in one outcome must not end all others.
                        log_lines.problem("tag_write_failed")

    def _report(self, write: _Write, fault: int) -> None:
        outcome = fault_word(fault) if fault else "done"
        if self._audit is not None:
            self._audit.write_all([{**write.record, "outcome": outcome}], done=not fault)
        write.done(NotWritten(outcome, fault_text(fault)) if fault else None)


def _request(tag: Tag | None, text: str, *, states: bool) -> tuple[Request, list[int]]:
    """The request that writes a text, and what it writes. Raises `NotWritten`."""
    if tag is None:
        raise NotWritten("unknown_tag", "no such tag")
    if not tag.writable:
        raise NotWritten("not_writable", "the tag is not writable")
    try:
        raw = tag.raw(value_from(tag, text, states=states))
        encoded = codec_for(tag.area, tag.type, tag.order, tag.encoding).encode(raw)
        [request] = write_typed(
            tag.area, tag.address, raw, tag.type, tag.order, tag.encoding, split=False
        )
    except (ConversionError, ValueError, TypeError, OverflowError) as error:
        raise NotWritten("invalid_value", str(error)) from None
    is_bit = tag.of_type.base == "bit"
    return request, [int(raw)] if is_bit else [int(value) for value in encoded]
