"""What subscribers change before their stored subscriptions are read.

Without JetStream, these are never read. So the requests are not kept here: the registry has what
they add.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from holdfast.scanner.messages.types import UnsubscribeRequest
    from holdfast.scanner.subscriptions.key import SubscriptionKey

MAX_CHANGED = 10_000
"""Limit of subscriptions whose changes are remembered. Those of further ones are forgotten."""

MAX_REMOVED_IDS = 100_000
"""Limit of remembered ids of tags that they have removed, all together."""


@dataclass(slots=True)
class Changes:
    """Those of one subscription."""

    replaces: bool = False
    """Whether nothing of the stored subscription is left."""
    removed: set[str] = field(default_factory=set)
    """The ids of removed tags."""
    given: set[str] = field(default_factory=set)
    """The `SETTINGS` that its requests contain."""


class ChangesBeforeRead:
    """The changes of all subscriptions."""

    def __init__(self) -> None:
        self._changes: dict[SubscriptionKey, Changes] = {}
        self._removed_ids = 0

    def of(self, owner: SubscriptionKey) -> Changes:
        """The remembered changes of a subscription."""
        return self._changes.get(owner) or Changes()

    def are_forgotten(self, owner: SubscriptionKey) -> bool:
        """Whether a subscription may have changes that are not remembered."""
        return owner not in self._changes and len(self._changes) >= MAX_CHANGED

    def requested(
        self, owner: SubscriptionKey, given: Collection[str], *, replaces: bool = False
    ) -> None:
        """Remembers what a request changes besides tags: it sets `given`, or `replaces` all."""
        if (given or replaces) and not self.are_forgotten(owner):
            changes = self._changes.setdefault(owner, Changes())
            changes.given.update(given)
            changes.replaces |= replaces

    def removed(self, owner: SubscriptionKey, ids: Collection[str] | None) -> None:
        """Remembers that tags are removed; all, if `ids` is `None`."""
        if self.are_forgotten(owner):
            return
        changes = self._changes.setdefault(owner, Changes())
        if ids is None:
            changes.replaces = True
        else:
            new = set(ids) - changes.removed
            changes.removed.update(islice(new, MAX_REMOVED_IDS - self._removed_ids))
            self._removed_ids = min(self._removed_ids + len(new), MAX_REMOVED_IDS)

    def removals(self) -> Iterator[UnsubscribeRequest]:
        """Yields what they remove from stored subscriptions."""
        for owner, changes in self._changes.items():
            if changes.replaces or changes.removed:
                yield owner.removal(None if changes.replaces else list(changes.removed))

    def clear(self) -> None:
        """Forgets all: they are applied."""
        self._changes.clear()
        self._removed_ids = 0
