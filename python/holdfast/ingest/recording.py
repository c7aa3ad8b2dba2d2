"""What the audit log has of the commands of one request."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.events.audit import Audit
    from holdfast.events.audit.log import Group


class Recording:
    """Records commands that are carried out together.

    Their lines are written before memory is, together with those of other commands that have begun.
    What a journal carries out, and what is written only while memory is sealed, is recorded after
    it: only then the outcome is known, and the sequence in a log.
    """

    __slots__ = ("_audit", "_commands", "_group", "_origin")

    def __init__(
        self, audit: Audit, origin: Mapping[str, object], commands: Sequence[Mapping[str, Any]]
    ) -> None:
        """`origin`: the fields of each line that say who sends the commands, and through what."""
        self._audit = audit
        self._origin = origin
        self._commands = commands
        self._group: Group | None = None

    def begin(self, is_later: bool) -> None:
        """The commands were checked. Raises `Unrecorded`.

        `is_later`: whether the outcome is known only later.
        """
        if is_later:
            self._audit.require()
        else:
            self._group = self._audit.queue(self._lines("done"))

    def write(self) -> None:
        """The commands are about to be carried out. Raises `Unrecorded`."""
        if self._group is not None:
            self._audit.write_group(self._group)

    def done(self, sequence: int | None = None) -> None:
        """The commands were carried out, in the step of a log with this number."""
        if self._group is None:
            self._audit.write_all(self._lines("done", sequence), done=True)

    def not_confirmed(self) -> None:
        """Nobody knows whether the commands will be carried out."""
        self._audit.write_all(self._lines("not_confirmed"), done=True)

    def _lines(self, outcome: str, sequence: int | None = None) -> list[dict[str, object]]:
        lines = [
            {
                **self._origin,
                "function": "write",
                "memory": command["memory"],
                "area": command["area"],
                "address": command["address"],
                "values": list(map(int, values_of(command))),
                "outcome": outcome,
            }
            for command in self._commands
        ]
        if sequence is not None:
            for line in lines:
                line["log_sequence"] = sequence
        return lines


def values_of(command: Mapping[str, Any]) -> Any:
    """The values of a command, which has `values` or `bools`."""
    return command["values"] if "values" in command else command["bools"]
