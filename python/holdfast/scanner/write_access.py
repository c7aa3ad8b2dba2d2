"""What callers may write, in words for the log: by default, every NATS client may.

Does no I/O.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.scanning import written_pollable

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.scanning import Writes
    from holdfast.net.allow_list import AllowEntry
    from holdfast.scanner.messages.dialect import Dialect

TAGS: dict[Writes, str] = {
    "tags": 'every subscribed coil and holding register without "writable": false',
    "explicit": 'subscribed coils and holding registers with "writable": true',
    "none": "none: all commands are refused",
}

NARROWER: dict[Writes, str] = {
    "tags": "nats.writes (--writes): explicit or none",
    "explicit": "nats.writes (--writes): none",
}
"""What else each setting could be that allows less."""


def described(
    writes: Writes, allow: Iterable[AllowEntry], prefix: str, dialect: Dialect
) -> dict[str, str]:
    """Returns which tags may be written, at which addresses, by whom, and what narrows it."""
    if writes == "none":
        return {"tags": TAGS[writes], "set_by": "nats.writes (--writes): none"}
    subjects = ", ".join(f"{prefix}.{each}" for each in ("subscribe", *dialect.command_subjects))
    return {
        "tags": TAGS[writes],
        "devices": places(allow),
        "by": f"every NATS client that may publish to {subjects}",
        "narrowed_by": f"{NARROWER[writes]}; nats.devices (--allow); permissions in NATS",
    }


def places(allow: Iterable[AllowEntry]) -> str:
    """Where devices may be."""
    return ", ".join(map(written_pollable, allow)) or "at private and loopback addresses"
