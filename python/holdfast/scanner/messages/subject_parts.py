"""Device ids as parts of NATS subjects. Does no I/O.

A device id may have blanks and dots, a part of a subject may not. Callers of tentacle-modbus
replace only the characters that NATS does not allow, and listen there. So the data of a device is
published under both names if they differ.

Programs of tentacle-next replace other characters, and listen to one subject for each tag. Whole
subjects are made by `data_subject` of each dialect.
"""

from __future__ import annotations

import re

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")
_UNUSABLE = re.compile(r"[ .*>]")
_REPLACED_BY_NEXT = re.compile(r"[ .:*>;=]")


def subject_id(device: str) -> str:
    """Returns the part of subjects that stands for a device."""
    return _UNSAFE.sub("_", device)


def second_id(device: str) -> str | None:
    """Returns the second name of a device in subjects, if it has one.

    It keeps every character that a subject may contain. `device` must be printable.
    """
    kept = _UNUSABLE.sub("_", device)
    return kept if kept != subject_id(device) else None


def next_name(id: str) -> str:
    """Returns the part of subjects that stands for a device or tag in tentacle-next.

    `id` must be printable.
    """
    return _REPLACED_BY_NEXT.sub("_", id)
