"""The dialect of tentacle-modbus and its callers, the first generation. Does no I/O.

Its callers must get the values that they got from tentacle-modbus, or a warning.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.protocol import WRITE_LIMITS
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.subject_parts import second_id, subject_id
from holdfast.values.orders import SWAPPED_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from holdfast.scanner.messages.decoding import Normalize
    from holdfast.scanner.messages.types import TagRequest, UnsubscribeRequest
    from holdfast.types import Area

BYTE_ORDERS = {("float64", "CDAB"): "CDABGHEF"}
"""The four letters mislead: tentacle-modbus swaps the words of each half."""


def utf8_text(data: bytes) -> str:
    """Returns the payload of a command as text. Raises `Refused`."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise Refused("the value is not UTF-8 text") from None


class Tentacle:
    """What programs of the first generation send and expect."""

    command_subjects: tuple[str, ...] = ("command.>",)
    """The subjects of commands, after the prefix."""
    byte_orders: Mapping[tuple[str, str], str] = BYTE_ORDERS
    """The byte order that a type is read with, where that of its request means another one."""
    reconnect_pauses_s: tuple[float, float] | None = (2.0, 60.0)
    """The first and the longest pause before a device is connected to again, without jitter. They
    double in between. `None`: those of the core, with jitter (`crates/runtime/src/backoff.rs`)."""
    replaces_subscription = False
    """Whether a subscribe request is the whole subscription: it ends that of all other tags."""
    normalize: Normalize | None = None
    """What makes the keys of a `SubscribeRequest` from those that its programs send, if needed."""
    last_definition_counts = True
    """Whether a request may define a tag twice, and means the last definition then."""
    repeats_values = False
    """Whether the next values of all tags of a subscribe request are published, as for new tags."""

    def device_names(self, device: str) -> tuple[str, ...]:
        """Returns the names of a device in subjects.

        One, or two: some callers listen where tentacle-modbus published.
        """
        return tuple(filter(None, (subject_id(device), second_id(device))))

    def tag_name(self, tag: str) -> str:
        """Returns the name of a tag in subjects, by which commands may call it too.

        It is the id: tags have no part in subjects here.
        """
        return tag

    def data_subject(self, prefix: str, device: str, _tag: str, /) -> str:
        """Returns the subject of a tag's values. All tags of a device share it."""
        return f"{prefix}.data.{subject_id(device)}"

    def second_data_subject(self, prefix: str, device: str, /) -> str | None:
        """Returns the subject under which all values of a device are published again, if any."""
        name = second_id(device)
        return None if name is None else f"{prefix}.data.{name}"

    def status_subjects(self, prefix: str, device: str) -> tuple[str, ...]:
        """Returns the subjects under each of which the state of a device is published."""
        return tuple(f"{prefix}.status.{name}" for name in self.device_names(device))

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
        if datatype in ("int16", "uint16") and order in SWAPPED_BYTES and is_written:
            yield (
                f"{order} swaps the bytes of the {datatype} in reads and in writes; "
                "tentacle-modbus swaps them in reads only: a program that swaps the bytes of its "
                "commands itself must not do so any more"
            )

    def command_text(self, data: bytes) -> str:
        """Returns the payload, which is the value as text. Raises `Refused`."""
        return utf8_text(data)
