"""The chain of an audit log.

Each line is a JSON object that names its number in the chain (`seq`) and the digest of the line
before (`prev`): SHA-256 over all its bytes, with the line feed. `sed -n 1p FILE | sha256sum` prints
the `prev` of line 2. A chain goes on in the next file, and after a restart.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import msgspec

from holdfast.events.audit.escapes import escaped

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

BREAK = "chain"
"""The event of a line that says why the chain does not simply go on. Its `reason` is one of:
`new` (no line before is known), `missing` (the file was missing or empty at the start), `torn` (the
last line was incomplete; `after` is the digest of the line before that one), `unchained` (the last
line had no place in a chain), `deleted` (the file was deleted while it was written, also by
renaming another one into its place), `changed` (something else changed the size of the file, or
moved it away and put another one in its place)."""


encoded = msgspec.json.Encoder().encode
"""Returns the fields of a line as JSON."""


Record: TypeAlias = tuple[str, bytes]
"""What a line says: its time, and its other fields as JSON."""


def unchained(record: Record) -> bytes:
    """The line without a place in the chain: for copies of lines that the file lacks."""
    time, body = record
    return b'{"time":"%b","seq":null,"prev":null,%b\n' % (time.encode(), escaped(body)[1:])


class End(NamedTuple):
    """The end of a chain: number and digest of its last line, if there is one."""

    seq: int = 0
    digest: str | None = None


def chained(end: End, records: Iterable[Record]) -> tuple[list[bytes], list[str]]:
    """The lines that follow, each with its line feed and its digest."""
    lines, digests = [], []
    seq, digest = end
    for time, body in records:
        seq += 1
        prev = "null" if digest is None else f'"{digest}"'
        line = f'{{"time":"{time}","seq":{seq},"prev":{prev},'.encode() + escaped(body)[1:] + b"\n"
        digest = digest_of(line)
        lines.append(line)
        digests.append(digest)
    return lines, digests


def digest_of(line: bytes) -> str:
    """The digest of a line with its line feed."""
    return hashlib.sha256(line).hexdigest()


class Place(NamedTuple):
    """The place of a line in a chain, and why the chain breaks before it."""

    seq: int
    prev: str | None
    broken: str | None
    fields: Mapping[str, Any]


def place_of(line: bytes) -> Place | None:
    """The place that a line names; `None` if it is not a line of a chain."""
    fields = _fields(line)
    seq, prev = fields.get("seq"), fields.get("prev")
    if type(seq) is not int or not (prev is None or isinstance(prev, str)):
        return None
    broken = str(fields.get("reason")) if fields.get("event") == BREAK else None
    return Place(seq, prev, broken, fields)


def is_record(line: bytes) -> bool:
    """Whether a line can be one of an audit log, also of a version without a chain."""
    return isinstance(_fields(line).get("time"), str)


def _fields(line: bytes) -> dict[str, Any]:
    """The fields of a line; none if it is not a JSON object."""
    try:
        fields = msgspec.json.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) else {}
