"""What the audit log has of the commands of one request."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from holdfast.audit import Audit


class Recording:
    """Records commands that are carried out together.

    Their lines are written before memory is. What a journal carries out, and what is written only
    while memory is sealed, is recorded after it: only then the outcome is known, and the sequence
    in a log.
    """

    def __init__(
        self, audit: Audit, lines: Callable[[Mapping[str, object]], Iterable[Mapping[str, object]]]
    ) -> None:
        """`lines` returns a line for each command, which ends with these fields."""
        self._audit = audit
        self._lines = lines
        self._is_later = False

    def begin(self, is_later: bool) -> None:
        """The commands are about to be carried out, or refused. Raises `Unrecorded`.

        `is_later`: whether the outcome is known only later.
        """
        self._is_later = is_later
        if is_later:
            self._audit.require()
        else:
            self._audit.write_first(self._lines({"outcome": "done"}))

    def done(self, sequence: int | None) -> None:
        """The commands were carried out."""
        if self._is_later:
            place = {} if sequence is None else {"log_sequence": sequence}
            self._audit.write_all(self._lines({"outcome": "done", **place}), done=True)

    def not_confirmed(self) -> None:
        """Nobody knows whether the commands will be carried out."""
        self._audit.write_all(self._lines({"outcome": "not_confirmed"}), done=True)
