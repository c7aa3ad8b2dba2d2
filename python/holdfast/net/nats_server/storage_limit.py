"""How much a NATS server may store, and whether its disk has room."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

SHARE_OF_FREE_SPACE = 0.75
"""How much of the free space of its disk the server may use: the default of nats-server. The rest
is a reserve, from which a server that is full gets room for a snapshot."""

MIN_GROWTH = 1.1
"""A server that is full is restarted if it may then store so much more."""

ROOM_BYTES = 2**20
"""What a disk takes that is not full: the largest message of nats-server."""


def possible_limit(store: Path) -> int:
    """How many bytes a server with this store may have there.

    The default of nats-server is a share of the free space alone: each start would allow less.
    """
    stored = 0
    for folder, _, files in os.walk(store):
        for file in files:
            with suppress(FileNotFoundError):
                stored += Path(folder, file).stat().st_size
    # The server makes the store at its first start.
    free = shutil.disk_usage(store.parent).free
    return max(stored + int(free * SHARE_OF_FREE_SPACE), ROOM_BYTES)


def may_grow(store: Path, limit: int) -> bool:
    """Whether a server with this limit may store clearly more if it is configured anew."""
    return possible_limit(store) >= limit * MIN_GROWTH


def has_room(folder: Path) -> bool:
    """Whether the disk of a folder takes writes."""
    file = folder / "room"
    try:
        try:
            file.write_bytes(bytes(ROOM_BYTES))
        finally:
            file.unlink(missing_ok=True)
    except OSError:
        return False
    return True
