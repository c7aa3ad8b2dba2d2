"""What the programs of one generation send and expect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from holdfast.config import scanning
    from holdfast.scanner.messages.types import TagRequest, UnsubscribeRequest
    from holdfast.types import Area


Normalize: TypeAlias = "Callable[[dict[str, Any]], dict[str, Any]]"
"""Returns the JSON object of a request with other keys. It may change the one that it gets."""


class Dialect(Protocol):
    """The rules of one generation of programs. They do no I/O, and have no state."""

    name: scanning.Dialect
    command_subjects: tuple[str, ...]
    """The subjects of commands, after the prefix."""
    byte_orders: Mapping[tuple[str, str], str]
    """The byte order that a type is read with, where that of its request means another one."""
    has_exact_pauses: bool
    """Whether a device is connected to again after the pauses of `tentacle`, without jitter."""
    replaces_subscription: bool
    """Whether a subscribe request is the whole subscription: it ends that of all other tags."""
    normalize: Normalize | None
    """What makes the keys of a `SubscribeRequest` from those that its programs send, if needed."""
    last_definition_counts: bool
    """Whether a request may define a tag twice, and means the last definition then."""
    repeats_values: bool
    """Whether the next values of all tags of a subscribe request are published, as for new tags."""

    def device_names(self, device: str) -> tuple[str, ...]:
        """Returns the names of a device in the subjects of its messages."""

    def tag_name(self, tag: str) -> str:
        """Returns the name of a tag in subjects, by which commands may call it too."""

    def data_subject(self, prefix: str, device: str, tag: str, /) -> str:
        """Returns the subject of a tag's values."""

    def check_unsubscribe(self, request: UnsubscribeRequest) -> None:
        """Raises `Refused` for a request that may mean something else than it says."""

    def check_tag_ids(self, known: Iterable[str], new: Iterable[str]) -> None:
        """Checks the ids of the tags of a device. Raises `Refused`."""

    def byte_order_notes(self, request: TagRequest, area: Area, order: str, /) -> Iterable[str]:
        """Yields what the caller must know of a tag that is read as its request says."""

    def command_text(self, data: bytes) -> str:
        """Returns the value of a command as text. Raises `Refused`."""
