"""Files of text: whole lines, rotation, full disks."""

from __future__ import annotations

import csv
import json
import math
import sqlite3
import sys
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config.models.outputs import FileConfig
from holdfast.outputs import sender, text_file
from holdfast.outputs.sqlite_file import SqliteFile
from holdfast.outputs.text_file import HEAD, TextFile
from holdfast.runtime.stop import Stop
from support.line_protocol import parsed
from support.readings import numbered, reading, tag
from support.renaming import not_renamed

if TYPE_CHECKING:
    import io
    from pathlib import Path

TIME = "2023-11-14T22:13:20.250000Z"
READINGS = [
    reading(21.5, tag=tag("t", unit="°C")),
    reading(True, tag=tag("on", area="coils", type="bool")),
    reading([1, 2], tag=tag("a")),
    reading('x,"y"\nz', tag=tag("s", type="string:6")),
    reading(b"\1\xff", tag=tag("b", type="bytes:2")),
    reading(None, tag=tag("n"), fault=2),
]


def settings(file: Path, kind: str, **more: Any) -> FileConfig:
    return FileConfig.model_validate(
        {"type": "file", "file": str(file), "format": kind} | more, context={"folder": file.parent}
    )


def test_csv_has_a_head_and_one_line_for_each_value(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.csv", "csv"))
    file.send(READINGS)
    file.close()
    again = TextFile(settings(tmp_path / "a.csv", "csv"))
    again.send(READINGS[:1])
    again.close()
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as text:
        rows = list(csv.reader(text))
    first = [TIME, "pump", "t", "21.5", "°C", ""]
    assert rows == [
        ["time", "device", "tag", "value", "unit", "error"],
        first,
        [TIME, "pump", "on", "true", "", ""],
        [TIME, "pump", "a", "[1,2]", "", ""],
        [TIME, "pump", "s", 'x,"y"\nz', "", ""],
        [TIME, "pump", "b", "Af8=", "", ""],
        [TIME, "pump", "n", "", "", "exception 02 (Illegal Data Address)"],
        first,
    ]


def test_a_text_with_a_carriage_return_is_one_cell_of_csv(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.csv", "csv"))
    file.send([reading("ABC123\r", tag=tag("s", type="string:8")), reading(1)])
    file.close()
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as text:
        assert [row[3] for row in csv.reader(text)] == ["value", "ABC123\r", "1"]


def test_json_lines_have_one_object_for_each_value(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.jsonl", "jsonl"))
    file.send(READINGS)
    file.close()
    found = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text("utf-8").splitlines()]
    assert [each["value"] for each in found] == [21.5, True, [1, 2], 'x,"y"\nz', "Af8=", None]
    assert found[0] == {
        "time": TIME,
        "device": "pump",
        "tag": "t",
        "value": 21.5,
        "unit": "°C",
        "error": None,
    }


@pytest.mark.parametrize(("kind", "value"), [("csv", ",inf,,"), ("jsonl", '"value":null')])
def test_infinity_is_a_word_in_csv_and_null_in_json(tmp_path: Path, kind: str, value: str) -> None:
    file = TextFile(settings(tmp_path / "a", kind))
    file.send([reading(math.inf)])
    file.close()
    assert value in (tmp_path / "a").read_text("utf-8")


def test_line_protocol_can_be_written_to_a_file(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.txt", "influx"))
    file.send(READINGS)
    file.send([reading(None)])
    file.close()
    [point] = parsed((tmp_path / "a.txt").read_bytes())
    assert point.fields == {
        "t": 21.5,
        "on": True,
        "a[0]": 1,
        "a[1]": 2,
        "s": r'x,"y"\nz',
        "b": "Af8=",
    }


def test_a_full_file_is_rotated(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.jsonl", "jsonl", max_bytes=65536, keep=2))
    batch = [reading(number) for number in range(200)]
    for _ in range(12):
        file.send(batch)
    file.close()
    sizes = {each.name: each.stat().st_size for each in tmp_path.iterdir()}
    assert sorted(sizes) == ["a.jsonl", "a.jsonl.1", "a.jsonl.2"]
    assert all(0 < size <= 65536 for size in sizes.values())


def test_a_file_that_can_not_be_renamed_grows_and_costs_no_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.jsonl"
    file = TextFile(settings(path, "jsonl", max_bytes=65536, keep=2))
    batch = [reading(number) for number in range(200)]
    for _ in range(12):
        file.send(batch)
    older = [(tmp_path / f"a.jsonl.{number}").read_bytes() for number in (1, 2)]
    not_renamed(monkeypatch, path)
    for _ in range(8):
        file.send(batch)
    file.close()
    assert path.stat().st_size > 65536
    assert [(tmp_path / f"a.jsonl.{number}").read_bytes() for number in (1, 2)] == older
    assert caplog.messages == ["output_not_rotated"]


def test_without_older_files_a_full_file_is_removed(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.jsonl", "jsonl", max_bytes=65536, keep=0))
    for _ in range(12):
        file.send([reading(number) for number in range(200)])
    file.close()
    [left] = tmp_path.iterdir()
    assert 0 < left.stat().st_size <= 65536


def test_a_file_that_is_moved_is_written_again(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.csv", "csv"))
    file.send(READINGS[:1])
    (tmp_path / "a.csv").rename(tmp_path / "b.csv")
    file.send(READINGS[:1])
    file.close()
    assert (tmp_path / "a.csv").read_text("utf-8") == (tmp_path / "b.csv").read_text("utf-8")


@pytest.mark.parametrize("lines", [0, 1, 2])
@pytest.mark.parametrize("kind", ["csv", "jsonl", "influx"])
def test_a_line_that_a_crash_has_cut_off_is_removed(
    tmp_path: Path, kind: str, lines: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Half of a value can be a wrong one, such as 15 of 1520.5."""
    path = tmp_path / "a"

    def send() -> list[bytes]:
        file = TextFile(settings(path, kind))
        for number in range(3):
            file.send([reading(1520.5 + number)])
        file.close()
        return path.read_bytes().splitlines(keepends=True)

    whole = send()
    path.write_bytes(b"".join(whole[:lines]) + whole[lines][:-5])
    expected = whole[:lines] + (whole[1:] if kind == "csv" and lines else whole)
    assert send() == expected
    [record] = caplog.records
    fields = {"file": str(path), "bytes": len(whole[lines]) - 5}
    assert (record.message, vars(record)["fields"]) == ("output_line_cut", fields)


def test_a_cut_off_line_is_looked_at_again_after_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    file = TextFile(settings(path, "csv"))
    file.send([reading(1520.5)])
    file.close()
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[1][:-3])

    def fails(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(text_file, "_end_line", fails)
        with pytest.raises(OSError, match="Input/output error"):
            file.send([reading(1520.5)])
    file.send([reading(1520.5)])
    file.close()
    assert path.read_bytes() == whole + whole.splitlines(keepends=True)[1]


@pytest.mark.parametrize("kind", ["csv", "influx"])
def test_a_row_that_is_cut_off_anywhere_is_removed(tmp_path: Path, kind: str) -> None:
    """Also within a text with a newline: in CSV, its quote would take in the next row."""
    path = tmp_path / "a"

    def sent(*texts: str) -> bytes:
        file = TextFile(settings(path, kind))
        for text in texts:
            file.send([reading(text, tag=tag("s", type="string:20"))])
        file.close()
        return path.read_bytes()

    two = sent("A1\nLOT7", "A2")
    last = 'A3\n"x" \\\n"\nLOT8'
    whole = sent(last)
    for end in range(len(two), len(whole)):
        path.write_bytes(whole[:end])
        assert sent(last) == whole, whole[len(two) : end]


def test_a_text_that_looks_like_a_row_is_not_cut_off(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    row = f"{TIME},\n"
    for text in (f"0\n{row}", f"1\n{row}", f"2\n{row}{row}3", ""):
        file = TextFile(settings(tmp_path / "a", "csv"))
        file.send([reading(text, tag=tag("s", type="string:160"))])
        file.close()
    assert (tmp_path / "a").read_text("utf-8").count(row) == 4
    assert not caplog.records


@pytest.mark.parametrize("head", [b"time,note,x\n", HEAD])
def test_rows_behind_a_quote_of_another_program_stay(tmp_path: Path, head: bytes) -> None:
    path = tmp_path / "a"
    content = head + b'1,5" pipe,x\n2,b,x\n3,c,x\n'
    path.write_bytes(content)
    file = TextFile(settings(path, "csv"))
    file.send(READINGS[:1])
    file.close()
    assert path.read_bytes() == content + f"{TIME},pump,t,21.5,°C,\n".encode()


@pytest.mark.parametrize(
    "content",
    [b"\n\0\nSQLite", b"{}", b"time,note\n1,a\n2,b", HEAD + b"x" * (1 << 20)],
)
def test_what_no_output_has_written_is_not_removed(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a"
    path.write_bytes(content)
    file = TextFile(settings(path, "csv"))
    file.send(READINGS[:1])
    file.close()
    assert path.read_bytes().startswith(content + b"\n2")


def test_what_a_full_disk_cuts_off_is_removed(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "a.jsonl", "jsonl"))
    file.send(READINGS[:1])
    before = (tmp_path / "a.jsonl").read_bytes()
    real = file._open
    assert real is not None

    class Full:
        """Has room for ten more bytes."""

        def __init__(self, real: io.FileIO) -> None:
            self._real, self._left = real, 10

        def write(self, data: memoryview) -> int:
            if not self._left:
                raise OSError(28, "No space left on device")
            taken = self._real.write(data[: self._left])
            self._left -= taken
            return taken

        def __getattr__(self, name: str) -> Any:
            return getattr(self._real, name)

    file._open = Full(real)  # type: ignore[assignment]
    with pytest.raises(OSError, match="No space left"):
        file.send(READINGS[:1])
    assert (tmp_path / "a.jsonl").read_bytes() == before
    file._open = real
    file.send(READINGS[:1])
    file.close()
    assert (tmp_path / "a.jsonl").read_bytes() == before * 2


def test_a_folder_that_is_missing_is_an_error(tmp_path: Path) -> None:
    file = TextFile(settings(tmp_path / "no" / "a.csv", "csv"))
    with pytest.raises(OSError, match="No such file or directory"):
        file.send(READINGS)
    (tmp_path / "no").mkdir()
    file.send(READINGS)
    file.close()


def test_a_database_has_one_row_for_each_value(tmp_path: Path) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite"))
    database.send(READINGS)
    database.send([reading(2**64 - 1)])
    assert database._db is not None
    rows = database._db.execute("SELECT * FROM readings").fetchall()
    largest = database._db.execute("SELECT typeof(value) FROM readings ORDER BY value").fetchall()
    database.close()
    # None sorts first, text last.
    assert [kind for (kind,) in largest][1:4] == ["integer", "real", "real"]
    assert rows[0] == (TIME, "pump", "t", 21.5, "°C", None)
    values = [21.5, 1, "[1,2]", 'x,"y"\nz', "Af8=", None, float(2**64 - 1)]
    assert [row[3] for row in rows] == values
    assert rows[5][5] == "exception 02 (Illegal Data Address)"


def test_a_database_can_be_read_while_it_is_open(tmp_path: Path) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite"))
    database.send(READINGS[:1])
    with closing(sqlite3.connect(tmp_path / "a.db")) as other:
        assert other.execute("SELECT tag FROM readings").fetchall() == [("t",)]
    # Without the file that SQLite maps for a write-ahead log: a full disk would end the process.
    assert {file.name for file in tmp_path.iterdir()} <= {"a.db", "a.db-journal"}
    database.close()


def test_a_write_ahead_log_that_another_program_has_open_is_written(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    database = SqliteFile(settings(file, "sqlite"))
    with closing(sqlite3.connect(file)) as other:
        other.execute("PRAGMA journal_mode=WAL")
        other.execute("CREATE TABLE t (x)")
        database.send(READINGS[:1])
        assert other.execute("SELECT tag FROM readings").fetchall() == [("t",)]
    database.close()
    database.send(READINGS[1:2])
    database.close()
    with closing(sqlite3.connect(file)) as again:
        assert again.execute("PRAGMA journal_mode").fetchone() != ("wal",)
        assert again.execute("SELECT count(*) FROM readings").fetchone() == (2,)


def test_a_database_that_another_program_has_locked_does_not_hold_up_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database, stop = SqliteFile(settings(tmp_path / "a.db", "sqlite")), Stop()
    database.use_stop(stop)
    waits = []
    for _ in range(2):
        database.send(READINGS)
        assert database._db is not None
        waits += database._db.execute("PRAGMA busy_timeout").fetchone()
        stop.set()
        monkeypatch.setattr(sender, "STOP_TIMEOUT_S", 0.0)
    database.close()
    assert waits == [2000, 0]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows removes no open database")
@pytest.mark.parametrize("removed", ["a.db", "a.db*"])
def test_a_database_that_is_removed_is_made_again(tmp_path: Path, removed: str) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite"))
    database.send(READINGS[:1])
    for file in tmp_path.glob(removed):
        file.unlink()
    database.send(READINGS[1:2])
    database.close()
    with closing(sqlite3.connect(tmp_path / "a.db")) as again:
        assert again.execute("SELECT tag FROM readings").fetchall() == [("on",)]


def test_old_rows_go_when_a_database_is_too_large(tmp_path: Path) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite", max_bytes=2**20))
    for start in range(0, 40_000, 5000):
        database.send([reading(number, 1.7e9 + number) for number in range(start, start + 5000)])
    assert database._db is not None
    first, last, count = database._db.execute(
        "SELECT min(value), max(value), count(*) FROM readings"
    ).fetchone()
    database.close()
    assert (last, count) == (39_999, 40_000 - first)
    assert 0 < first < 35_000


def test_a_small_database_is_never_emptied(tmp_path: Path) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite", max_bytes=65536))
    counts = []
    for start in range(0, 2000, 100):
        database.send(numbered(100, start))
        assert database._db is not None
        rows = database._db.execute("SELECT value FROM readings ORDER BY rowid").fetchall()
        counts.append(len(rows))
        assert rows == [(number,) for number in range(start + 100 - len(rows), start + 100)]
    database.close()
    assert counts[-1] < 1000
    assert min(counts[5:]) > 200


def test_rows_are_stored_once_if_old_ones_can_not_be_removed(tmp_path: Path) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite", max_bytes=2**20))
    database.send(numbered(10_000))
    assert database._db is not None
    answers = {True: sqlite3.SQLITE_DENY, False: sqlite3.SQLITE_OK}
    # The next connection has no such rule.
    database._db.set_authorizer(lambda action, *_: answers[action == sqlite3.SQLITE_DELETE])
    with pytest.raises(OSError, match=r"a\.db: not authorized"):
        database.send(numbered(100, 10_000))
    database.send(numbered(100, 10_000))
    rows = database._db.execute("SELECT count(*) FROM readings WHERE value >= 10000").fetchone()
    database.close()
    assert rows == (100,)


def test_rows_of_a_clock_that_was_in_the_future_go_first(tmp_path: Path) -> None:
    database = SqliteFile(settings(tmp_path / "a.db", "sqlite", max_bytes=2**20))
    for start in (2.0e9, 1.7e9):
        for at in range(0, 20_000, 5000):
            database.send([reading(at, start + number) for number in range(at, at + 5000)])
    assert database._db is not None
    years = database._db.execute("SELECT DISTINCT substr(time, 1, 4) FROM readings").fetchall()
    database.close()
    assert years == [("2023",)]


def test_a_database_that_is_broken_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.db").write_bytes(b"no database" * 1000)
    with pytest.raises(OSError, match=r"a\.db: file is not a database"):
        SqliteFile(settings(tmp_path / "a.db", "sqlite")).send(READINGS)


def test_a_database_whose_damaged_schema_is_not_utf_8_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    with closing(sqlite3.connect(file)) as db:
        db.execute("CREATE TABLE readings (time)")
    file.write_bytes(file.read_bytes().replace(b"tablereadings", b"table\x9feadings"))
    with pytest.raises(OSError, match=r"a\.db: malformed"):
        SqliteFile(settings(file, "sqlite")).send(READINGS)
