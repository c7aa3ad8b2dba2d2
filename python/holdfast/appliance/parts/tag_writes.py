"""Writes of tags: outputs request them, the native poller sends them, the audit log has them."""

from __future__ import annotations

import threading
import time
from math import inf
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

STOP_TIMEOUT_S = 2.0
"""Time after the stop in which devices may still answer."""

_WAIT_S, _STOP_WAIT_S = 1.0, 0.1
"""How long one wait for outcomes takes, before and after the stop."""


class _Write(NamedTuple):
    """A write on its way."""

    record: dict[str, Any]
    done: Callable[[NotWritten | None], None]


class TagWrites:
    """Sends writes, and reports their outcomes in a thread of its own. Ends with the poller.

    After a stop, it reports what devices have not answered in time: no write is without an outcome.
    """

    def __init__(
        self, poller: Poller, audit: Audit | None, find: Callable[[str, str], Tag | None]
    ) -> None:
        self._poller, self._audit, self._find = poller, audit, find
        self._results = poller.new_receiver()
        self._changed = threading.Condition()
        self._pending: dict[int, _Write] = {}
        self._gives_up_at = inf
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
                self._audit.write_refused(**record, outcome=refused.reason)
            raise

    def stop(self) -> None:
        """Refuses further writes, and reports those before within `STOP_TIMEOUT_S`."""
        with self._changed:
            self._gives_up_at = time.monotonic() + STOP_TIMEOUT_S
        self._results.wake()

    def finish(self) -> None:
        """Waits for the devices, at most until those that have not answered are reported."""
        with self._changed:
            self._changed.wait_for(lambda: not self._pending, STOP_TIMEOUT_S)

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
        with self._changed:
            if self._gives_up_at < inf:
                raise NotWritten("stopping", "Holdfast is stopping; nothing was sent")
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
        wait = _WAIT_S
        while (taken := self._results.take(wait)) is not None:
            for number, fault in taken[1]:
                refused = NotWritten(fault_word(fault), fault_text(fault)) if fault else None
                self._report(number, refused)
            wait = _WAIT_S if self._gives_up_at == inf else _STOP_WAIT_S
            if time.monotonic() >= self._gives_up_at:
                self._give_up()
        self._give_up()

    def _give_up(self) -> None:
        """Reports the writes whose outcome nobody will know."""
        for number in list(self._pending):
            detail = "no reply before the stop; the device may have carried out the write"
            self._report(number, NotWritten("unanswered", detail))

    def _report(self, number: int, refused: NotWritten | None) -> None:
        with self._changed:
            write = self._pending.pop(number, None)
            self._changed.notify_all()
        if write is None:
            return
        outcome = "done" if refused is None else refused.reason
        try:
            if self._audit is not None:
                # Whatever the outcome, the device may have carried out the write.
                self._audit.write(**write.record, outcome=outcome)
            write.done(refused)
        except Exception:  # A fault in one outcome must not end all others.
            log_lines.problem("tag_write_failed")


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
    except Exception:  # A fault in one command must not end the connection of all others.
        log_lines.problem("tag_write_failed")
        raise NotWritten("internal_error", "an internal error, see the log") from None
    is_bit = tag.of_type.base == "bit"
    return request, [int(raw)] if is_bit else [int(value) for value in encoded]
