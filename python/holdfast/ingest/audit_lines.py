"""What the audit log has of the commands of one request."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.events.audit.chain import encoded
from holdfast.protocol import EXCEPTIONS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast._core import Batch
    from holdfast.events.audit import Audit
    from holdfast.events.audit.log import Group


MAX_ORIGINS = 64
"""Beginnings of lines that are kept."""


class Recording:
    """Records commands that are carried out together.

    Their lines are written before memory is, together with those of other commands that have begun.
    What a journal or a device carries out, and what is written only while memory is sealed, is
    recorded after it: only then the outcome is known, and the sequence in a log.
    """

    __slots__ = ("_audit", "_group", "_memories", "_origin", "_writes")

    def __init__(self, audit: Audit, origin: bytes, memories: Sequence[str], writes: Batch) -> None:
        """`origin` is the beginning of each line: who sends the commands, and through what.

        `memories` are the names of the memories of `writes`.
        """
        self._audit = audit
        self._origin = origin
        self._memories = memories
        self._writes = writes
        self._group: Group | None = None

    def checked(self) -> None:
        """The commands were checked. Raises `Unrecorded`."""
        if self._writes.can_be_refused:
            self._audit.require()
        else:
            self._group = self._audit.queue(self._lines("done"))

    def before_write(self) -> None:
        """The commands are about to be carried out. Raises `Unrecorded`."""
        if self._group is not None:
            self._audit.write_group(self._group)

    def carried_out(self, sequence: int | None = None) -> None:
        """The commands were carried out, in the step of a log with this number."""
        if self._group is None:
            self._audit.write_all(self._lines("done", sequence))

    def not_confirmed(self) -> None:
        """Nobody knows whether the commands will be carried out."""
        self._audit.write_all(self._lines("not_confirmed"))

    def answered_by_device(self, device: str, code: int | None) -> None:
        """A device was sent the commands in place of memory, and answered with this exception, if
        any. The outcome is named as that of the same write over Modbus.
        """
        outcome = "done"
        if code is not None:
            outcome = EXCEPTIONS.get(code, f"exception {code:02x}").lower().replace(" ", "_")
        route = b"," + encoded({"route": device})[1:-1]
        self._audit.write_all(self._lines(outcome, route=route))

    def _lines(
        self, outcome: str, sequence: int | None = None, *, route: bytes = b""
    ) -> list[msgspec.Raw]:
        names = [encoded(name) for name in self._memories]
        lines = self._writes.lines(self._origin + route, names, outcome, sequence)
        return [msgspec.Raw(line) for line in lines]


@lru_cache(MAX_ORIGINS)
def origin_around(listener: str, source: str) -> tuple[bytes, bytes]:
    """The beginning of a line before and after its peer, in JSON."""
    before = encoded({"listener": listener})[:-1] + b',"peer":'
    after = b"," + encoded({"source": source, "function": "write"})[1:-1]
    return before, after


def values_of(command: Mapping[str, Any]) -> Any:
    """The values of a command, which has `values` or `bools`."""
    return command["values"] if "values" in command else command["bools"]
