"""What waits in a buffer: in memory, in a file, and in which order."""

from __future__ import annotations

import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.outputs import Buffer
from holdfast.outputs.buffer import MAX_ROW
from holdfast.outputs.buffer_file import BufferFile
from holdfast.outputs.buffer_file_error import FileGone
from holdfast.outputs.line_protocol import lines
from holdfast.outputs.tag_meaning import meaning_of
from holdfast.tags import Tag
from holdfast.tags.scale import RegisterScale
from holdfast.tags.text import text_of
from support import wire
from support.cases import examples
from support.readings import numbered, numbers, polls, reading, tag

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from holdfast.polling import Reading

PLENTY = 2**30


class Opened:
    """Opens files, and closes them after the test."""

    def __init__(self) -> None:
        self.all: list[BufferFile] = []

    def __call__(
        self, file: Path, max_bytes: int = PLENTY, known: list[Any] | None = None
    ) -> BufferFile:
        tags = {each.name: each for each in known or [tag()]}
        stored = BufferFile(file, max_bytes, lambda _, name: tags.get(name), lock_timeout=0.05)
        # No test ends the system: nothing has to wait for the disk.
        stored._db.execute("PRAGMA synchronous=OFF")
        self.all.append(stored)
        return stored


@pytest.fixture
def opened() -> Iterator[Opened]:
    made = Opened()
    yield made
    for each in made.all:
        each.close()


def drained(buffer: Buffer, most: int = 3) -> list[int]:
    found: list[int] = []
    while readings := buffer.take(most, 0):
        found += numbers(readings)
        buffer.done()
    return found


def test_what_is_taken_stays_until_it_is_done() -> None:
    buffer = Buffer()
    buffer.offer(polls(5))
    assert numbers(buffer.take(3, 0)) == numbers(buffer.take(3, 0)) == [0, 1, 2]
    assert len(buffer) == 5
    buffer.done()
    assert (len(buffer), drained(buffer)) == (2, [3, 4])


def test_the_output_before_a_reload_gets_nothing_that_is_meant_for_the_next_one() -> None:
    before = Buffer(3)
    before.offer(polls(4))
    after = Buffer(before=Buffer(before=before))
    after.offer([[reading(9)]])
    assert numbers(before.take(1, 0.0)) == [1]
    assert numbers(before.take(10, 0.0)) == [1]
    assert len(after) == 4
    before.detach()
    after.take_over()
    assert (len(before), len(after), after.dropped) == (0, 4, 1)
    assert numbers(after.take(10, 0.0)) == [1, 2, 3, 9]


def test_a_wait_can_be_ended() -> None:
    buffer = Buffer()
    began = time.monotonic()
    with ThreadPoolExecutor(1) as threads:
        taken = threads.submit(buffer.take, 1, wire.DEADLINE)
        buffer.wake()
        assert taken.result() == []
    assert time.monotonic() - began < wire.DEADLINE
    buffer.offer(polls(1))
    assert numbers(buffer.take(1, 0)) == [0]


def test_the_newest_stay_and_the_others_are_counted() -> None:
    buffer = Buffer(4)
    buffer.offer(polls(3))
    buffer.offer(polls(3, 3))
    assert (buffer.dropped, drained(buffer)) == (2, [2, 3, 4, 5])


def test_a_file_comes_before_memory_and_survives(opened: Opened, tmp_path: Path) -> None:
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(5))
    assert numbers(buffer.take(2, 0)) == [0, 1]
    buffer.move_to_file(60, 2)
    buffer.offer(polls(2, 5))
    assert len(buffer) == 7
    buffer.detach()
    again = Buffer()
    again.stored = opened(tmp_path / "b.db")
    again.offer(polls(2, 7))
    assert len(again) == 7
    assert drained(again) == [0, 1, 2, 3, 4, 7, 8]
    assert drained(buffer) == [5, 6]


def test_readings_that_come_while_others_are_stored_do_not_hold_up_the_output(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer = Buffer()
    stored = buffer.stored = opened(tmp_path / "b.db")
    add = stored.add

    def slow_disk(rows: Sequence[Sequence[Reading]]) -> int:
        buffer.offer(polls(2, 100))
        return add(rows)

    monkeypatch.setattr(stored, "add", slow_disk)
    buffer.offer(polls(5))
    buffer.move_to_file(60, 2)
    assert (stored.count, len(buffer)) == (5, 11)


def test_what_is_dropped_while_others_are_stored_is_counted(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer = Buffer(2)
    stored = buffer.stored = opened(tmp_path / "b.db")

    def full(rows: Sequence[Sequence[Reading]]) -> int:
        buffer.offer(polls(5, 100))
        return sum(map(len, rows))

    monkeypatch.setattr(stored, "add", full)
    buffer.offer(polls(2))
    buffer.move_to_file(60)
    assert buffer.dropped == 3 + 2


def test_storing_ends_in_time_and_loses_nothing(opened: Opened, tmp_path: Path) -> None:
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(5))
    buffer.move_to_file(0, 2)
    assert (buffer.stored.count, drained(buffer)) == (0, list(range(5)))


def test_a_large_step_is_stored_whole_and_sent_in_small_ones(
    opened: Opened, tmp_path: Path
) -> None:
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(2 * MAX_ROW + 1))
    buffer.move_to_file(60)
    assert numbers(buffer.take(9, 0)) == list(range(MAX_ROW))
    assert drained(buffer) == list(range(2 * MAX_ROW + 1))


@pytest.mark.parametrize("with_file", [False, True])
def test_what_is_taken_ends_with_a_whole_poll(
    opened: Opened, tmp_path: Path, with_file: bool
) -> None:
    buffer = Buffer()
    buffer.offer([numbered(3), numbered(3, 3), numbered(1, 6)])
    if with_file:
        buffer.stored = opened(tmp_path / "b.db")
        buffer.move_to_file(60, 2)
    taken = []
    while readings := buffer.take(4, 0):
        taken.append(numbers(readings))
        buffer.done()
    assert taken[0] == list(range(3 if with_file else 6))
    assert [number for numbers in taken for number in numbers] == list(range(7))
    assert all(numbers[-1] in (2, 5, 6) for numbers in taken)


def test_small_rows_of_a_file_are_sent_together(opened: Opened, tmp_path: Path) -> None:
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    for number in range(5):
        buffer.offer(polls(1, number))
        buffer.move_to_file(60)
    assert numbers(buffer.take(3, 0)) == [0, 1, 2]
    buffer.done()
    assert (numbers(buffer.take(3, 0)), buffer.stored.count) == ([3, 4], 2)


def test_what_waits_longer_than_others_is_late() -> None:
    buffer = Buffer(4)
    buffer.offer(polls(3))
    assert buffer.is_filling
    assert [buffer.has_late(), buffer.has_late()] == [False, True]
    buffer.take(3, 0)
    buffer.offer(polls(2, 3))
    assert not buffer.is_filling
    assert [buffer.has_late(), buffer.has_late()] == [False, True]


def test_readings_are_numbered_in_the_order_in_which_they_leave(
    opened: Opened, tmp_path: Path
) -> None:
    buffer = Buffer(4)
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(2))
    buffer.move_to_file(60)
    buffer.offer(polls(3, 2))
    assert (buffer.first_number, buffer.next_number) == (0, 5)
    buffer.take(1, 0)
    assert (buffer.first_number, buffer.next_number) == (0, 5)
    while (batch := buffer.take(1, 0)) != []:
        assert buffer.first_number == numbers(batch)[0]
        buffer.done()
    buffer.offer(polls(6, 5))
    assert (buffer.first_number, buffer.next_number, numbers(buffer.take(1, 0))) == (7, 11, [7])


def test_what_was_taken_from_the_file_is_taken_again_after_a_crash(
    opened: Opened, tmp_path: Path
) -> None:
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(3))
    buffer.move_to_file(60)
    assert numbers(buffer.take(9, 0)) == [0, 1, 2]
    buffer.detach()
    again = Buffer()
    again.stored = opened(tmp_path / "b.db")
    assert drained(again) == [0, 1, 2]


@pytest.mark.parametrize("more", [[], [2**64], [[0, -10 * 2**64, None, 1.5]]], ids=repr)
def test_values_of_every_kind_survive_in_a_file(
    opened: Opened, tmp_path: Path, more: list[Any]
) -> None:
    values = [None, True, 0, -(2**63), 2**64 - 1, 0.1, "ä", b"\0\xff", [1, None, 2.5], ["a"]]
    # A scale makes integers beyond those of the file, after which all of a row have another form.
    values += more
    stored = opened(tmp_path / "b.db")
    readings = [reading(value, fault=7, undecoded="why") for value in values]
    assert stored.add([readings]) == 0
    stored.close()
    assert repr(opened(tmp_path / "b.db").first(1)) == repr(readings)


def test_the_oldest_go_when_the_file_is_full(opened: Opened, tmp_path: Path) -> None:
    stored = opened(tmp_path / "b.db", max_bytes=1000)
    dropped = sum(stored.add([numbered(10, start)]) for start in range(0, 100, 10))
    left = 0
    while stored.first(1):
        left += len(stored.first(1))
        stored.remove_first()
    assert (dropped + left, stored.count) == (100, 0)
    assert 0 < left < 100
    assert stored.add([numbered(1000)]) == 1000


def test_a_file_that_is_in_use_is_an_error(opened: Opened, tmp_path: Path) -> None:
    first = opened(tmp_path / "b.db")
    with pytest.raises(OSError, match=r"b\.db: database is locked"):
        opened(tmp_path / "b.db")
    first.close()
    opened(tmp_path / "b.db").close()


def test_a_file_that_is_no_database_is_an_error(opened: Opened, tmp_path: Path) -> None:
    (tmp_path / "b.db").write_bytes(b"not a database" * 100)
    with pytest.raises(OSError, match=r"b\.db: file is not a database"):
        opened(tmp_path / "b.db")


@pytest.mark.parametrize("version", [0, 2])
def test_a_file_of_another_version_is_an_error_and_stays_as_it_is(
    opened: Opened, tmp_path: Path, version: int
) -> None:
    file = tmp_path / "buffer.db"
    stored = opened(file)
    stored.add([numbered(1)])
    stored.close()
    with closing(sqlite3.connect(file)) as other:
        other.execute(f"PRAGMA user_version={version}")
    before = file.read_bytes()
    with pytest.raises(OSError, match=rf"\.db: format {version}, of another version .*: 1"):
        opened(file)
    assert file.read_bytes() == before


def damage(file: Path, page: int) -> None:
    """Overwrites one page, as a worn card or a power cut may."""
    with file.open("r+b") as opened:
        opened.seek(4096 * (page - 1))
        opened.write(b"\xa5" * 4096)


def test_a_damaged_file_is_left_under_another_name(opened: Opened, tmp_path: Path) -> None:
    """What is before the damage is sent, and the rest dropped."""
    file = tmp_path / "b.db"
    stored = opened(file)
    for start in range(0, 5000, 1000):
        stored.add([numbered(1000, start)])
    [pages] = stored._db.execute("PRAGMA page_count").fetchone()
    stored.close()
    damage(file, pages // 2)
    buffer = Buffer()
    buffer.stored = opened(file)
    found: list[int] = []
    with pytest.raises(FileGone, match=r"b\.db: .*malformed; it is .*b\.db\.damaged now"):  # noqa: PT012
        while readings := buffer.take(1000, 0):
            found += numbers(readings)
            buffer.done()
    assert 0 < len(found) < 5000
    assert found == list(range(len(found)))
    assert (buffer.dropped, len(buffer)) == (5000 - len(found), 0)
    assert [each.name for each in tmp_path.iterdir()] == ["b.db.damaged"]


def test_what_was_taken_from_a_damaged_file_is_not_lost(opened: Opened, tmp_path: Path) -> None:
    """A new file takes it, with what came since."""
    file = tmp_path / "b.db"
    stored = opened(file)
    stored.add([numbered(3)])
    stored.add([numbered(3, 3)])
    [page] = stored._db.execute("SELECT rootpage FROM sqlite_master WHERE name = 'tags'").fetchone()
    stored.close()
    damage(file, page)
    buffer = Buffer()
    buffer.stored = opened(file)
    assert numbers(buffer.take(3, 0)) == [0, 1, 2]
    buffer.offer(polls(1, 6))
    with pytest.raises(FileGone, match="malformed"):
        buffer.move_to_file(60)
    assert (buffer.dropped, len(buffer)) == (3, 4)
    stored = buffer.stored = opened(file)
    buffer.move_to_file(60)
    assert stored.count == 4
    assert drained(buffer) == [0, 1, 2, 6]


def test_a_file_that_is_damaged_at_the_start_is_left_under_another_name(
    opened: Opened, tmp_path: Path
) -> None:
    file = tmp_path / "b.db"
    stored = opened(file)
    stored.add([numbered(3)])
    [page] = stored._db.execute(
        "SELECT rootpage FROM sqlite_master WHERE name = 'readings'"
    ).fetchone()
    stored.close()
    damage(file, page)
    with pytest.raises(FileGone, match="malformed"):
        opened(file)
    assert opened(file).count == 0
    assert (tmp_path / "b.db.damaged").exists()


def test_a_damaged_schema_need_not_be_utf_8(opened: Opened, tmp_path: Path) -> None:
    file = tmp_path / "b.db"
    opened(file).close()
    file.write_bytes(file.read_bytes().replace(b"tabletags", b"table\x9fags"))
    with pytest.raises(FileGone, match=r"b\.db: malformed .*; it is .*b\.db\.damaged now"):
        opened(file)
    assert opened(file).count == 0


def test_a_file_that_is_damaged_near_its_end_is_sent_up_to_there(
    opened: Opened, tmp_path: Path
) -> None:
    """What is behind the damage counts as dropped, as far as it can be counted."""
    file = tmp_path / "b.db"
    stored = opened(file)
    for start in range(0, 5000, 10):
        stored.add([numbered(10, start)])
    [pages] = stored._db.execute("PRAGMA page_count").fetchone()
    stored.close()
    damage(file, pages - 1)
    buffer = Buffer()
    buffer.stored = opened(file)
    waiting = len(buffer)
    found: list[int] = []
    with pytest.raises(FileGone, match="malformed"):  # noqa: PT012
        while readings := buffer.take(1000, 0):
            found += numbers(readings)
            buffer.done()
    assert found == list(range(len(found)))
    assert len(found) > 4500
    assert len(found) + buffer.dropped == waiting < 5000
    assert buffer.dropped > 0


def test_a_file_that_can_not_be_read_any_more_is_left_under_another_name(
    opened: Opened, tmp_path: Path
) -> None:
    """As on a bad sector. Trying again would hold up all values."""
    buffer = Buffer()
    stored = buffer.stored = opened(tmp_path / "b.db")
    stored.add([numbered(3)])
    stored._db.set_progress_handler(lambda: True, 1)
    buffer.offer(polls(2, 3))
    with pytest.raises(FileGone, match=r"b\.db: interrupted; it is .*b\.db\.damaged now"):
        buffer.take(1, 0)
    assert buffer.dropped == 3
    assert drained(buffer) == [3, 4]


def without_constraints(stored: BufferFile) -> None:
    """A damaged row may have anything in any column."""
    stored._db.executescript(
        "ALTER TABLE readings RENAME TO sound;"
        "CREATE TABLE readings (id INTEGER PRIMARY KEY, count, data, checksum);"
        "INSERT INTO readings SELECT * FROM sound"
    )


WRONG_COLUMNS = [
    "count = NULL",
    "count = 'three'",
    "count = 3.5",
    "count = 0",
    "count = -3",
    "count = 9223372036854775807",
    "data = NULL",
]


@pytest.mark.parametrize("change", WRONG_COLUMNS)
def test_a_file_with_a_row_that_can_not_be_counted_is_sent_up_to_there(
    opened: Opened, tmp_path: Path, change: str
) -> None:
    file = tmp_path / "b.db"
    stored = opened(file)
    for start in range(0, 9, 3):
        stored.add([numbered(3, start)])
    without_constraints(stored)
    stored._db.execute(f"UPDATE readings SET {change} WHERE id = 2")
    stored.close()
    buffer = Buffer()
    buffer.stored = opened(file)
    assert numbers(buffer.take(9, 0)) == [0, 1, 2]
    buffer.done()
    with pytest.raises(FileGone, match=r"b\.db: row 2 has .* it is .*b\.db\.damaged now"):
        buffer.take(9, 0)
    assert (buffer.dropped, len(buffer)) == (3, 0)
    assert [each.name for each in tmp_path.iterdir()] == ["b.db.damaged"]


@pytest.mark.parametrize("change", WRONG_COLUMNS)
def test_a_row_that_can_not_be_counted_does_not_keep_others_from_being_stored(
    opened: Opened, tmp_path: Path, change: str
) -> None:
    """It would be the next to go from a full file."""
    buffer = Buffer()
    stored = buffer.stored = opened(tmp_path / "b.db", max_bytes=150)
    stored.add([numbered(4)])
    without_constraints(stored)
    stored._db.execute(f"UPDATE readings SET {change}")
    buffer.offer(polls(4, 4))
    with pytest.raises(FileGone, match="row 1 has"):
        buffer.move_to_file(60)
    assert buffer.dropped == 4
    assert drained(buffer) == [4, 5, 6, 7]


def test_rows_that_are_missing_end_the_use_of_a_file(opened: Opened, tmp_path: Path) -> None:
    """Nothing waits for them without end."""
    buffer = Buffer()
    for use in (lambda: buffer.take(9, 0), lambda: buffer.move_to_file(60)):
        stored = buffer.stored = opened(tmp_path / "b.db", max_bytes=150)
        stored.add([numbered(4)])
        stored._db.execute("DELETE FROM readings")
        buffer.offer(polls(4, 4))
        with pytest.raises(FileGone, match="4 readings are missing"):
            use()
        assert buffer.dropped == 4
        assert drained(buffer) == [4, 5, 6, 7]
        buffer.dropped = 0


def test_rows_in_a_wrong_order_are_not_sent_again(opened: Opened, tmp_path: Path) -> None:
    """SQLite returns the rows behind another one in the order of the file, whatever their ids."""
    file = tmp_path / "b.db"
    stored = opened(file)
    for start in range(0, 9, 3):
        stored.add([numbered(3, start)])
    [data] = stored._db.execute("SELECT data FROM readings WHERE id = 3").fetchone()
    stored.close()
    content = bytearray(file.read_bytes())
    # Between an id and its data are the 6 bytes of a header and the count.
    at = content.index(data) - 8
    assert content[at] == 3
    content[at] = 1
    file.write_bytes(content)
    buffer = Buffer()
    stored = buffer.stored = opened(file)
    refuse_removals(stored)
    for sent in ([0, 1, 2], [3, 4, 5]):
        assert numbers(buffer.take(3, 0)) == sent
        with pytest.raises(OSError, match="is full"):
            buffer.done()
    with pytest.raises(FileGone, match="row 1 is behind row 2"):
        buffer.take(3, 0)
    assert buffer.dropped == 3


def test_a_file_is_free_again_after_any_error(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: BufferFile) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(BufferFile, "_recount", fail)
        with pytest.raises(MemoryError) as error:
            opened(tmp_path / "b.db")
    assert opened(tmp_path / "b.db").count == 0
    assert error.tb is not None


@pytest.mark.parametrize("error", [OSError, RuntimeError])
def test_what_can_not_be_stored_stays_in_memory(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(3))

    def full(_: Sequence[Sequence[Reading]]) -> int:
        raise error("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(buffer.stored, "add", full)
        with pytest.raises(error, match="disk is full"):
            buffer.move_to_file(60)
        assert numbers(buffer.take(2, 0)) == [0, 1, 2]
        with pytest.raises(error, match="disk is full"):
            buffer.move_to_file(60)
    assert drained(buffer) == [0, 1, 2]


def test_a_full_disk_leaves_the_file_as_it_was(opened: Opened, tmp_path: Path) -> None:
    stored = opened(tmp_path / "b.db")
    stored.add([numbered(3)])
    pages = stored._db.execute("PRAGMA page_count").fetchone()[0]
    stored._db.execute(f"PRAGMA max_page_count={pages}")
    with pytest.raises(OSError, match="disk is full"):
        stored.add([numbered(1000)])
    assert (stored.count, numbers(stored.first(1))) == (3, [0, 1, 2])
    stored.remove_first()
    assert stored.count == 0


def refuse_removals(stored: BufferFile) -> None:
    """As on a full disk: a removal has to write a journal first."""
    stored._db.execute(
        "CREATE TRIGGER full BEFORE DELETE ON readings BEGIN SELECT RAISE(ABORT, 'is full'); END"
    )


def test_a_file_that_was_removed_is_written_anew_with_all_that_waits(
    opened: Opened, tmp_path: Path
) -> None:
    """In its order, also what was taken; and what is sent does not return."""
    file = tmp_path / "b.db"
    (tmp_path / "b.db.new").write_text("left by a crash")
    buffer = Buffer()
    buffer.stored = opened(file)
    for number in range(4):
        buffer.offer(polls(1, number))
        buffer.move_to_file(60)
    assert numbers(buffer.take(1, 0)) == [0]
    buffer.done()
    assert numbers(buffer.take(1, 0)) == [1]
    assert not buffer.restore_file()
    file.unlink()
    assert not buffer.stored.is_in_place
    assert buffer.restore_file()
    assert (buffer.stored.is_in_place, buffer.stored.count, len(buffer)) == (True, 3, 3)
    buffer.done()
    buffer.offer(polls(1, 4))
    buffer.move_to_file(60)
    buffer.detach()
    assert [each.name for each in tmp_path.iterdir()] == ["b.db"]
    again = Buffer()
    again.stored = opened(file)
    assert drained(again) == [2, 3, 4]


def test_a_file_in_the_place_of_one_that_was_renamed_is_left_alone(
    opened: Opened, tmp_path: Path
) -> None:
    file = tmp_path / "b.db"
    buffer = Buffer()
    stored = buffer.stored = opened(file)
    stored.add([numbered(3)])
    file.rename(tmp_path / "moved.db")
    file.write_text("of another program")
    with pytest.raises(OSError, match=r"b\.db: another file is in its place"):
        buffer.restore_file()
    assert numbers(buffer.take(9, 0)) == [0, 1, 2]
    # If nothing can be removed, the file would go as a whole.
    refuse_removals(stored)
    with pytest.raises(OSError, match="is full"):
        buffer.done()
    assert file.read_text() == "of another program"


def test_a_new_file_that_another_process_uses_is_opened_later(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "b.db"
    buffer = Buffer()
    stored = buffer.stored = opened(file)
    stored.add([numbered(3)])
    close = stored.close

    def overtaken() -> None:
        close()
        opened(file)

    with monkeypatch.context() as patched:
        patched.setattr(stored, "close", overtaken)
        file.unlink()
        with pytest.raises(FileGone, match="database is locked"):
            buffer.restore_file()
    assert (len(buffer), buffer.dropped) == (0, 0)
    opened.all[-1].close()
    buffer.stored = opened(file)
    assert drained(buffer) == [0, 1, 2]


def test_what_can_not_be_removed_is_not_sent_again(opened: Opened, tmp_path: Path) -> None:
    buffer = Buffer()
    stored = buffer.stored = opened(tmp_path / "b.db")
    for start in range(0, 9, 3):
        stored.add([numbered(3, start)])
    refuse_removals(stored)
    assert numbers(buffer.take(1, 0)) == [0, 1, 2]
    with pytest.raises(OSError, match="is full"):
        buffer.done()
    assert numbers(buffer.take(1, 0)) == [3, 4, 5]
    assert len(buffer) == 6
    stored._db.execute("DROP TRIGGER full")
    stored.add([numbered(3, 9)])
    assert stored._db.execute("SELECT min(id) FROM readings").fetchone() == (2,)
    assert drained(buffer) == list(range(3, 12))


def test_a_file_goes_as_a_whole_if_all_is_sent_and_nothing_can_be_removed(
    opened: Opened, tmp_path: Path
) -> None:
    """A full disk would keep it full."""
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db")
    buffer.offer(polls(3))
    buffer.move_to_file(60)
    refuse_removals(buffer.stored)
    assert numbers(buffer.take(3, 0)) == [0, 1, 2]
    with pytest.raises(FileGone, match="is full"):
        buffer.done()
    assert list(tmp_path.iterdir()) == []
    assert (buffer.dropped, len(buffer)) == (0, 0)
    buffer.stored = opened(tmp_path / "b.db")
    assert drained(buffer) == []


def test_a_file_that_can_not_be_deleted_either_stays_open(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If it were opened anew, all of it would be sent again."""
    buffer = Buffer()
    stored = buffer.stored = opened(tmp_path / "b.db")
    stored.add([numbered(3)])
    refuse_removals(stored)
    assert numbers(buffer.take(3, 0)) == [0, 1, 2]

    def is_read_only(_: Path) -> None:
        raise OSError("read-only file system")

    with monkeypatch.context() as patched:
        patched.setattr(type(tmp_path), "unlink", is_read_only)
        with pytest.raises(OSError, match="is full"):
            buffer.done()
    assert buffer.stored is stored
    buffer.offer(polls(1, 3))
    assert drained(buffer) == [3]


def test_an_empty_file_is_small(opened: Opened, tmp_path: Path) -> None:
    file = tmp_path / "b.db"
    stored = opened(file)
    empty = file.stat().st_size
    stored.add([[reading("x" * 1_000_000)]])
    assert file.stat().st_size > 1_000_000
    stored.first(1)
    stored.remove_first()
    assert file.stat().st_size <= 2 * empty


def test_a_batch_that_the_file_has_dropped_takes_no_other_with_it(
    opened: Opened, tmp_path: Path
) -> None:
    """It is sent all the same, and only then removed."""
    buffer = Buffer()
    buffer.stored = opened(tmp_path / "b.db", max_bytes=250)
    for start in range(0, 8, 4):
        buffer.offer(polls(4, start))
        buffer.move_to_file(60)
    assert numbers(buffer.take(4, 0)) == [0, 1, 2, 3]
    buffer.offer(polls(4, 8))
    buffer.move_to_file(60)
    assert buffer.dropped == 4
    assert drained(buffer) == list(range(12))


def test_no_flipped_bit_is_sent_as_another_value(opened: Opened, tmp_path: Path) -> None:
    """Its row is dropped and counted."""
    stored = opened(tmp_path / "b.db")
    stored.add([numbered(3)] * 8)
    stored.add([numbered(2, 3)])
    query = "SELECT data FROM readings WHERE id = 1"
    [data] = stored._db.execute(query).fetchone()
    for row in range(1, 9):
        # Bytes of the array, the name, the value, the time, the meaning, and some between them.
        changed = bytearray(data)
        changed[row * len(data) // 9] ^= 1 << row - 1
        stored._db.execute("UPDATE readings SET data = ? WHERE id = ?", (changed, row))
    stored._db.execute("UPDATE readings SET checksum = checksum + 1 WHERE id = 1")
    buffer = Buffer()
    buffer.stored = stored
    assert drained(buffer) == [3, 4]
    assert (buffer.dropped, len(buffer)) == (24, 0)


@pytest.mark.parametrize("change", ["count = count - 1", "data = 1234", "checksum = NULL"])
def test_a_row_that_is_not_as_it_was_stored_is_dropped_and_counted(
    opened: Opened, tmp_path: Path, change: str
) -> None:
    file = tmp_path / "b.db"
    stored = opened(file)
    stored.add([numbered(3)])
    stored.add([numbered(2, 3)])
    without_constraints(stored)
    stored._db.execute(f"UPDATE readings SET {change} WHERE id = 1")
    stored.close()
    buffer = Buffer()
    buffer.stored = opened(file)
    assert drained(buffer) == [3, 4]
    assert len(buffer) == 0
    assert 0 < buffer.dropped <= 3


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE readings SET data = CAST(x'c1ff' AS TEXT) WHERE id = 1",
        "UPDATE tags SET description = CAST(x'7bff' AS TEXT) WHERE description LIKE '%float32%'",
        "UPDATE tags SET description = replace(description, 'float32', 'float64') WHERE "
        "description LIKE '%float32%'",
        "DELETE FROM tags WHERE description LIKE '%float32%'",
    ],
    ids=["data", "description", "type", "tag"],
)
def test_a_row_whose_text_or_tag_is_damaged_is_dropped_and_counted(
    opened: Opened, tmp_path: Path, change: str
) -> None:
    stored = opened(tmp_path / "b.db", known=[])
    stored.add([[reading(1.5, tag=tag("gone", type="float32"))]])
    stored.add([numbered(2, 3)])
    assert stored._db.execute(change).rowcount == 1
    buffer = Buffer()
    buffer.stored = stored
    assert drained(buffer) == [3, 4]
    assert (buffer.dropped, len(buffer)) == (1, 0)


def test_a_value_of_a_changed_tag_keeps_its_meaning(opened: Opened, tmp_path: Path) -> None:
    stored = opened(tmp_path / "b.db")
    before = tag("t", type="uint16", scale=0.1, description="before")
    stored.add([[reading(21.5, tag=before)]])
    stored.close()
    for now in (
        tag("other"),
        tag("t", type="uint16"),
        tag("t", type="float32", unit="V"),
        tag("t", type="uint16", scale=0.1, description="after"),
    ):
        again = opened(tmp_path / "b.db", known=[now])
        [found] = again.first(1)
        assert (found.value, found.tag.type, found.tag.scale) == (21.5, "uint16", 0.1)
        again.close()


SCALE = tag("exponent", type="int16")


@pytest.mark.parametrize(
    ("value", "before"),
    [
        (5, tag(type="uint64", unit="kWh")),
        (1, tag(type="uint16", states={0: "off", 1: "running"})),
        (True, Tag("t", "coils", 3, states={0: "off", 1: "on"})),
        (True, Tag("t", "holding_registers", 3, "bit:4")),
        ([1, None], tag(type="int32[2]", scale=10**30, offset=-0.5)),
        (21, tag(type="uint16", scale=RegisterScale("exponent", source=SCALE))),
        (21, tag(type="uint16", scale=RegisterScale("factor", "exponent", SCALE))),
        ("a", tag(type="string:4", encoding="utf-8")),
    ],
    ids=["uint64", "states", "coil", "bit", "array", "exponent", "factor", "text"],
)
def test_a_value_of_a_changed_tag_is_sent_as_it_was(
    opened: Opened, tmp_path: Path, value: Any, before: Tag
) -> None:
    """InfluxDB refuses a field that changes its kind."""
    stored = opened(tmp_path / "b.db", known=[tag("t", type="string:2")])
    stored.add([[reading(value, tag=before)]])
    [found] = stored.first(1)
    assert found.tag.type == before.type
    assert meaning_of(found.tag) == meaning_of(before)
    assert lines([found], "m", {}) == lines([reading(value, tag=before)], "m", {})
    assert text_of(found.tag, value) == text_of(before, value)


@settings(max_examples=examples(60), deadline=None)
@given(steps=st.lists(st.sampled_from(["offer", "take", "done", "keep", "restart"]), max_size=40))
def test_nothing_is_lost_or_reordered(
    tmp_path_factory: pytest.TempPathFactory, steps: list[str]
) -> None:
    """Whatever happens, what is sent is everything, in its order; only what was taken and not done
    may come twice."""
    file, opened = tmp_path_factory.mktemp("buffer") / "b.db", Opened()
    buffer = Buffer()
    buffer.stored = opened(file)
    sent: list[int] = []
    offered = 0
    for step in [*steps, "restart"]:
        if step == "offer":
            buffer.offer(polls(3, offered))
            offered += 3
        elif step == "take":
            buffer.take(2, 0)
        elif step == "done":
            sent += numbers(buffer.take(2, 0))
            buffer.done()
        elif step == "keep":
            buffer.move_to_file(60, 2)
        else:
            buffer.move_to_file(60, 2)
            buffer.detach()
            buffer.stored = opened(file)
    sent += drained(buffer)
    buffer.detach()
    assert sent == list(range(offered))
