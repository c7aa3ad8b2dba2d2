"""Gives clients in forked children connections of their own.

A child has copies of all connections, but not the threads that use them. Parent and child would get
each other's replies on one connection.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from holdfast._core import BlockingClient

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast._core import Endpoint
    from holdfast.client.base import Trace

_owners: WeakKeyDictionary[object, Callable[[Any], None]] = WeakKeyDictionary()


def renew_in_children(owner: object, renew: Callable[[Any], None]) -> None:
    """Calls `renew` with the owner of a connection in each child that this process forks."""
    _owners[owner] = renew


class BlockingConnection:
    """The connection of a `SyncClient` and of its copies. They go through this object, because they
    may be made without a constructor, or compare equal.
    """

    def __init__(self, endpoint: Endpoint, trace: Trace | None) -> None:
        self._endpoint = endpoint
        self._trace = trace
        self._connect_anew()
        renew_in_children(self, BlockingConnection._connect_anew)

    def _connect_anew(self) -> None:
        self._core = core = BlockingClient(self._endpoint, self._trace)
        self.call, self.close = core.call, core.close  # Methods would slow each call down.

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""
        return self._core.late

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""
        return self._core.longest_late


def _renew() -> None:
    for owner, renew in list(_owners.items()):
        renew(owner)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
