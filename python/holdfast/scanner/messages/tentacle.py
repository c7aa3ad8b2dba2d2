"""The dialect of tentacle-modbus and its callers, the first generation. Does no I/O.

Its callers must get the values that they got from tentacle-modbus, or a warning.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.protocol import WRITE_LIMITS
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.subjects import second_id, subject_id

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from holdfast.config import scanning
    from holdfast.scanner.messages.dialect import Normalize
    from holdfast.scanner.messages.types import TagRequest, UnsubscribeRequest
    from holdfast.types import Area

PAUSES_S = (2.0, 60.0)
"""The first and the longest pause before a device is connected to again. They double in between."""

BYTE_ORDERS = {("float64", "CDAB"): "CDABGHEF"}
"""The four letters mislead: tentacle-modbus swaps the words of each half."""

SWAPPED = ("BADC", "DCBA")
"""The orders that swap the bytes of a single register."""


class Tentacle:
    """What programs of the first generation send and expect, see `Dialect`."""

    name: scanning.Dialect = "tentacle"
    command_subjects: tuple[str, ...] = ("command.>",)
    byte_orders: Mapping[tuple[str, str], str] = BYTE_ORDERS
    has_exact_pauses = True
    replaces_subscription = False
    normalize: Normalize | None = None
    last_definition_counts = True
    repeats_values = False

    def device_names(self, device: str) -> tuple[str, ...]:
        """Returns one name, or two: some callers listen where tentacle-modbus published."""
        return tuple(filter(None, (subject_id(device), second_id(device))))

    def tag_name(self, tag: str) -> str:
        """Returns the id: tags have no part in subjects, and commands call them by their id."""
        return tag

    def data_subject(self, prefix: str, device: str, _tag: str, /) -> str:
        """Returns the subject that all tags of a device share."""
        return f"{prefix}.data.{subject_id(device)}"

    def check_unsubscribe(self, request: UnsubscribeRequest) -> None:
        """Raises `Refused` for a request that may have lost its tags, and would end everything."""
        if request.tag_ids is None:
            raise Refused('tagIds is missing, allowed: a list of tag ids, or "all"')

    def check_tag_ids(self, known: Iterable[str], new: Iterable[str]) -> None:
        """Allows all ids: they are in payloads only."""

    def byte_order_notes(self, request: TagRequest, area: Area, order: str, /) -> Iterator[str]:
        """Yields where tentacle-modbus reads or writes other bytes than other programs do."""
        datatype = request.datatype
        if (used := self.byte_orders.get((datatype, order), order)) != order:
            yield (
                f"{order} of a float64 is read and written as {used}, as tentacle-modbus does; "
                f"write {used}, or the order that you mean, with eight letters"
            )
        is_written = area in WRITE_LIMITS and request.writable is not False
        if datatype in ("int16", "uint16") and order in SWAPPED and is_written:
            yield (
                f"{order} swaps the bytes of the {datatype} in reads and in writes; "
                "tentacle-modbus swaps them in reads only: a program that swaps the bytes of its "
                "commands itself must not do so any more"
            )

    def command_text(self, data: bytes) -> str:
        """Returns the payload, which is the value as text. Raises `Refused`."""
        try:
            return data.decode()
        except UnicodeDecodeError:
            raise Refused("the value is not UTF-8 text") from None
