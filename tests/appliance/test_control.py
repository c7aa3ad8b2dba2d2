"""The socket for requests from the appliance's own machine: who finds it, and that it recovers."""

from __future__ import annotations

import errno
import os
import socket
import sys
import tempfile
import threading
from contextlib import ExitStack, suppress
from functools import partial
from multiprocessing.connection import Client, Listener
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import control
from holdfast.appliance.control import Control
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.connection import Connection

FILE = Path("plant.yaml")


class Accepting:
    """Replaces `accept`: for `failures` calls, there are no free file descriptors."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls = 0
        self.failures = 0
        listeners = Listener if sys.platform == "win32" else control._UnixListener
        accept = listeners.accept

        def accepted(listener: Any) -> Connection:
            self.calls += 1
            if self.calls <= self.failures:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
            return accept(listener)

        monkeypatch.setattr(listeners, "accept", accepted)


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    # The path of a socket is short, and those of tests can be long.
    with tempfile.TemporaryDirectory(prefix="hf") as folder:
        monkeypatch.setenv("RUNTIME_DIRECTORY", folder)
        monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        yield Path(folder)


@pytest.fixture
def accepting(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Accepting:  # noqa: ARG001
    return Accepting(monkeypatch)


def pinged(file: Path) -> bool:
    try:
        return "path" in control.ask(file, "ping", within_s=wire.DEADLINE, ping_s=wire.DEADLINE)
    except control.NotRunning:
        return False


def test_it_pauses_after_an_error_and_a_stop_ends_the_pause(
    accepting: Accepting, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepting.failures = 1_000_000
    for pause in ("FIRST_PAUSE_S", "MAX_PAUSE_S"):
        monkeypatch.setattr(control, pause, 3600.0)
    before = set(threading.enumerate())
    running = Control(FILE, {})
    [thread] = set(threading.enumerate()) - before
    wire.until(lambda: accepting.calls, "the first attempt")
    running.close()
    assert not thread.is_alive()
    assert accepting.calls == 1


def test_it_answers_again_after_errors(accepting: Accepting) -> None:
    accepting.failures = 2
    running = Control(FILE, {})
    try:
        assert pinged(FILE)
        assert accepting.calls > accepting.failures
    finally:
        running.close()


@pytest.mark.usefixtures("runtime")
def test_a_path_need_not_be_utf_8() -> None:
    file = Path("pl\udce9.yaml")  # As Python has a name with the byte E9.
    running = Control(file, {})
    try:
        assert pinged(file)
    finally:
        running.close()


@pytest.mark.skipif(sys.platform == "win32", reason="has paths in Unicode")
@pytest.mark.usefixtures("runtime")
def test_a_start_with_another_locale_notices_it() -> None:
    running = Control(Path("Kühlung.yaml"), {})
    try:
        # The same bytes, as Python has them with the locale C.
        assert control.is_running(Path("K\udcc3\udcbchlung.yaml"))
    finally:
        running.close()


@pytest.mark.usefixtures("runtime")
def test_one_that_does_not_answer_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def ask(*_: object) -> None:
        raise control.NotRunning("the appliance has not answered")

    monkeypatch.setattr(control, "ask", ask)
    running = Control(FILE, {})
    try:
        assert control.is_running(FILE)
    finally:
        running.close()
    assert not control.is_running(FILE)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes have no folders")
def test_it_is_found_on_a_full_disk(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gettempdir() -> str:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(control, "RUN", runtime / "run")
    monkeypatch.setenv("TMPDIR", str(runtime))
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    running = Control(FILE, {})
    try:
        monkeypatch.setattr(tempfile, "gettempdir", gettempdir)
        assert pinged(FILE)
        assert control.is_running(FILE)
    finally:
        running.close()


@pytest.mark.usefixtures("runtime")
def test_it_answers_although_no_thread_can_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "TIMEOUT_S", 3600.0)
    start = threading.Thread.start

    def started(thread: threading.Thread) -> None:
        if thread.name == "holdfast-control":
            raise RuntimeError("can't start new thread")
        start(thread)

    running = Control(FILE, {})
    try:
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", started)
            assert [pinged(FILE), pinged(FILE)] == [True, True]
            # A caller that sends nothing holds up the next one, and a stop, for a moment only.
            with Client(control._addresses(FILE)[0]):
                assert pinged(FILE)
        assert pinged(FILE)
    finally:
        running.close()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no callers that wait")
def test_callers_that_nobody_accepts_hold_up_neither_another_start_nor_a_stop(
    runtime: Path, accepting: Accepting, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepting.failures = 1_000_000
    monkeypatch.setattr(control, "FIRST_PAUSE_S", 3600.0)
    monkeypatch.setattr(control, "MAX_PAUSE_S", 3600.0)
    with ExitStack() as callers:
        running = Control(FILE, {})
        with suppress(BlockingIOError):
            while True:  # Until no more may wait.
                caller = callers.enter_context(socket.socket(socket.AF_UNIX))
                caller.setblocking(False)
                caller.connect(str(*runtime.iterdir()))
        with pytest.raises(OSError, match="in use"):
            Control(FILE, {})
        running.close()
    assert not list(runtime.iterdir())


@pytest.mark.usefixtures("runtime")
@pytest.mark.parametrize("closed", ["folder", "file"])
def test_a_user_who_may_not_read_the_file_is_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, closed: str
) -> None:
    """As without `sudo`. Tests may run as root, who may read everything."""
    file = tmp_path / "plant.yaml"
    file.touch()
    if closed == "folder":
        stat = Path.stat

        def refused(path: Path, **options: bool) -> os.stat_result:
            if path == file:
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return stat(path, **options)

        monkeypatch.setattr(Path, "stat", refused)
    else:
        monkeypatch.setattr(os, "access", lambda path, _: path != file)
    with pytest.raises(
        control.NotRunning, match=r"this user may not read it \(try sudo\), and no "
    ):
        control.ask(file, "sessions", within_s=wire.DEADLINE, ping_s=wire.DEADLINE)


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
@pytest.mark.usefixtures("runtime")
def test_it_is_found_by_its_path_when_a_symbolic_link_on_the_way_is_replaced(
    tmp_path: Path,
) -> None:
    first, second, other = tmp_path / "first", tmp_path / "second", tmp_path / "other.yaml"
    for folder in (first, second):
        folder.mkdir()
        (folder / "plant.yaml").touch()
    link = tmp_path / "current"
    link.symlink_to(first)
    file = link / "plant.yaml"
    other.symlink_to(first / "plant.yaml")
    running = Control(file, {})
    try:
        # Also by another path to the same file.
        assert [pinged(each) for each in (file, first / "plant.yaml", other)] == [True] * 3
        link.unlink()
        link.symlink_to(second)
        assert pinged(file)
        assert not pinged(second / "plant.yaml")
    finally:
        running.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
@pytest.mark.usefixtures("runtime")
def test_of_two_appliances_each_is_found_by_the_path_that_it_was_started_with(
    tmp_path: Path,
) -> None:
    file, link = tmp_path / "plant.yaml", tmp_path / "link.yaml"
    file.touch()
    link.symlink_to(file)
    sockets = [Control(each, {"path": partial(dict, name=each.name)}) for each in (file, link)]
    try:
        for each in (file, link):
            assert control.ask(each, "path")["name"] == each.name
    finally:
        for running in sockets:
            running.close()


@pytest.mark.skipif(sys.platform == "win32", reason="pipes have no folders")
@pytest.mark.parametrize(
    ("folder", "is_found"),
    [
        ("run/holdfast-two", True),
        ("run/user/{user}/holdfast", True),
        ("run/user/{other}/holdfast", False),
        ("tmp/holdfast-{user}", True),
        ("tmp/holdfast-{other}", False),
        ("tmp/holdfast-two", False),
    ],
)
def test_root_finds_appliances_of_others_in_folders_that_only_they_can_make(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, folder: str, is_found: bool
) -> None:
    user = os.getuid()
    made = runtime / folder.format(user=user, other=user + 1)
    made.mkdir(parents=True)
    monkeypatch.setattr(control, "RUN", runtime / "run")
    monkeypatch.setenv("TMPDIR", str(runtime / "tmp"))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(made))
    running = Control(FILE, {})
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    try:
        monkeypatch.setattr(control, "_user", lambda: user + 2)
        assert not pinged(FILE)
        monkeypatch.setattr(control, "_user", lambda: 0)
        assert pinged(FILE) == is_found
    finally:
        running.close()
