"""What `verify` and `holdfast audit verify` find in files of an audit log."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from holdfast.cli import main
from holdfast.events import log_lines
from holdfast.events.audit import Audit, verify
from holdfast.events.audit.chain import digest_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from click.testing import Result


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of one file: a line that begins the chain, then nine others."""
    file = tmp_path / "audit.log"
    audit = Audit(file, max_bytes=65536, keep=1)
    audit.write_all([{"number": number} for number in range(2, 11)])
    audit.close()
    return file


def asked(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["audit", "verify", *map(str, arguments)])


def changed(lines: list[bytes], at: int, change: Callable[[bytes], bytes]) -> list[bytes]:
    return [*lines[:at], change(lines[at]), *lines[at + 1 :]]


def forged(line: bytes) -> bytes:
    return line.replace(b'"number":', b'"number":1')


def renumbered(line: bytes) -> bytes:
    return line.replace(b'"seq":5', b'"seq":6')


def unlinked(line: bytes) -> bytes:
    return line.replace(b'"prev":"', b'"prev":"0')


def spaced(line: bytes) -> bytes:
    return line[:-2] + b" }\n"


def garbled(_: bytes) -> bytes:
    return b"not a record\n"


CHANGES: dict[str, tuple[Callable[[list[bytes]], list[bytes]], str]] = {
    "a value is changed": (lambda x: changed(x, 4, forged), "5: changed"),
    "a number is changed": (lambda x: changed(x, 4, renumbered), "5: changed: seq is 6, not 5"),
    "a digest is changed": (lambda x: changed(x, 4, unlinked), "5: changed"),
    "a line is replaced": (lambda x: changed(x, 4, garbled), "5: changed, or inserted"),
    "two lines are replaced": (
        lambda x: changed(changed(x, 4, garbled), 5, garbled),
        "5: changed",
    ),
    "the first line is changed": (
        lambda x: changed(x, 0, spaced),
        "1: changed",
    ),
    "the last line but one is changed": (lambda x: changed(x, 8, forged), "9: changed"),
    "a line is deleted": (
        lambda x: x[:4] + x[5:],
        "5: deleted before this line: seq 5",
    ),
    "three lines are deleted": (
        lambda x: x[:4] + x[7:],
        "5: deleted before this line: seq 5 to 7",
    ),
    "a line is repeated": (lambda x: [*x[:6], x[2], *x[6:]], "7: inserted"),
    "a line is inserted": (lambda x: [*x[:6], garbled(b""), *x[6:]], "7: changed, or inserted"),
    "a chained line is inserted": (
        lambda x: [*x[:6], b'{"seq":7,"prev":"%b"}\n' % digest_of(x[5]).encode(), *x[6:]],
        "7: inserted",
    ),
    "two lines are exchanged": (lambda x: [*x[:4], x[5], x[4], *x[6:]], "5: reordered"),
    "a line is moved down": (lambda x: [*x[:3], *x[4:8], x[3], *x[8:]], "4: reordered"),
    "a line is moved up": (lambda x: [*x[:3], x[7], *x[3:7], *x[8:]], "4: reordered"),
}


@pytest.mark.parametrize(("change", "found"), CHANGES.values(), ids=CHANGES)
def test_the_first_change_is_found_with_its_place(
    log: Path, change: Callable[[list[bytes]], list[bytes]], found: str
) -> None:
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(change(lines)))
    error = verify([log]).error
    assert error is not None
    assert error.startswith(f"{log}:{found}")
    result = asked(log)
    assert result.exit_code == 1
    assert result.stdout.startswith(f"not intact: {log}:{found}")


@pytest.mark.parametrize("at", range(9))
def test_each_line_but_the_last_is_protected_by_the_next(log: Path, at: int) -> None:
    lines = log.read_bytes().splitlines(keepends=True)
    for byte in range(len(lines[at]) - 1):
        flipped = bytearray(lines[at])
        flipped[byte] ^= 1
        log.write_bytes(b"".join([*lines[:at], bytes(flipped), *lines[at + 1 :]]))
        assert verify([log]).error is not None


def test_an_untouched_log_is_intact(log: Path) -> None:
    result = asked(log)
    assert result.exit_code == 0
    lines = log.read_bytes().splitlines(keepends=True)
    assert result.stdout.splitlines() == [
        "intact",
        "verified: 10 lines in 1 file",
        f"digest of the last line: {digest_of(lines[-1])}",
    ]


def test_files_are_verified_in_the_order_of_their_chain(log: Path) -> None:
    audit = Audit(log, max_bytes=1, keep=20)
    audit.write_all([{"number": number} for number in range(11, 22)])
    audit.close()
    files = sorted(log.parent.iterdir())
    findings = verify(files)
    assert (findings.error, findings.gaps, findings.lines) == (None, False, 21)
    assert findings.files[0].name == "audit.log.11"
    assert findings.files[-1] == log
    (log.parent / "audit.log.3").unlink()
    findings = verify(file for file in files if file.exists())
    assert findings.error == (f"{log.parent}/audit.log.2:1: deleted before this line: seq 18")


def test_what_the_log_itself_reports_is_counted(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:-5])
    audit = Audit(log, max_bytes=65536, keep=1)
    audit.write(lost=17)
    audit.write(event="start")
    audit.write(event="start")
    audit.write(event="stop")
    audit.close()
    result = asked("--json", log)
    assert result.exit_code == 3
    told = json.loads(result.stdout)
    assert "reason" not in told
    assert (told["lost"], told["breaks"], told["starts_without_stop"]) == (17, {"torn": 1}, 1)
    assert "gap: 17 lines could not be written" in asked(log).stdout


def torn(log: Path, cut: int, *, named: bool = True) -> list[bytes]:
    """The lines of a log whose line 10 was torn, and continued after a start."""
    log.write_bytes(log.read_bytes()[:-cut])
    audit = Audit(log, max_bytes=65536, keep=1)
    audit.write(event="start")
    audit.close()
    lines = log.read_bytes().splitlines(keepends=True)
    if not named:  # As earlier versions did.
        fields = json.loads(lines[10])
        del fields["after"]
        lines[10] = json.dumps(fields, separators=(",", ":")).encode() + b"\n"
        start = json.loads(lines[11]) | {"prev": digest_of(lines[10])}
        lines[11] = json.dumps(start, separators=(",", ":")).encode() + b"\n"
        log.write_bytes(b"".join(lines))
    assert (verify([log]).error, verify([log]).breaks) == (None, {"torn": 1})
    return lines


@pytest.mark.parametrize(
    ("cut", "named"), [(1, True), (1, False), (10, True), (10, False), (80, True)]
)
def test_lines_before_a_torn_one_are_tied_to_those_after_it(
    log: Path, cut: int, named: bool
) -> None:
    lines = torn(log, cut, named=named)
    log.write_bytes(b"".join(changed(lines, 8, forged)))
    assert verify([log]).error == f"{log}:9: changed"
    log.write_bytes(b"".join([*lines[:7], *lines[9:]]))
    assert verify([log]).error is not None


def test_a_line_of_earlier_versions_that_was_torn_early_ties_only_by_number(log: Path) -> None:
    lines = torn(log, 80, named=False)
    log.write_bytes(b"".join(changed(lines, 8, forged)))
    assert verify([log]).error is None
    log.write_bytes(b"".join([*lines[:7], *lines[9:]]))
    error = f"{log}:9: deleted or moved before this line: seq is 11, after 7"
    assert verify([log]).error == error


@pytest.mark.parametrize("has_whole", [True, False])
def test_copies_may_have_the_torn_line_whole_or_lack_it(log: Path, has_whole: bool) -> None:
    last = log.read_bytes().splitlines(keepends=True)[-1]
    lines = torn(log, 10)
    copies = [*lines[:9], *([last] if has_whole else []), *lines[10:]]
    log.write_bytes(b"".join(copies))
    assert verify([log]).error is None
    log.write_bytes(b"".join(changed(copies, 8, forged)))
    assert verify([log]).error == f"{log}:{10 if has_whole else 9}: changed"


def test_a_file_that_begins_with_a_torn_line_is_tied_to_the_one_before(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = log.rename(log.with_name("audit.log.1"))
    time = json.loads(before.read_bytes().splitlines()[0])["time"]
    # Then their numbers tell the order.
    monkeypatch.setattr(log_lines, "timestamp", lambda _: time)
    audit = Audit(log, max_bytes=65536, keep=1)
    audit.close()
    log.write_bytes(b'{"time":"2026-')
    audit = Audit(log, max_bytes=65536, keep=1)
    audit.write(event="start")
    audit.close()
    assert (verify([before, log]).error, verify([log]).error) == (None, None)
    whole = before.read_bytes()
    before.write_bytes(whole.replace(b'"number":10', b'"number":11'))
    assert verify([log, before]).error == f"{before}:10: changed"


def broken(log: Path, reason: str) -> list[bytes]:
    """The lines of a log whose line 11 reports a break before which nothing is missing."""
    whole = log.read_bytes()
    if reason == "missing":
        log.rename(log.with_name("audit.log.1"))
    audit = Audit(log, max_bytes=65536, keep=1)
    if reason == "deleted":
        log.unlink()
    if reason == "changed":
        log.write_bytes(whole + garbled(b""))
    audit.write(number=12)
    audit.close()
    own = log.read_bytes().removeprefix(whole + garbled(b""))
    log.write_bytes(whole + own)
    assert (verify([log]).error, verify([log]).breaks) == (None, {reason: 1})
    return log.read_bytes().splitlines(keepends=True)


@pytest.mark.parametrize("reason", ["changed", "deleted", "missing"])
def test_the_line_before_a_break_is_protected_if_nothing_is_missing(log: Path, reason: str) -> None:
    lines = broken(log, reason)
    log.write_bytes(b"".join(changed(lines, 9, forged)))
    assert verify([log]).error == f"{log}:10: changed"
    log.write_bytes(b"".join([*lines[:11], *lines[10:]]))
    assert verify([log]).error is not None


@pytest.mark.parametrize("reason", ["changed", "deleted"])
def test_an_altered_copy_before_a_break_is_found(log: Path, reason: str) -> None:
    lines = broken(log, reason)
    log.write_bytes(b"".join([*lines[:10], spaced(lines[10]), *lines[10:]]))
    assert verify([log]).error == f"{log}:11: inserted"


@pytest.mark.parametrize("reason", ["changed", "deleted", "missing"])
def test_lines_may_be_missing_before_a_break(log: Path, reason: str) -> None:
    lines = broken(log, reason)
    log.write_bytes(b"".join([*lines[:7], *lines[10:]]))
    assert (verify([log]).error, verify([log]).breaks) == (None, {reason: 1})


def test_copies_have_the_lines_of_a_file_that_went_missing(log: Path) -> None:
    lines = broken(log, "missing")
    copied = lines[9].replace(b'"seq":10,"prev":"', b'"seq":11,"prev":"')
    copied = copied.replace(json.loads(copied)["prev"].encode(), digest_of(lines[9]).encode())
    log.write_bytes(b"".join([*lines[:10], copied, *lines[10:]]))
    assert (verify([log]).error, verify([log]).breaks) == (None, {"missing": 1})


def test_an_incomplete_last_line_is_a_gap(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:-5])
    assert asked(log).exit_code == 3
    assert verify([log]).breaks == {"torn": 1}


def test_anchors_find_what_the_chain_can_not(log: Path) -> None:
    lines = log.read_bytes().splitlines(keepends=True)
    last = digest_of(lines[-1])
    assert asked("--anchor", last.upper(), log).exit_code == 0
    log.write_bytes(b"".join(lines[:-1]))
    assert asked(log).exit_code == 0
    result = asked("--anchor", last, "--anchor", digest_of(lines[0]), log)
    assert result.exit_code == 1
    assert result.stdout.startswith(f"not intact: no line has the digest {last}\n")
    assert asked("--anchor", "1234", log).exit_code == 2


def test_a_second_beginning_is_a_gap(log: Path) -> None:
    other = log.with_name("other.log")
    audit = Audit(other, max_bytes=65536, keep=1)
    audit.close()
    log.with_name("both.log").write_bytes(log.read_bytes() + log.read_bytes())
    assert verify([log.with_name("both.log")]).breaks == {"new": 1}


def test_a_file_that_can_not_be_read_is_an_error(log: Path) -> None:
    result = asked(log, log.with_name("none.log"))
    assert result.exit_code == 2
    assert result.stderr == f"holdfast: {log.parent}/none.log: No such file or directory\n"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"memories:\n  plant: {}\n", "not an audit log: it begins with 'memories:\\n'"),
        (b"\x7fELF\0\1", r"not an audit log: it begins with '\x7fELF\x00\x01'"),
        (b'{"level":"info"}\n', """not an audit log: it begins with '{"level":"info"}\\n'"""),
        (gzip.compress(b'{"time":"2026-11-21T08:40:02.117Z","seq":1}\n'), "compressed: unpack it"),
        (b"", "empty: there is nothing to verify"),
    ],
    ids=["text", "program", "another log", "compressed", "empty"],
)
def test_a_file_that_is_not_an_audit_log_is_refused(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    file = tmp_path / "audit.log"
    file.write_bytes(content)
    result = asked(file)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"holdfast: {file}: {reason}")


@pytest.mark.skipif(sys.platform == "win32", reason="needs pipes as files")
def test_a_pipe_is_refused(tmp_path: Path) -> None:
    named = tmp_path / "audit.log"
    os.mkfifo(named)
    end, other = os.pipe()
    try:
        for file, kind in (
            (named, "a pipe"),
            (f"/dev/fd/{end}", "a pipe"),
            ("/dev/null", "a special file"),
        ):
            result = asked(file)
            assert (result.exit_code, result.stdout) == (2, "")
            told = f"it is {kind}, allowed: a regular file"
            assert result.stderr == f"holdfast: {file}: {told}\n"
    finally:
        os.close(end)
        os.close(other)


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="the system has no /proc")
def test_an_error_while_a_file_is_read_names_it() -> None:
    result = asked("/proc/self/mem")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == "holdfast: /proc/self/mem: Input/output error\n"


def test_an_empty_file_of_a_log_is_intact(log: Path) -> None:
    full = log.with_name("audit.log.1")
    log.rename(full)
    log.touch()
    assert asked(log, full).exit_code == 0


def test_only_records_can_be_older_than_the_chain(log: Path) -> None:
    record = b'{"time":"2026-11-21T08:40:02.117Z","number":1}\n'
    log.write_bytes(record * 2)
    assert verify([log]).unchained == 2
    log.write_bytes(record + garbled(b"") + record)
    assert asked(log).exit_code == 1
    assert verify([log]).error == f"{log}:2: changed, or inserted: it is not a record"


def test_a_first_record_may_be_incomplete(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:40])
    assert asked(log).exit_code == 3
    assert verify([log]).breaks == {"torn": 1}


@given(st.lists(st.binary(max_size=40), max_size=6))
def test_any_bytes_are_judged(tmp_path_factory: pytest.TempPathFactory, parts: list[bytes]) -> None:
    file = tmp_path_factory.mktemp("any") / "audit.log"
    file.write_bytes(b"\n".join(parts))
    with contextlib.suppress(OSError):  # Most are not an audit log.
        assert verify([file]).lines > 0
    audit = Audit(file, max_bytes=65536, keep=1)
    audit.write(number=1)
    audit.close()
    assert json.loads(file.read_bytes().splitlines()[-1])["number"] == 1
