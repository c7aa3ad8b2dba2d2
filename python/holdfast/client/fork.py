"""Gives clients in forked children connections of their own.

A child has copies of all connections, but not the threads that use them. Parent and child would get
each other's replies on one connection.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from collections.abc import Callable

_owners: WeakKeyDictionary[object, Callable[[Any], None]] = WeakKeyDictionary()


def renew_in_children(owner: object, renew: Callable[[Any], None]) -> None:
    """Calls `renew` with the owner of a connection in each child that this process forks."""
    _owners[owner] = renew


def _renew() -> None:
    for owner, renew in list(_owners.items()):
        renew(owner)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
