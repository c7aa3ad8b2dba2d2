"""The file of the audit log: rotation, full disks, and what others do to it."""

from __future__ import annotations

import itertools
import json
import os
import stat
import threading
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from holdfast.events import log_lines as logs
from holdfast.events.audit import Audit, verify
from holdfast.events.throttle import Throttle
from support import wire
from support.audits import full
from support.renaming import not_renamed

if TYPE_CHECKING:
    from pathlib import Path

SIZE = 65536


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "audit.log"


def opened(log: Path, keep: int = 2) -> Audit:
    return Audit(log, max_bytes=SIZE, keep=keep)


def files(log: Path) -> list[Path]:
    """The files of a log, the oldest first."""
    return sorted(log.parent.glob(f"{log.name}*"), reverse=True)


def lines(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()]


def numbers(*logs: Path) -> list[int]:
    """The numbers that tests have written."""
    return [line["number"] for log in logs for line in lines(log) if "number" in line]


def reasons(*logs: Path) -> list[str]:
    """Why the chain breaks."""
    return [line["reason"] for log in logs for line in lines(log) if line.get("event") == "chain"]


def write(log: Path, *written: int) -> None:
    audit = opened(log)
    audit.write_all([{"number": number} for number in written])
    audit.close()


def is_chained(*logs: Path) -> bool:
    """Whether each line names the digest of the line before, as the documentation says."""
    whole = [line for log in logs for line in log.read_bytes().splitlines(keepends=True)]
    return all(
        json.loads(line)["prev"] == sha256(before).hexdigest()
        for before, line in itertools.pairwise(whole)
    )


# Rotation


def test_a_large_file_is_put_aside_and_no_line_is_lost(log: Path) -> None:
    audit = opened(log)
    for number in range(1000):
        audit.write(number=number)
    audit.close()
    assert [file.name for file in files(log)] == ["audit.log.2", "audit.log.1", "audit.log"]
    assert numbers(*files(log)) == list(range(1000))
    assert all(file.stat().st_size <= SIZE for file in files(log))


def test_the_chain_goes_on_over_rotation_and_restarts(log: Path) -> None:
    for begin in range(0, 1000, 250):
        write(log, *range(begin, begin + 250))
    assert len(files(log)) == 3
    assert is_chained(*files(log))
    assert [line["seq"] for file in files(log) for line in lines(file)] == list(range(1, 1002))
    assert reasons(*files(log)) == ["new"]
    first = lines(files(log)[0])[0]
    assert (first["seq"], first["prev"]) == (1, None)


def test_files_beyond_the_number_to_keep_are_deleted(log: Path) -> None:
    write(log, *range(2000))
    assert len(files(log)) == 3
    assert numbers(*files(log))[-1] == 1999
    findings = verify(files(log))
    assert (findings.error, findings.gaps) == (None, False)
    assert findings.first is not None


def test_a_file_can_be_put_aside_on_request(log: Path) -> None:
    audit = opened(log)
    audit.rotate()
    audit.write(number=1)
    audit.rotate()
    audit.rotate()
    audit.write(number=2)
    audit.close()
    assert [numbers(file) for file in files(log)] == [[1], [2]]
    assert is_chained(*files(log))


def test_a_file_that_can_not_be_renamed_goes_on(
    log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (log.parent / "audit.log.1" / "in the way").mkdir(parents=True)
    audit = opened(log, keep=1)
    audit.write_all([{"number": number} for number in range(1000)])
    audit.close()
    assert audit.counts()["lines"] == 1000
    assert "audit_not_rotated" in caplog.messages
    assert numbers(log) == list(range(1000))
    assert is_chained(log)


def test_a_file_that_can_not_be_renamed_costs_no_older_file(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = opened(log)
    numbered = iter(range(10_000))
    while len(files(log)) < 3:
        audit.write(number=next(numbered))
    allow = not_renamed(monkeypatch, log)
    for _ in range(1000):
        audit.write(number=next(numbered))
    assert len(files(log)) == 3
    assert log.stat().st_size > SIZE
    allow()
    audit.rotate()
    audit.write(number=next(numbered))
    audit.close()
    assert log.stat().st_size < SIZE
    written = numbers(*files(log))
    assert written == list(range(written[0], next(numbered)))
    assert verify(files(log)).error is None


def test_a_chain_goes_on_after_a_crash_amid_rotation(log: Path) -> None:
    write(log, 1)
    log.rename(log.with_name("audit.log.0"))
    write(log, 2)
    assert [file.name for file in files(log)] == ["audit.log.1", "audit.log"]
    assert is_chained(*files(log))


# Others


@pytest.mark.parametrize("reopens", [False, True])
def test_a_file_that_was_renamed_by_others_is_created_anew(log: Path, *, reopens: bool) -> None:
    audit = opened(log)
    audit.write(number=1)
    aside = log.rename(log.with_name("audit-2026-11-22.log"))
    if reopens:
        audit.reopen()
        assert log.exists()
    audit.write(number=2)
    audit.close()
    assert numbers(log) == [2]
    assert stat.S_IMODE(log.stat().st_mode) & ~0o640 == 0
    assert is_chained(aside, log)
    assert reasons(log) == []


def test_a_file_that_others_put_back_says_so(log: Path) -> None:
    audit = opened(log)
    audit.write(number=1)
    aside = log.rename(log.with_name("aside.log"))
    audit.write(number=2)
    other = log.rename(log.with_name("other.log"))
    aside.rename(log)
    audit.write(number=3)
    audit.close()
    assert (numbers(log), reasons(log), numbers(other)) == ([1, 3], ["new", "changed"], [2])
    for file in (log, other):
        assert verify([file]).error is None
    assert verify([log]).breaks == {"changed": 1}


def test_a_file_that_was_out_of_reach_goes_on(log: Path) -> None:
    audit = opened(log)
    audit.write(number=1)
    folder = log.parent.rename(log.parent.with_name("unmounted"))
    audit.write(number=2)
    folder.rename(log.parent)
    audit.write(number=3)
    audit.close()
    assert (numbers(log), reasons(log)) == ([1, 3], ["new"])
    assert verify([log]).lost == 1


def test_a_deleted_file_begins_with_a_line_that_says_so(log: Path) -> None:
    audit = opened(log)
    audit.write(number=1)
    last = sha256(log.read_bytes().splitlines(keepends=True)[-1]).hexdigest()
    log.unlink()
    audit.write(number=2)
    audit.close()
    begin, line = lines(log)
    assert (begin["event"], begin["reason"], begin["prev"]) == ("chain", "deleted", last)
    assert line["number"] == 2
    assert verify([log]).breaks == {"deleted": 1}


@pytest.mark.parametrize(("is_copied", "reason"), [(False, "deleted"), (True, "changed")])
def test_a_file_that_another_one_replaces_says_whether_it_still_exists(
    log: Path, *, is_copied: bool, reason: str
) -> None:
    audit = opened(log)
    audit.write(number=1)
    earlier = log.with_name("earlier.log")
    earlier.write_bytes(log.read_bytes())
    audit.write(number=2)
    if is_copied:
        log.write_bytes(earlier.read_bytes())
    else:
        earlier.replace(log)
    audit.write(number=3)
    audit.close()
    assert (numbers(log), reasons(log)) == ([1, 3], ["new", reason])
    found = verify([log])
    assert (found.error, found.breaks) == (None, {reason: 1})


@pytest.mark.parametrize("content", [b"", b"else\n", b'{"half'])
def test_a_file_whose_size_others_change_says_so(log: Path, content: bytes) -> None:
    audit = opened(log)
    audit.write(number=1)
    log.write_bytes(content)
    audit.write(number=2)
    audit.close()
    ours = log.read_bytes().removeprefix(content).lstrip().splitlines()
    begin, line = map(json.loads, ours)
    assert (begin["reason"], begin["seq"], line["number"]) == ("changed", 3, 2)


@pytest.mark.parametrize("content", [b"", None])
def test_a_file_that_is_missing_at_the_start_is_reported(log: Path, content: bytes | None) -> None:
    audit = opened(log)
    audit.write(number=1)
    audit.rotate()
    audit.write(number=2)
    audit.close()
    log.unlink()
    if content is not None:
        log.write_bytes(content)
    write(log, 3)
    assert reasons(log) == ["missing"]
    assert is_chained(*files(log))
    assert verify(files(log)).breaks == {"missing": 1}


@pytest.mark.parametrize("cut", [1, 10, 40])
def test_a_line_that_a_crash_has_torn_is_ended_and_reported(log: Path, cut: int) -> None:
    write(log, 1, 2)
    log.write_bytes(log.read_bytes()[:-cut])
    write(log, 3)
    *whole, torn, begin, line = log.read_bytes().splitlines(keepends=True)
    assert len(whole) == 2
    assert json.loads(begin)["reason"] == "torn"
    assert json.loads(begin)["prev"] == sha256(torn).hexdigest()
    assert (json.loads(begin)["seq"], json.loads(line)["seq"]) == (4, 5)
    findings = verify([log])
    assert (findings.error, findings.breaks) == (None, {"torn": 1})


def test_a_torn_line_does_not_begin_the_next_file(log: Path) -> None:
    write(log, *range(100))
    log.write_bytes(log.read_bytes()[:-3])
    audit = Audit(log, max_bytes=1, keep=2)
    audit.write(number=100)
    audit.close()
    assert verify(files(log)).error is None
    assert verify(files(log)).breaks == {"torn": 1}
    assert log.read_bytes().startswith(b"{")


def test_a_log_without_a_chain_is_continued_with_one(log: Path) -> None:
    log.write_text('{"time":"2026-11-21T08:31:10.482Z","outcome":"done"}\n' * 2)
    write(log, 1)
    assert reasons(log) == ["unchained"]
    findings = verify([log])
    assert (findings.error, findings.unchained, findings.breaks) == (None, 2, {"unchained": 1})


def test_lines_after_the_end_are_lost_and_open_no_file(log: Path) -> None:
    audit = opened(log)
    audit.close()
    log.unlink()
    audit.write(number=1)
    audit.rotate()
    audit.reopen()
    assert not log.exists()
    assert audit.counts()["failed"] == 1


def test_threads_write_one_chain(log: Path) -> None:
    audit = opened(log, keep=100)
    together = threading.Barrier(4)

    def written() -> None:
        together.wait(wire.DEADLINE)
        for number in range(500):
            audit.write(number=number)
            if number % 100 == 0:
                audit.rotate()

    threads = [threading.Thread(target=written) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    audit.close()
    findings = verify(files(log))
    assert (findings.error, findings.gaps, findings.lines) == (None, False, 2001)


def test_two_processes_can_not_write_one_file(log: Path) -> None:
    audit = opened(log)
    with pytest.raises(OSError, match="another process writes this audit log"):
        opened(log)
    audit.close()
    opened(log).close()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_without_a_reader_does_not_hold_up_the_start(log: Path) -> None:
    os.mkfifo(log)
    with pytest.raises(OSError, match="it is a named pipe, allowed: a regular file"):
        opened(log)


# Full disks


def test_lines_that_could_not_be_written_are_counted_and_leave_a_mark(
    log: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "_REFUSALS", Throttle())
    audit = opened(log)
    audit.write(number=1)
    caplog.set_level("INFO")
    make_room = full(monkeypatch)
    audit.write_all([{"number": 2}, {"number": 3}])
    audit.write(number=4)
    assert numbers(log) == [1]
    assert audit.failing
    make_room()
    audit.write(number=5)
    audit.write(number=6)
    assert not audit.failing
    audit.close()
    counts = audit.counts()
    assert (counts["lines"], counts["failed"]) == (3, 3)
    assert caplog.messages == ["audit_failed", "audit_back"]
    said = [line.get("number") or line.get("lost") for line in lines(log)[1:]]
    assert said == [1, 3, 5, 6]
    assert is_chained(log)
    assert verify([log]).lost == 3


def test_a_disk_that_is_full_at_the_start_does_not_keep_the_log_from_opening(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_room = full(monkeypatch, room=0)
    audit = opened(log)
    audit.write(number=1)
    make_room()
    audit.write(number=2)
    audit.close()
    assert [line.get("lost") for line in lines(log)] == [None, 1, None]
    assert verify([log]).error is None


def test_a_torn_line_is_ended_also_when_the_disk_was_full_first(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(log, 1)
    log.write_bytes(log.read_bytes()[:-1])
    make_room = full(monkeypatch, room=1)
    audit = opened(log)
    audit.write(number=2)
    make_room()
    audit.write(number=3)
    audit.close()
    findings = verify([log])
    assert (findings.error, findings.breaks, findings.lost) == (None, {"torn": 1}, 1)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("plain \u00e4\u20ac", "plain \u00e4\u20ac"),
        ("\x7f\x9b", "\\u007f\\u009b"),
        ("a\u202eb\u200b\u2028", "a\\u202eb\\u200b\\u2028"),
        ("\U000e0001", "\\udb40\\udc01"),
    ],
    ids=["visible", "control", "format", "tag"],
)
def test_invisible_characters_are_escaped(log: Path, text: str, written: str) -> None:
    audit = opened(log)
    audit.write(subject=text)
    audit.write_group(
        audit.queue([msgspec.Raw(json.dumps({"source": text}, ensure_ascii=False).encode())])
    )
    audit.close()
    *_, subject, source = log.read_text(encoding="utf-8").splitlines()
    assert subject.endswith(f'"subject":"{written}"}}')
    assert source.endswith(f'"source": "{written}"}}')
    assert json.loads(subject)["subject"] == json.loads(source)["source"] == text
    assert verify([log]).error is None
