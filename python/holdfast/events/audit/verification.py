"""Verifies the chain of an audit log over its files.

The digests prove that lines are unchanged, complete and in order from the first line to the last.
They prove nothing about lines before the first or after the last one, and nothing against somebody
who has written the whole chain anew: against both, keep digests elsewhere (`anchors`).
"""

from __future__ import annotations

import errno
import itertools
import re
import stat
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from holdfast.events.audit.chain import Place, digest_of, is_record, place_of
from holdfast.events.audit.file import MAX_LINE_BYTES, last_lines

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path


RECORD_START = b'{"time":"'
PREV = re.compile(rb'{"time":"[^"]*","seq":[0-9]+,"prev":"([0-9a-f]{64})"')
"""The beginning of a line with the digest of the line before."""
GZIP_START = b"\x1f\x8b"


class Line(NamedTuple):
    """A line of a file, with its place in the chain if it names one."""

    file: Path
    number: int
    data: bytes
    place: Place | None

    @property
    def seq(self) -> int:
        """Its number in the chain; 0 if it has none."""
        return 0 if self.place is None else self.place.seq

    @property
    def digest(self) -> str:
        """The digest that the next line names. A line without an end is given one later."""
        return digest_of(self.data if self.data.endswith(b"\n") else self.data + b"\n")

    def says(self, *reasons: str) -> bool:
        """Whether it says that the chain breaks before it for one of these reasons."""
        return self.place is not None and self.place.broken in reasons

    def __str__(self) -> str:
        return f"{self.file}:{self.number}"


@dataclass
class Findings:
    """What is found in files."""

    files: list[Path]
    """The files, in the order of the chain."""
    lines: int = 0
    error: str | None = None
    """The first change, with file and line; `None` if the chain is whole."""
    lost: int = 0
    """Lines that could not be written, as the log itself says."""
    breaks: Counter[str] = field(default_factory=Counter)
    """Why the chain breaks, as the log itself says, and how often."""
    unended: int = 0
    """Starts of the appliance that follow another start without a stop."""
    unchained: int = 0
    """Complete lines without a place in the chain, as those of an earlier version."""
    first: str | None = None
    """The digest that the first line names, of a line that is not in the files."""
    last: str | None = None
    """The digest of the last line, if the chain is whole."""
    missing_anchors: set[str] = field(default_factory=set)

    @property
    def gaps(self) -> bool:
        """Whether lines are missing, as the log itself says."""
        return bool(self.lost or self.breaks or self.unchained)


def verify(files: Iterable[Path], anchors: Iterable[str] = ()) -> Findings:
    """Verifies files in the order of their chain.

    Raises `OSError` if one can't be read or is not an audit log, or if all are empty. `anchors`:
    digests of lines, written down earlier. The lines must still be there.
    """
    files = list(files)
    for file in files:
        _require_log(file)
    findings = Findings(_in_order(files), missing_anchors=set(anchors))
    before: Line | None = None
    before_that: Line | None = None
    running = False
    for line, after in _with_next(_lines(findings.files)):
        findings.lines += 1
        findings.missing_anchors.discard(line.digest)
        findings.error = _error(findings, (before_that, before), line, after)
        if findings.error is not None:
            return findings
        if line.place is not None:
            running = _note(findings, line.place, running=running)
        elif after is not None and not after.says("torn"):
            findings.unchained += 1
        before, before_that = line, before
    if before is not None:
        findings.last = before.digest
        if not before.data.endswith(b"\n"):
            findings.breaks["torn"] += 1
        elif before.place is None:
            findings.unchained += 1
    else:
        raise OSError(errno.EINVAL, "empty: there is nothing to verify", str(findings.files[0]))
    return findings


def _require_log(file: Path) -> None:
    """Raises `OSError` for a file with lines, none of which is one of an audit log.

    Also for one that can't be read again and again; opening a pipe can wait forever.
    """
    mode = file.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        kind = "a pipe" if stat.S_ISFIFO(mode) else "a special file"
        raise OSError(errno.EINVAL, f"it is {kind}, allowed: a regular file", str(file))
    start = next(_lines([file]), None)
    # A record may be the first one, and incomplete.
    if start is None or start.data.startswith(RECORD_START) or any(map(_is_of_log, _lines([file]))):
        return
    reason = f"not an audit log: it begins with {start.data[:20].decode('latin-1')!a}"
    if start.data.startswith(GZIP_START):
        reason = "compressed: unpack it first"
    raise OSError(errno.EINVAL, reason, str(file))


def _is_of_log(line: Line) -> bool:
    return line.place is not None or is_record(line.data)


def _note(findings: Findings, place: Place, *, running: bool) -> bool:
    """Counts what a valid line says. Returns whether the appliance runs after it."""
    is_beginning = place.broken == "new" and findings.lines == 1
    if place.broken is not None and not is_beginning:
        findings.breaks[place.broken] += 1
    lost, event = place.fields.get("lost"), place.fields.get("event")
    findings.lost += lost if type(lost) is int else 0
    findings.unended += event == "start" and running
    return event == "start" or (running and event != "stop")


def _error(
    findings: Findings, earlier: tuple[Line | None, Line | None], line: Line, after: Line | None
) -> str | None:
    """What is wrong with a line, or with the two before it."""
    before_that, before = earlier
    if line.place is None:
        return _foreign(before, line, after)
    if before is None:
        findings.first = line.place.prev
        return None
    if line.says("torn"):
        return _torn(before_that, before, line, line.place)
    if line.place.prev == before.digest:
        expected = before.seq + 1
        return (
            None if line.seq == expected else f"{line}: changed: seq is {line.seq}, not {expected}"
        )
    if _may_lack_lines(before, line, line.place):
        return None
    if before_that is not None and line.place.prev == before_that.digest:
        return f"{before}: inserted"
    return _broken(findings.files, before, line, after)


def _may_lack_lines(before: Line, line: Line, place: Place) -> bool:
    """Whether a line reports that the line that it names is not there."""
    if place.broken in (None, "torn") or line.data == before.data:
        return False
    if place.broken in ("changed", "deleted"):
        return place.seq > before.seq + 1
    # Copies have the lines of a file that went missing, and lack a line without a place.
    return place.seq != before.seq + 1


def _torn(whole: Line | None, torn: Line, line: Line, place: Place) -> str | None:
    """What is wrong with the lines before one that reports a torn line.

    It names the torn line, and in `after` the whole one before that. In logs of earlier versions,
    only the torn line names that one, if it is long enough. Copies have the torn line whole, or
    lack it.
    """
    after = place.fields.get("after")
    last = whole if torn.place is None else torn
    if last is None:
        return None
    expected = (last.seq + 2,) if last is whole else (last.seq + 1, last.seq + 2)
    # Earlier versions begin anew if the torn line is the only one of its file.
    begins = place.seq == 1 and after is None
    if last.place is not None and place.seq not in expected and not begins:
        return f"{line}: deleted or moved before this line: seq is {place.seq}, after {last.seq}"
    if after is not None:
        is_first = whole is None and place.seq == last.seq + 1
        known = [each.digest for each in (whole, torn) if each is not None]
        return None if is_first or after in known else f"{last}: changed"
    named = PREV.match(torn.data) if place.prev == torn.digest else None
    is_tied = named is None or whole is None or named[1].decode() == whole.digest
    return None if is_tied else f"{whole}: changed"


def _foreign(before: Line | None, line: Line, after: Line | None) -> str | None:
    """What is wrong with a line that names no place in the chain.

    Allowed are an incomplete last line, an incomplete line before one that reports it, and lines
    from before the chain began.
    """
    begins = (before is None or before.place is None) and is_record(line.data)
    if after is None:
        right = begins or not line.data.endswith(b"\n")
    elif after.place is None:
        right = begins
    else:
        right = after.says("torn", "unchained") and after.place.prev == line.digest
    return None if right else f"{line}: changed, or inserted: it is not a record"


def _broken(files: Sequence[Path], before: Line, line: Line, after: Line | None) -> str:
    """Why a line does not continue the line before: looks for the line that does."""
    assert line.place is not None
    successor: Line | None = None
    predecessor_is_later = False
    for later in _after(files, line):
        if later.digest == line.place.prev:
            predecessor_is_later = True
        if successor is None and later.place is not None and later.place.prev == before.digest:
            successor = later
    if successor is not None:
        if predecessor_is_later:
            return f"{line}: reordered: the line that belongs here is {successor}"
        return f"{line}: inserted: the line that belongs here is {successor}"
    missing = line.seq - before.seq - 1
    if missing > 0:
        deleted = f"seq {before.seq + 1}" + (f" to {line.seq - 1}" if missing > 1 else "")
        return f"{line}: deleted before this line: {deleted}"
    if missing < 0:
        return f"{line}: inserted or reordered: seq is {line.seq}, after {before.seq}"
    continued = after is not None and after.place is not None and after.place.prev == line.digest
    return f"{before if continued or after is None else line}: changed"


def _lines(files: Iterable[Path]) -> Iterator[Line]:
    for file in files:
        with file.open("rb") as opened:
            read = partial(opened.readline, MAX_LINE_BYTES)
            try:
                for number, data in enumerate(iter(read, b""), 1):
                    yield Line(file, number, data, place_of(data))
            except OSError as error:
                error.filename = str(file)  # Only errors of opening have it.
                raise


def _with_next(lines: Iterable[Line]) -> Iterator[tuple[Line, Line | None]]:
    for line, after in itertools.pairwise(itertools.chain(lines, (None,))):
        assert line is not None, "only the last one is"
        yield line, after


def _after(files: Sequence[Path], line: Line) -> Iterator[Line]:
    """The lines after a line."""
    for later in _lines(files[files.index(line.file) :]):
        if later.file != line.file or later.number > line.number:
            yield later


def _in_order(files: Iterable[Path]) -> list[Path]:
    """Orders files by their chain: each after the one whose last line its first line names.

    Files that nothing links are ordered by the time of their first lines, then by their numbers.
    """
    ends: dict[str, Path] = {}
    begins: dict[Path, tuple[tuple[str, int], str | None]] = {}
    for file in dict.fromkeys(files):
        # The first line may be torn.
        place = next((line.place for line in _lines([file]) if line.place is not None), None)
        last = last_lines(file)
        first = ("", 0) if place is None else (str(place.fields.get("time", "")), place.seq)
        begins[file] = (first, None if place is None else place.prev)
        if last:
            ends[digest_of(last[-1])] = file
    followers = {ends[prev]: file for file, (_, prev) in begins.items() if prev in ends}
    heads = [file for file, (_, prev) in begins.items() if prev not in ends]
    ordered: list[Path] = []
    for head in sorted(heads, key=lambda file: begins[file][0]):
        follower: Path | None = head
        while follower is not None and follower not in ordered:
            ordered.append(follower)
            follower = followers.get(follower)
    return ordered + [file for file in begins if file not in ordered]
