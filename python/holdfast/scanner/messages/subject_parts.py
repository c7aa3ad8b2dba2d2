"""Device ids as parts of NATS subjects. Does no I/O.

A device id may have blanks and dots, a part of a subject may not. Callers of tentacle-modbus
replace only the characters that NATS does not allow, and subscribe to the subject with that name
(`second_id`). If the two names differ, the data is published under both.

Programs of tentacle-next replace other characters, and listen to one subject for each tag.

Whole subjects of values and states are made by each dialect, and keys of buckets by
`jetstream.entries`: nothing else joins these parts.
"""

from __future__ import annotations

import re

_REPLACED = re.compile(r"[^A-Za-z0-9_-]")
_REPLACED_BY_CALLERS = re.compile(r"[ .*>]")
_REPLACED_BY_NEXT = re.compile(r"[ .:*>;=]")


def subject_id(device: str) -> str:
    """Returns the part of subjects that stands for a device."""
    return _REPLACED.sub("_", device)


def second_id(device: str) -> str | None:
    """Returns the second name of a device in subjects, if it has one.

    It keeps every character that a subject may contain. `device` must be printable.
    """
    kept = _REPLACED_BY_CALLERS.sub("_", device)
    return kept if kept != subject_id(device) else None


def tentacle_next_name(id: str) -> str:
    """Returns the part of subjects that stands for a device or tag in tentacle-next.

    `id` must be printable.
    """
    return _REPLACED_BY_NEXT.sub("_", id)
