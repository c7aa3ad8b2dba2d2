"""`holdfast reload` and `holdfast sessions` as a user has them, and the signal that reloads."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import control
from holdfast.appliance.control import ask
from holdfast.cli.services import run
from support import wire
from support.cli import RunCommand, answer, done, failure, invoke
from support.commands import Command

if TYPE_CHECKING:
    from collections.abc import Iterator

CONFIGURATION = """
memories:
  plant: {{holding_registers: {size}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules:
      - {{sources: [127.0.0.0/8], units: {{1: plant}}, access: {access}}}
{more}
"""

WRITE = bytes.fromhex("0600070001")
FORBIDDEN = bytes.fromhex("8601")


class Running:
    """A running appliance, whose log is in a file."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "plant.yaml"
        self.write()
        self.command = RunCommand(self.file)
        self.address = self.command.wait_until_it_serves()

    def write(self, *, size: int = 100, access: str = "read-write", more: str = "") -> None:
        self.file.write_text(CONFIGURATION.format(size=size, access=access, more=more))

    def replace(self, *, access: str, more: str) -> None:
        """Renames a complete file into place."""
        new = self.file.with_suffix(".new")
        new.write_text(CONFIGURATION.format(size=100, access=access, more=more))
        new.rename(self.file)

    def end(self) -> str:
        code, log = self.command.end(signal.SIGTERM)
        assert code == 0
        assert "Traceback" not in log
        return log


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    # The path of a socket is short, and those of tests can be long.
    with tempfile.TemporaryDirectory(prefix="hf") as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        made = Running(tmp_path)
        yield made
        made.command.process.kill()
        made.command.process.communicate()


def test_reload_says_what_has_changed(running: Running) -> None:
    with wire.Connection(running.address) as client:
        assert client.ask(WRITE) == WRITE
        running.write(access="read-only")
        assert done("reload", str(running.file)) == ["Reloaded: listeners.scada"]
        assert client.ask(WRITE) == FORBIDDEN
        assert done("reload", str(running.file)) == ["Reloaded: nothing has changed"]
    log = running.end()
    assert "info reloaded changed=listeners.scada sha256=" in log


def test_a_wrong_configuration_changes_nothing_and_every_problem_is_printed(
    running: Running,
) -> None:
    with wire.Connection(running.address) as client:
        running.write(access="read-only", more="workers: 0\nlog: {level: loud}")
        result = invoke("reload", str(running.file))
        lines = result.stderr.splitlines()
        assert (result.exit_code, result.stdout, len(lines)) == (2, "", 3)
        assert "workers: found 0, allowed: " in lines[1] + lines[0]
        assert lines[2] == "Nothing has changed."
        running.write(size=101)
        result = invoke("reload", str(running.file))
        reason = "memories.plant: areas or seal changed; requires a restart"
        assert result.stderr == f"{running.file}: {reason}\nNothing has changed.\n"
        assert client.ask(WRITE) == WRITE
    log = running.end()
    assert log.count("error reload_refused problem=") == 3


def test_warnings_of_a_reload_are_those_of_check(running: Running) -> None:
    running.file.write_text(
        running.file.read_text()
        + "      - {sources: [127.0.0.1], units: {1: plant}, access: read-only}\n"
    )
    checked = invoke("check", str(running.file))
    assert "warning: " in checked.stderr
    result = invoke("reload", str(running.file))
    assert (result.exit_code, result.stderr) == (0, checked.stderr)
    assert "warning config_warning warning=" in running.end()


def test_initial_values_are_said_to_wait_for_the_next_start(running: Running) -> None:
    text = running.file.read_text()
    (running.file.parent / "values.csv").write_text("holding_registers,1,5\n")
    running.file.write_text(text.replace("{holding_", "{initial: values.csv, holding_"))
    told = "Reloaded: memories.plant (initial values at the next start)"
    assert done("reload", str(running.file)) == [told]
    assert "info reloaded changed=memories.plant sha256=" in running.end()


def test_sighup_reloads_also_that_of_a_closed_terminal(running: Running) -> None:
    with wire.Connection(running.address) as client:
        running.write(access="read-only")
        running.command.process.send_signal(signal.SIGHUP)
        wire.until(lambda: client.ask(WRITE) == FORBIDDEN, "the rule has changed")
    assert "info reloaded" in running.end()


HANGUP_AT_IMPORT = """
import os, signal, sys

class Hangup:
    def find_spec(self, name, *_):
        if name == "holdfast.cli.services.run":
            os.kill(os.getpid(), signal.SIGHUP)

from holdfast.cli import main
sys.meta_path.insert(0, Hangup())
main(prog_name="holdfast")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGHUP")
def test_sighup_before_the_configuration_is_read_reloads_after_the_start(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(CONFIGURATION.format(size=100, access="read-only", more=""))
    command = [sys.executable, "-c", HANGUP_AT_IMPORT, "run", str(file)]
    log = tmp_path / "log"
    with (
        log.open("w") as stderr,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr) as process,
    ):
        try:
            wire.until(lambda: "info reloaded" in log.read_text(), "it has reloaded")
            process.terminate()
            assert process.wait(wire.DEADLINE) == 0
        finally:
            process.kill()


def test_a_watched_file_reloads_when_another_one_takes_its_place(
    running: Running,
) -> None:
    watch = "reload: on-change"
    with wire.Connection(running.address) as client:
        running.write(more=watch)
        assert done("reload", str(running.file)) == ["Reloaded: reload"]
        running.replace(access="read-only", more=watch)
        wire.until(lambda: client.ask(WRITE) == FORBIDDEN, "the file was noticed")
        running.replace(access="wrong", more=watch)
        running.replace(access="read-write", more=watch)
        wire.until(lambda: client.ask(WRITE) == WRITE, "it was noticed again")
    log = running.end()
    assert log.count("info reloaded") == 3


def test_sessions_are_listed_and_ended(running: Running) -> None:
    assert done("sessions", str(running.file)) == ["no open connections"]
    with wire.Connection(running.address) as first, wire.Connection(running.address) as second:
        assert first.ask(WRITE) == second.ask(WRITE) == WRITE
        head, *rows = done("sessions", str(running.file))
        assert head.split() == ["id", "peer", "opened", "idle", "role", "subject", "serial"]
        peers = ["{}:{}".format(*each.socket.getsockname()) for each in (first, second)]
        assert [row.split()[1] for row in rows] == peers
        ids = [row.split()[0] for row in rows]
        assert ids == ["scada/0", "scada/1"]
        assert done("sessions", str(running.file), "--end", ids[1]) == ["ended scada/1"]
        assert second.rest() == b""
        assert first.ask(WRITE) == WRITE
        (left,) = answer("sessions", str(running.file))["sessions"]
        assert left["session"] == ids[0]
        assert (left["listener"], left["id"], left["peer"]) == ("scada", 0, peers[0])
        gone = failure("sessions", str(running.file), "--end", ids[1])
        assert gone == ["holdfast: scada/1: no such connection"]
    for wrong in ("scada", "17", "/17", "scada/x", f"scada/{2**64}"):
        assert invoke("sessions", str(running.file), "--end", wrong).exit_code == 2
    log = running.end()
    assert f"session_ended session=scada/1 session_peer={peers[1]}" in log
    assert 'source="holdfast sessions"' in log


def test_without_an_appliance_both_say_so(tmp_path: Path) -> None:
    file, none = tmp_path / "other.yaml", "no appliance of this user runs it on this machine"
    for command in ("reload", "sessions"):
        (line,) = failure(command, str(file))
        assert line.startswith(f"holdfast: {file}: no such file, and {none}")
        file.touch()
        (line,) = failure(command, str(file))
        assert line.startswith(f"holdfast: {file}: {none}")
        file.unlink()


@pytest.mark.usefixtures("running")
def test_only_the_user_of_the_appliance_can_open_the_control_socket() -> None:
    (found,) = Path(os.environ["XDG_RUNTIME_DIR"]).glob("holdfast/*.sock")
    assert stat.S_IMODE(found.stat().st_mode) == 0o600
    assert stat.S_IMODE(found.parent.stat().st_mode) == 0o700


def test_a_wrong_request_at_the_control_socket_is_answered_with_an_error(running: Running) -> None:
    assert "invalid request" in ask(running.file, "dance")["error"]
    assert "invalid request" in ask(running.file, "end", other=1)["error"]
    assert ask(running.file, "sessions") == {"sessions": []}


def test_the_socket_of_a_killed_appliance_is_taken_over(running: Running) -> None:
    running.command.process.kill()
    running.command.process.communicate()
    running.command = RunCommand(running.file)
    running.command.wait_until_it_serves()
    assert done("sessions", str(running.file)) == ["no open connections"]
    assert "control_unavailable" not in running.end()


def test_a_second_start_of_the_same_file_says_that_it_runs(running: Running) -> None:
    second = Command("run", str(running.file))
    problem = f"holdfast: {running.file}: another appliance of this user runs it on this machine\n"
    try:
        assert second.wait(wire.DEADLINE) == 1
    finally:
        second.kill()
    assert second.communicate() == ("", problem)
    assert done("sessions", str(running.file)) == ["no open connections"]


def test_of_two_that_start_at_the_same_time_one_ends(
    running: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    """When the other one looked, this one did not have its socket yet."""
    unused: Any = SimpleNamespace(ask=None)
    with pytest.raises(SystemExit, match="1"):
        run._control(unused, unused, running.file)
    assert "another appliance of this user runs it" in capsys.readouterr().err


def test_one_that_can_start_no_thread_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def configure(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("holdfast.events.log_lines.configure", configure)
    unused: Any = SimpleNamespace(log=SimpleNamespace(level="info", format="text"))
    with pytest.raises(SystemExit, match="1"):
        run.serve(unused, unused)
    assert capsys.readouterr().err == "holdfast: can't start new thread\n"


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
def test_another_path_to_the_same_file_can_be_started(running: Running) -> None:
    other = running.file.with_name("other.yaml")
    other.symlink_to(running.file)
    second = RunCommand(other)
    second.wait_until_it_serves()
    assert control.is_running(other)
    running.end()
    # It answers requests for the other path, too, but does not run that.
    assert not control.is_running(running.file)
    assert second.end(signal.SIGTERM)[0] == 0


def test_a_start_with_another_folder_for_sockets_is_noticed(
    running: Running, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Such as that of a service, and one by hand."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    assert control.is_running(running.file)


@pytest.mark.skipif(sys.platform == "win32", reason="other systems have no such file")
def test_a_stream_is_another_configuration_each_time(running: Running) -> None:
    stream = Path("/dev/stdin")
    first = control.Control(stream, {})
    try:
        assert control.is_running(running.file)
        assert not control.is_running(stream)
    finally:
        first.close()
