"""How outputs send: in order, again after an outage, and what is left at the end."""

from __future__ import annotations

import threading
from math import inf
from typing import TYPE_CHECKING

import pytest

from holdfast.outputs import Buffer, OutputSender, Receiver, Refused
from holdfast.outputs import sender as module
from holdfast.outputs.buffer_file import BufferFile
from holdfast.runtime.stop import Stop
from support import wire
from support.readings import numbered, numbers, polls, tag

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from pathlib import Path

    from holdfast.polling import Reading


class Fake(Receiver):
    """A receiver that does what a test wants."""

    def __init__(self) -> None:
        self.sent: list[int] = []
        self.attempts = 0
        self.error: Exception | None = None
        self.closed = 0

    def send(self, readings: list[Reading]) -> None:
        self.attempts += 1
        if self.error is not None:
            raise self.error
        self.sent += numbers(readings)

    def close(self) -> None:
        self.closed += 1

    def status(self) -> dict[str, object]:
        return {"place": "here"}


class Running:
    """An output that runs in a thread."""

    def __init__(self, file: Path | None = None, buffer: Buffer | None = None) -> None:
        self.receiver, self.buffer, self.stop = Fake(), Buffer(), Stop()
        if buffer is not None:
            self.buffer = buffer
        self.open_file: Callable[[], BufferFile] | None = None
        if file is not None:
            self.open_file = lambda: BufferFile(file, 2**30, lambda *_: tag())
        self.renewed: list[Collection[tuple[str, str]] | None] = []
        self.start()

    def start(self) -> None:
        self.sender = OutputSender(
            "out", self.receiver, self.buffer, self.open_file, renew=self.renewed.append
        )
        self.thread = threading.Thread(target=self.sender.run, args=[self.stop])
        self.thread.start()

    def end(self) -> None:
        self.stop.set()
        self.thread.join(wire.DEADLINE)
        assert not self.thread.is_alive()


def refused(output: Running) -> int:
    counted = output.sender.status()["readings"]
    assert isinstance(counted, dict)
    return int(counted["refused"])


def count(caplog: pytest.LogCaptureFixture, event: str) -> int:
    return [record.message for record in caplog.records].count(event)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(module, name, 0.01)


@pytest.fixture(autouse=True)
def all_levels(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "holdfast")


@pytest.fixture
def output() -> Iterator[Running]:
    made = Running()
    yield made
    made.end()


def test_a_receiver_without_readings_has_its_turn_every_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    waits, stop = [], Stop()

    class Empty(Buffer):
        def take(self, most: int, seconds: float) -> list[Reading]:  # noqa: ARG002
            waits.append(seconds)
            return []

    class Idle(Fake):
        def idle(self) -> bool:
            self.attempts += 1
            if self.attempts == 3:
                stop.set()
            return False

    receiver = Idle()
    OutputSender("out", receiver, Empty()).run(stop)

    assert receiver.attempts == 3
    assert waits == [1.0] * 3


def test_everything_is_sent_in_order(output: Running) -> None:
    for start in range(0, 5000, 500):
        output.buffer.offer(polls(500, start))
    wire.until(lambda: len(output.receiver.sent) == 5000, "all is sent")
    assert output.receiver.sent == list(range(5000))
    assert output.sender.status() == {
        "place": "here",
        "connected": True,
        "readings": {"sent": 5000, "refused": 0, "dropped": 0},
        "waiting": 0,
        "failures": 0,
        "last_error": None,
        "file_error": None,
    }


def test_outputs_that_failed_together_do_not_try_again_together() -> None:
    """Many of them share a broker."""
    pauses = set()
    for _ in range(20):
        sender = OutputSender("out", Fake(), Buffer())
        sender._failed(OSError("no route to host"))
        pauses.add(sender._pause)
    assert len(pauses) > 10


@pytest.mark.parametrize("with_file", [False, True])
def test_nothing_is_lost_in_an_outage(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, with_file: bool
) -> None:
    output = Running(tmp_path / "b.db" if with_file else None)
    try:
        output.receiver.error = OSError("no route to host")
        output.buffer.offer(polls(1500))
        wire.until(lambda: output.receiver.attempts >= 3, "it is tried again")
        status = output.sender.status()
        assert (status["connected"], status["waiting"]) == (False, 1500)
        assert status["last_error"] == "no route to host"
        output.buffer.offer(polls(500, 1500))
        output.receiver.error = None
        wire.until(lambda: len(output.receiver.sent) == 2000, "all is sent")
        assert output.receiver.sent == list(range(2000))
    finally:
        output.end()
    assert count(caplog, "output_failed") == 1
    assert count(caplog, "output_back") == 1


def test_a_receiver_that_connects_without_readings_works_again(
    output: Running, caplog: pytest.LogCaptureFixture
) -> None:
    works = threading.Event()

    def idle() -> bool:
        if not works.is_set():
            raise OSError("no route to host")
        return True

    output.receiver.idle = idle  # type: ignore[method-assign]
    wire.until(lambda: output.sender.status()["connected"] is False, "it has failed")
    works.set()
    wire.until(lambda: output.sender.status()["connected"] is True, "it works")
    assert output.sender.status()["failures"] == 0
    assert count(caplog, "output_back") == 1


def test_what_is_refused_is_counted_and_not_tried_again(
    output: Running, caplog: pytest.LogCaptureFixture
) -> None:
    output.receiver.error = Refused("HTTP 400", numbered(3))
    output.buffer.offer(polls(3))
    wire.until(lambda: refused(output) == 3, "it is refused")
    output.receiver.error = None
    output.buffer.offer(polls(2, 3))
    wire.until(lambda: output.receiver.sent == [3, 4], "the rest is sent")
    assert count(caplog, "output_refused") == 1


def test_of_a_step_that_is_refused_in_part_the_rest_counts_as_sent(output: Running) -> None:
    output.receiver.error = Refused("of another type", numbered(1))
    output.buffer.offer(polls(3))
    wire.until(lambda: refused(output) == 1, "it is refused")
    counted = output.sender.status()["readings"]
    assert counted == {"sent": 2, "refused": 1, "dropped": 0}


def test_what_was_refused_is_replaced_now_and_then(
    output: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, but not again at each poll if that is refused too."""
    output.receiver.error = Refused("of another type", numbered(1))
    output.buffer.offer(polls(2))
    wire.until(lambda: output.renewed == [{("pump", "t")}], "it is replaced")
    output.buffer.offer(polls(2))
    wire.until(lambda: refused(output) == 2, "it is refused again")
    output.buffer.offer(polls(2))
    wire.until(lambda: refused(output) == 3, "it is refused once more")
    assert len(output.renewed) == 1
    monkeypatch.setattr(module, "RENEWAL_INTERVAL_S", 0.0)
    wire.until(lambda: len(output.renewed) == 2, "it is replaced again")
    output.receiver.error = None
    output.buffer.offer(polls(2))
    wire.until(lambda: output.receiver.sent, "all is taken")
    assert len(output.renewed) == 2


def test_what_was_dropped_is_replaced_when_the_receiver_works(output: Running) -> None:
    output.receiver.error = OSError("down")
    output.buffer.most = 2
    output.buffer.offer(polls(5))
    wire.until(lambda: output.receiver.attempts > 3, "it is tried again")
    assert output.buffer.dropped == 3
    assert output.renewed == []
    output.receiver.error = None
    wire.until(lambda: output.renewed == [None], "all is replaced")


def test_what_is_refused_at_the_end_is_not_kept(tmp_path: Path) -> None:
    output = Running()
    output.end()
    output.buffer.offer(polls(3))
    output.buffer.stored = BufferFile(tmp_path / "b.db", 2**30, lambda *_: tag())
    output.receiver.error = Refused("HTTP 400", numbered(3))
    output.sender._finish(inf)
    assert (refused(output), len(output.buffer)) == (3, 0)
    output.buffer.detach()


def test_an_error_that_ends_an_output_leaves_its_values_in_the_file(tmp_path: Path) -> None:
    receiver, buffer = Fake(), Buffer()
    receiver.error = RuntimeError("a bug")
    buffer.offer(polls(1500))
    file = tmp_path / "b.db"
    sender = OutputSender(
        "out", receiver, buffer, lambda: BufferFile(file, 2**30, lambda *_: tag())
    )
    with pytest.raises(RuntimeError, match="a bug"):
        sender.run(Stop())
    stored = BufferFile(file, 2**30, lambda *_: tag())
    assert stored.count == 1500
    stored.close()


def test_what_is_left_at_the_end_is_sent() -> None:
    output = Running()
    output.buffer.offer(polls(2500))
    output.end()
    assert output.receiver.sent == list(range(2500))
    assert output.receiver.closed == 1


@pytest.mark.parametrize(
    ("has_file", "is_followed", "sent"), [(False, False, 1500), (False, True, 0), (True, False, 0)]
)
def test_what_would_be_lost_after_an_outage_is_sent_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_file: bool, is_followed: bool, sent: int
) -> None:
    """The receiver works again, and the next attempt would come after the stop."""
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S"):
        monkeypatch.setattr(module, name, 3600.0)
    output = Running(tmp_path / "b.db" if has_file else None)
    output.sender._is_followed = lambda: is_followed
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(1500))
    wire.until(lambda: output.sender.status()["connected"] is False, "it has failed")
    output.receiver.error = None
    output.end()
    assert output.receiver.sent == list(range(sent))


def test_what_a_full_disk_does_not_take_after_an_outage_is_sent_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """That the disk is full shows only at the stop."""
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(module, name, 3600.0)
    output = Running(tmp_path / "b.db")
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(1500))
    wire.until(lambda: getattr(output.buffer.stored, "count", 0) == 1500, "it is stored")
    output.receiver.error = None

    def full(*_: object) -> int:
        raise OSError("no space left on device")

    monkeypatch.setattr(BufferFile, "add", full)
    output.buffer.offer(polls(10, 1500))
    output.end()
    assert output.receiver.sent == list(range(1510))
    assert count(caplog, "output_unsent") == 0


def test_what_can_not_be_sent_at_the_end_is_in_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    output = Running(tmp_path / "b.db")
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(1500))
    output.end()
    assert count(caplog, "output_unsent") == 0
    again = Running(tmp_path / "b.db")
    again.buffer.offer(polls(1, 1500))
    wire.until(lambda: len(again.receiver.sent) == 1501, "all is sent")
    again.end()
    assert again.receiver.sent == list(range(1501))
    assert again.renewed == []


def test_what_a_slow_disk_can_not_store_at_the_end_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CHECK_INTERVAL_S", 0)
    monkeypatch.setattr(module, "STORE_TIMEOUT_S", 0)
    output = Running(tmp_path / "b.db")
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(5))
    wire.until(lambda: output.receiver.attempts > 0, "it was tried")
    output.end()
    [record] = [record for record in caplog.records if record.message == "output_unsent"]
    assert vars(record)["fields"]["count"] == 5


@pytest.mark.parametrize("is_full", [False, True])
def test_what_waits_for_a_slow_receiver_is_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_full: bool
) -> None:
    output = Running(tmp_path / "b.db")
    if is_full:
        output.buffer.most = 5000
        monkeypatch.setattr(module, "CHECK_INTERVAL_S", wire.DEADLINE)
    send, offered = output.receiver.send, 0
    goes_on = threading.Event()

    def slow(readings: list[Reading]) -> None:
        nonlocal offered
        if not goes_on.is_set():
            output.buffer.offer(polls(1500, offered))
            offered += 1500
        send(readings)

    output.receiver.send = slow  # type: ignore[method-assign]
    output.buffer.offer(polls(1))
    offered = 1
    try:
        wire.until(lambda: output.buffer.stored and output.buffer.stored.count, "it is stored")
        goes_on.set()
        wire.until(lambda: len(output.receiver.sent) == offered, "all is sent")
    finally:
        goes_on.set()
        output.end()
    assert output.receiver.sent == list(range(offered))
    assert output.buffer.dropped == 0


def test_what_there_is_no_room_for_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    output = Running()
    output.receiver.error = OSError("down")
    output.buffer.most = 2
    output.buffer.offer(polls(5))
    wire.until(lambda: count(caplog, "output_dropped") > 0, "it is logged")
    output.end()
    logged = [record for record in caplog.records if record.message == "output_dropped"]
    assert sum(vars(record)["fields"]["count"] for record in logged) == output.buffer.dropped


def test_what_is_lost_at_the_end_is_told(caplog: pytest.LogCaptureFixture) -> None:
    output = Running()
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(5))
    output.end()
    [record] = [record for record in caplog.records if record.message == "output_unsent"]
    assert vars(record)["fields"]["count"] == 5


def test_a_buffer_keeps_what_waits_for_the_next_output() -> None:
    """As after a reload with other settings."""
    output = Running()
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(5))
    wire.until(lambda: output.receiver.attempts > 0, "it is tried")
    output.sender._is_followed = lambda: True
    output.end()
    output.receiver, output.stop = Fake(), Stop()
    output.start()
    wire.until(lambda: output.receiver.sent == [0, 1, 2, 3, 4], "all is sent")
    output.end()


def test_two_outputs_never_share_a_buffer() -> None:
    """As after a reload, while the receiver before holds up the end of its output."""
    before, goes_on = Running(), threading.Event()

    def slow(readings: list[Reading]) -> None:
        before.receiver.attempts += len(readings)
        goes_on.wait(wire.DEADLINE)
        raise OSError("down")

    before.receiver.send = slow  # type: ignore[method-assign]
    before.buffer.offer(polls(3))
    try:
        wire.until(lambda: before.receiver.attempts, "it is tried")
        before.sender._is_followed = lambda: True
        before.stop.set()
        second, third = Running(buffer=before.buffer), Running(buffer=before.buffer)
        second.end()
        assert second.receiver.attempts == 0
    finally:
        goes_on.set()
    wire.until(lambda: third.receiver.sent == [0, 1, 2], "all is sent")
    before.end()
    third.end()


def test_a_file_that_can_not_be_opened_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    output = Running(tmp_path / "missing" / "b.db")
    output.buffer.offer(polls(3))
    wire.until(lambda: output.receiver.sent == [0, 1, 2], "all is sent")
    assert "unable to open database file" in str(output.sender.status()["file_error"])
    (tmp_path / "missing").mkdir()
    output.buffer.offer(polls(1, 3))
    wire.until(lambda: output.sender.status()["file_error"] is None, "the file is opened")
    output.end()
    assert count(caplog, "output_file_failed") == 1


def test_a_file_that_is_opened_late_is_followed_by_the_last_values(tmp_path: Path) -> None:
    """What it has is older than what was sent meanwhile."""
    (tmp_path / "ready").mkdir()
    stored = BufferFile(tmp_path / "ready" / "b.db", 2**30, lambda *_: tag())
    stored.add([numbered(3)])
    stored.close()
    output = Running(tmp_path / "missing" / "b.db")
    output.buffer.offer(polls(1, 3))
    wire.until(lambda: output.receiver.sent == [3], "it is sent without the file")
    (tmp_path / "ready").rename(tmp_path / "missing")
    wire.until(lambda: output.receiver.sent == [3, 0, 1, 2], "the file is sent")
    output.end()
    assert output.renewed == [None]


def test_a_file_that_is_removed_in_an_outage_is_written_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "b.db"
    output = Running(file)
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(3))
    wire.until(lambda: getattr(output.buffer.stored, "count", 0) == 3, "it is stored")
    file.unlink()
    wire.until(lambda: count(caplog, "output_file_recreated") == 1, "it is logged")
    output.end()
    assert (count(caplog, "output_file_failed"), count(caplog, "output_unsent")) == (0, 0)
    again = Running(file)
    wire.until(lambda: again.receiver.sent == [0, 1, 2], "all is sent")
    again.end()


@pytest.mark.parametrize(("is_followed", "lost"), [(False, 4), (True, 3)])
def test_what_is_lost_with_a_folder_that_was_removed_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, is_followed: bool, lost: int
) -> None:
    folder = tmp_path / "removed"
    folder.mkdir()
    output = Running(folder / "b.db")
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(3))
    wire.until(lambda: getattr(output.buffer.stored, "count", 0) == 3, "it is stored")
    folder.rename(tmp_path / "moved")
    wire.until(lambda: count(caplog, "output_file_failed") == 1, "it is logged")
    output.buffer.offer(polls(1, 3))
    output.sender._is_followed = lambda: is_followed
    output.end()
    [record] = [record for record in caplog.records if record.message == "output_unsent"]
    assert vars(record)["fields"]["count"] == lost


def test_a_file_from_which_nothing_can_be_removed_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As on a full disk. Nothing is sent twice."""
    file = tmp_path / "b.db"
    stored = BufferFile(file, 2**30, lambda *_: tag())
    for start in range(0, 5000, 500):
        stored.add([numbered(500, start)])
    stored._db.execute(
        "CREATE TRIGGER full BEFORE DELETE ON readings BEGIN SELECT RAISE(ABORT, 'is full'); END"
    )
    stored.close()
    output = Running(file)
    output.buffer.offer(polls(5, 5000))
    wire.until(lambda: len(output.receiver.sent) >= 5005, "all is sent")
    wire.until(lambda: output.sender.status()["file_error"] is None, "there is a new file")
    output.end()
    assert output.receiver.sent == list(range(5005))
    assert (count(caplog, "output_file_failed"), count(caplog, "output_failed")) == (1, 0)


@pytest.mark.parametrize("is_aside", [True, False])
def test_a_damaged_file_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, is_aside: bool
) -> None:
    """Nor if it can't be renamed: it is not opened again, to fail at the same place."""
    file = tmp_path / "b.db"
    if not is_aside:
        (tmp_path / "b.db.damaged").mkdir()
    stored = BufferFile(file, 2**30, lambda *_: tag())
    for start in range(0, 5000, 1000):
        stored.add([numbered(1000, start)])
    [pages] = stored._db.execute("PRAGMA page_count").fetchone()
    stored.close()
    with file.open("r+b") as damaged:
        damaged.seek(4096 * (pages // 2 - 1))
        damaged.write(b"\xa5" * 4096)
    output = Running(file)
    wire.until(lambda: output.buffer.dropped, "the rest of the file is lost")
    for number in range(5000, 5005):
        output.buffer.offer(polls(1, number))
        wire.until(lambda: output.receiver.sent[-1:] == [number], "it is sent")  # noqa: B023
    output.end()
    assert len(output.receiver.sent) + output.buffer.dropped == 5005
    assert file.exists()
    assert (output.sender.status()["file_error"] is None) is is_aside
    assert count(caplog, "output_file_failed") == count(caplog, "output_dropped") == 1
    assert count(caplog, "output_failed") == 0


def test_a_file_that_fails_is_logged_once_in_an_outage(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    output = Running(tmp_path / "missing" / "b.db")
    output.receiver.error = OSError("down")
    output.buffer.offer(polls(3))
    wire.until(lambda: output.receiver.attempts > 3, "it is tried again")
    output.end()
    assert count(caplog, "output_file_failed") == 1
