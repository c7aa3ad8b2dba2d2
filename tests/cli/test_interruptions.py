"""A signal ends a search, but not the output of a finding."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast import SyncClient, _core
from holdfast.cli.signals import (
    Interrupted,
    Signals,
    ended_by_ctrl_c,
    ending_signals,
    interruptions,
    keep_hangups,
)
from support import wire
from support.cli import answer, failure, invoke
from support.fake_device import FakeDevice

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)


def test_a_signal_ends_a_search_after_what_must_not_be_cut() -> None:
    done: list[str] = []

    def search(signals: Signals) -> None:
        with signals.interrupting():
            with signals.held():
                signal.raise_signal(signal.SIGTERM)
                done.append("line")
            done.append("search")

    with interruptions() as signals:
        with pytest.raises(Interrupted):
            search(signals)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
        done.append("output")
    assert done == ["line", "output"]


def test_a_signal_behind_the_search_does_not_cut_the_output() -> None:
    done: list[str] = []
    with interruptions() as signals:
        with signals.interrupting():
            done.append("search")
        signal.raise_signal(signal.SIGTERM)
        done.append("output")
        with pytest.raises(Interrupted), signals.interrupting():
            done.append("next search")
    assert done == ["search", "output"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGHUP")
def test_sighup_while_handlers_are_set_is_a_reload(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = list(ending_signals())
    before = {number: signal.getsignal(number) for number in numbers}
    set_handler = signal.signal

    def hang_up(after: signal.Signals) -> None:
        left = [after]

        def signal_then_hangup(number: signal.Signals, handler: Any) -> None:
            set_handler(number, handler)
            if number in left:
                left.clear()
                signal.raise_signal(signal.SIGHUP)

        monkeypatch.setattr("holdfast.cli.signals._early_hangups", [])
        keep_hangups()
        with monkeypatch.context() as patched:
            patched.setattr(signal, "signal", signal_then_hangup)
            signals = Signals(reload="always")
        assert (signals.received, signals.take_reload()) == (False, True), after

    try:
        for number in numbers:
            hang_up(number)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_handlers_are_as_before_when_the_command_ends() -> None:
    handlers: dict[signal.Signals, Any] = {
        signal.SIGTERM: signal.SIG_IGN,
        signal.SIGINT: signal.default_int_handler,
    }
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        with interruptions():
            assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
            assert signal.getsignal(signal.SIGINT) != signal.default_int_handler
        assert {number: signal.getsignal(number) for number in handlers} == handlers
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("words", "places"),
    [
        (("hr", "3", "1"), "holding_registers 3 was"),
        (("co", "3", "1", "0"), "coils 3 to 4 were"),
        (("hr", "3", "1.5", "--type", "float32"), "holding_registers 3 to 4 were"),
        (("file:4:7", "1"), "file 4 record 7 was"),
        (("file:4:7", "1", "2"), "file 4 records 7 to 8 were"),
    ],
)
def test_a_write_that_is_interrupted_was_possibly_carried_out(
    monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], places: str
) -> None:
    def interrupted(*_arguments: object, **_more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(SyncClient, "write", interrupted)
    monkeypatch.setattr(SyncClient, "write_file_record", interrupted)
    url = "tcp://127.0.0.1:1"
    write = ("write", url, *words)
    assert failure(*write) == [
        f"holdfast: {url}: interrupted",
        f"hint: {places} possibly written",
    ]
    found = answer(*write, code=1)
    assert (found["ok"], found["reason"]) == (False, "interrupted")
    assert (found["target"], found["maybe_written"]) == (url, True)


STOPS = """
import signal
from functools import partial
from holdfast.cli.signals import on_ctrl_z
say = partial(partial, print, flush=True)
signal.signal(signal.SIGTSTP, signal.SIG_DFL)
for _ in range(2):
    with on_ctrl_z(say("keys left"), say("keys")), on_ctrl_z(say("screen left"), say("screen")):
        signal.raise_signal(signal.SIGTSTP)
print(signal.getsignal(signal.SIGTSTP) == signal.SIG_DFL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTSTP")
def test_ctrl_z_stops_after_the_modes_of_the_terminal_are_left(tmp_path: Path) -> None:
    output = tmp_path / "output"
    left, entered = ["screen left", "keys left"], ["keys", "screen"]
    with output.open("w") as file:
        # A group of its own: SIGTSTP does not stop an orphaned one.
        process = subprocess.Popen([sys.executable, "-c", STOPS], stdout=file, process_group=0)
    try:
        for shown in (left, [*left, *entered, *left]):
            assert os.WIFSTOPPED(os.waitpid(process.pid, os.WUNTRACED)[1])
            assert output.read_text().splitlines() == shown
            process.send_signal(signal.SIGCONT)
        assert process.wait(wire.DEADLINE) == 0
        assert output.read_text().splitlines() == [*left, *entered, *left, *entered, "True"]
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def heard() -> Iterator[None]:
    """Signals count, also if the tests run in the background of a shell, or under nohup."""
    usual: dict[signal.Signals, Any] = {
        signal.SIGINT: signal.default_int_handler,
        HANGUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


INTERRUPTED_IMPORT = """
import importlib.abc, signal, sys

class Interrupts(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == sys.argv[1]:
            signal.raise_signal(signal.SIGINT)

signal.signal(signal.SIGINT, signal.{handler})
sys.meta_path.insert(0, Interrupts())
from holdfast.cli import main
main(["check", "--help"])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no exit codes of signals")
@pytest.mark.parametrize("module", ["click", "holdfast.cli.appliance.check"])
@pytest.mark.parametrize(
    ("handler", "code"), [("default_int_handler", -signal.SIGINT), ("SIG_IGN", 0)]
)
def test_ctrl_c_while_a_command_is_imported_ends_it_without_a_traceback(
    module: str, handler: str, code: int
) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_IMPORT.format(handler=handler), module],
        capture_output=True,
        text=True,
        check=False,
        timeout=wire.DEADLINE,
    )
    assert (ended.returncode, ended.stderr) == (code, "")


@pytest.mark.usefixtures("heard")
def test_ctrl_c_is_an_exception_again_after_an_import() -> None:
    with ended_by_ctrl_c():
        assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
    found: list[Any] = []

    def in_another_thread() -> None:
        with ended_by_ctrl_c():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=in_another_thread)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]


@pytest.mark.usefixtures("heard")
def test_process_1_is_ended_at_once_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container. The kernel ignores signals that such a process has no handler for."""
    codes: list[int] = []

    def receive(number: signal.Signals) -> None:
        assert signal.getsignal(number) != signal.SIG_DFL
        signal.raise_signal(number)

    monkeypatch.setattr(os, "getpid", lambda: 1)
    monkeypatch.setattr(os, "_exit", codes.append)
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with ended_by_ctrl_c():
            receive(signal.SIGINT)
        receive(signal.SIGTERM)
        with interruptions():
            receive(signal.SIGTERM)
            receive(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert codes == [130, 143, 143]


@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize(
    ("name", "words"),
    [("read", ("hr", "0")), ("describe guess", ("hr", "0")), ("describe identify", ())],
)
def test_a_command_that_is_interrupted_says_so(name: str, words: tuple[str, ...]) -> None:
    with FakeDevice(lambda _: signal.raise_signal(signal.SIGINT)) as device:
        command = (*name.split(), device.url, *words, "--timeout", "60")
        assert failure(*command) == ["holdfast: interrupted"]
        assert answer(*command, code=1) == {
            "ok": False,
            "target": device.url,
            "reason": "interrupted",
            "detail": "interrupted",
        }


@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize("number", list(dict.fromkeys([signal.SIGINT, signal.SIGTERM, HANGUP])))
def test_what_was_written_is_told_if_reading_it_back_is_interrupted(
    tmp_path: Path, number: signal.Signals
) -> None:
    def answers(pdu: bytes) -> bytes | None:
        if pdu[0] == 3:
            signal.raise_signal(number)
            return None
        return pdu

    file = tmp_path / "tags.yaml"
    file.write_text("tags: {level: {area: holding_registers, address: 3, writable: true}}")
    with FakeDevice(answers) as device:
        url, options = device.url, ("--verify", "--timeout", "60")
        plain, tagged = (
            ("write", url, "hr", "3", "7"),
            ("write", url, "level=7", "--tags", str(file)),
        )
        assert invoke(*plain, *options).stderr.splitlines() == [
            "Written: holding_registers 3, 1 request; could not be read back",
            f"holdfast: {url}: interrupted",
        ]
        assert invoke(*tagged, *options).output.splitlines() == [
            "Written: level = 7",
            "Could not be read back.",
            f"holdfast: {url}: interrupted",
        ]
        for words, written in ((plain, 1), (tagged, ["level"])):
            found = answer(*words, *options, code=1)
            assert (found["ok"], found["reason"]) == (False, "interrupted")
            assert (found["written"], found["maybe_written"]) == (written, False)


@pytest.mark.parametrize("values", [(), ("--values",)])
def test_a_replay_that_is_interrupted_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, values: tuple[str, ...]
) -> None:
    class Reader:
        """Reads a log whose end never comes."""

        ended = False
        sequence = 0

        def __init__(self, *_arguments: object, **_more: object) -> None:
            pass

        def next(self, _timeout: float) -> None:
            signal.raise_signal(signal.SIGTERM)

    config = tmp_path / "plant.yaml"
    plant = {"holding_registers": 10, "replicate": {"log": "site"}}
    log = {"servers": ["nats://127.0.0.1:1"], "node": "a"}
    rest = {"bind": "127.0.0.1:0", "sources": ["127.0.0.0/8"], "tokens": "none"}
    parts = {"memories": {"plant": plant}, "logs": {"site": log}, "rest": rest}
    config.write_text(json.dumps(parts))
    monkeypatch.setattr(_core, "LogReader", Reader)
    replay = ("log", "replay", str(config), *values)
    before = {number: signal.getsignal(number) for number in ending_signals()}
    try:
        result = invoke(*replay)
        assert (result.exit_code, result.output) == (1, "holdfast: interrupted\n")
        result = invoke(*replay, "--json")
        found = json.loads(result.stdout)
        assert (result.exit_code, found["ok"], found["reason"]) == (1, False, "interrupted")
        assert found["target"] == str(config)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
