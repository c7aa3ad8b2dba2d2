"""Refused commands: the error, its reasons and texts, and what is shown of a command."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from holdfast import _core
from holdfast.runtime.text import clip

if TYPE_CHECKING:
    from collections.abc import Mapping

Place: TypeAlias = tuple[int | None, str, str, int]
"""The index of a command in its batch, if it has one, and the memory, area and address."""

MAX_SHOWN = 40
"""The characters of a name or a value of a command that are shown."""


class Refused(Exception):
    """A command was refused: nothing has changed, or `detail` says that it may have.

    `reason` is a word for programs, `detail` a message for people. `where` locates the error:
    `command` is the index of the command in a batch, `index` the index of the value in the command.
    `memory`, `area`, `address` and `value` are from the command, as far as they could be parsed.
    `is_recorded` tells whether the audit log has it already.
    """

    is_recorded = False

    def __init__(self, reason: str, detail: str, **where: Any) -> None:
        super().__init__(reason, detail)  # Its arguments, so that it can be pickled.
        self.reason = reason
        self.detail = detail
        self.where = where

    def __str__(self) -> str:
        return self.detail

    def answer(self) -> dict[str, object]:
        """Returns the answer for the source."""
        places: dict[str, object] = {
            key: self.where[key] for key in ("command", "index") if key in self.where
        }
        return {"status": "rejected", "reason": self.reason, **places, "detail": self.detail}


REFUSED_FOR_NOW = {
    "busy": "too many writes wait to be stored; nothing has changed",
    "not_stored": "the file of the memory can't be written; nothing has changed",
    "log_unavailable": "the log of the memory can't be reached; nothing has changed",
    "not_confirmed": "the log did not confirm the write in time; it may still be carried out",
}
"""Why memories that are kept refuse writes for now: a later attempt may succeed. So an MQTT message
stays unacknowledged, and the broker sends it again."""


def unreadable(error: OSError) -> str:
    """The reason why a memory can't be read."""
    return "stale" if isinstance(error, _core.Stale) else "log_unavailable"


def _prefix(index: int | None) -> str:
    """Returns the beginning of a text about a command of a batch."""
    return "" if index is None else f"commands[{index}]: "


def place_of(index: int | None, memory: str, area: str, address: int) -> dict[str, Any]:
    """Returns the target of a command for logs, with limited lengths."""
    return {
        **({} if index is None else {"command": index}),
        "memory": memory[:MAX_SHOWN],
        "area": area[:MAX_SHOWN],
        "address": address if -(2**63) < address < 2**63 else shown(address),
    }


def unrecorded(where: Mapping[str, Any]) -> Refused:
    """A refusal of one command, or of a batch."""
    detail = "the audit log can't be written, and no write is carried out without a record"
    return Refused("unrecorded", detail, **where)


def malformed(index: int | None, detail: str) -> Refused:
    """A refusal of a command whose target could not be parsed."""
    where = {} if index is None else {"command": index}
    return Refused("malformed", f"{_prefix(index)}{detail}", **where)


def refusal(reason: str, detail: str, place: Place, **more: Any) -> Refused:
    """A refusal of a command, sent alone or in a batch. `more` is what else says where."""
    return Refused(reason, f"{_prefix(place[0])}{detail}", **more, **place_of(*place))


def shown(value: object) -> str:
    """Formats an untrusted value for logs: as JSON, cut to a limited length."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "an array"
    text = msgspec.json.encode(value, enc_hook=repr).decode()
    return clip(text, MAX_SHOWN)
