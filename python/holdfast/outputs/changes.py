"""What an output publishes: everything, or what has changed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from holdfast.tags.deadband import differs

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.polling import Reading


class Changes:
    """Selects the readings that are published.

    With `change`, a value is published if it differs from the last one by more than the deadband of
    its tag, if it appears or disappears, and after `heartbeat` seconds in any case.
    """

    def __init__(self, publish: Literal["change", "scan"], heartbeat: float | None) -> None:
        self._every = publish == "scan"
        self._heartbeat = heartbeat
        self._last: dict[tuple[str, str], tuple[Any, float]] = {}

    def of(self, readings: Iterable[Reading]) -> list[Reading]:
        """The readings that are published."""
        if self._every:
            return list(readings)
        return [reading for reading in readings if self._accept(reading)]

    def _accept(self, reading: Reading) -> bool:
        """Whether a reading is published; if so, keeps it as the last one of its tag."""
        device, tag, value, time, _, _ = reading
        key = (device, tag.name)
        known = self._last.get(key)
        if known is not None:
            before, at = known
            # 0 <=: also published after the clock was set back.
            silent = self._heartbeat is None or 0 <= time - at < self._heartbeat
            if silent and not differs(value, before, tag.deadband):
                return False
        self._last[key] = (value, time)
        return True

    def forget(self, devices: Iterable[str]) -> None:
        """Forgets the last values of these devices, so that their next readings are published."""
        forgotten = set(devices)
        self._last = {key: last for key, last in self._last.items() if key[0] not in forgotten}

    def forget_tags(self, tags: Iterable[tuple[str, str]]) -> None:
        """Does the same for single tags of devices."""
        for key in tags:
            self._last.pop(key, None)
