"""The devices of the appliance, as one output may see them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.outputs.site import NotWritten

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from holdfast.appliance.tag_values import TagValues
    from holdfast.appliance.tag_writes import TagWrites
    from holdfast.polling import Reading
    from holdfast.tags import Tag


class OutputSite:
    """See `holdfast.outputs.site.Site`."""

    def __init__(
        self, output: str, only: Collection[str] | None, values: TagValues, writes: TagWrites
    ) -> None:
        self._output, self._only = output, only
        self._values, self._writes = values, writes

    @property
    def revision(self) -> int:
        """Changes with the tags of any device."""
        return self._values.revision

    @property
    def answers(self) -> int:
        """Changes when a device stops to answer, or answers again."""
        return self._values.answers

    def tags(self) -> dict[str, tuple[Tag, ...]]:
        """The tags of each device."""
        return self._values.tags(self._only)

    def answering(self) -> dict[str, bool]:
        """Whether each device answers, as far as it is known."""
        return self._values.answering(self._only)

    def latest(self) -> list[Reading]:
        """The last reading of each tag."""
        only = self._only
        return [
            reading for reading in self._values.latest() if only is None or reading.device in only
        ]

    def refresh(self) -> None:
        """Has the next value of each tag published, also if it is unchanged."""
        self._values.refresh(self._output)

    def write(
        self,
        device: str,
        tag: str,
        text: str,
        peer: str,
        done: Callable[[NotWritten | None], None],
    ) -> None:
        """Writes a value, as text. Raises `NotWritten` if nothing was sent."""
        if self._only is not None and device not in self._only:
            raise NotWritten("unknown_tag", "no such tag")
        self._writes.write(device, tag, text, f"output/{self._output}", peer, done)
