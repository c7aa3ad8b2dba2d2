"""The process of a service, with a whole appliance in it and the requests of Windows to it."""

from __future__ import annotations

import re
import threading
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any

import click
import pytest

from holdfast.appliance.windows_service.log_file import LogFile
from support import fake_windows, wire
from support.cli import invoke
from support.renaming import not_renamed

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CONFIGURATION = """
memories:
  plant: {holding_registers: 10}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: ACCESS}]
"""
START_PENDING = (fake_windows.START_PENDING, 0, 180_000)
ACCEPTED = 1 | 4 | 8
"""Stop, shutdown, and changed parameters."""
RUNNING = (fake_windows.RUNNING, ACCEPTED, 5000)
STOP_PENDING = (fake_windows.STOP_PENDING, ACCEPTED, 20_000)


class Hosting:
    """`holdfast service host` in a thread, as the service control manager sees it."""

    def __init__(self, windows: fake_windows.Windows, folder: Path) -> None:
        self.windows = windows
        self.file = folder / "plant.yaml"
        self.log = folder / "Holdfast" / "holdfast-plant.log"
        self.service: Any = None
        self.failure: BaseException | None = None
        windows.dispatch = self._run
        self._thread = threading.Thread(target=lambda: invoke("service", "host", str(self.file)))

    def start(self, access: str = "read-write") -> None:
        self.file.write_text(CONFIGURATION.replace("ACCESS", access))
        self._thread.start()

    def _run(self) -> None:
        self.service = self.windows.hosted(["holdfast-plant"])
        try:
            self.service.SvcRun()
        except Exception as error:
            self.failure = error

    def wait_for(self, event: str) -> str:
        wire.until(lambda: self._logged(event), f"{event} is logged")
        return self._logged(event)

    def wait_until_running(self) -> None:
        wire.until(lambda: RUNNING in self.windows.reported, "the service runs")

    def _logged(self, event: str) -> str:
        text = self.log.read_text() if self.log.exists() else ""
        return next((line for line in text.splitlines() if f" {event}" in line), "")

    def join(self) -> None:
        self._thread.join(wire.DEADLINE)
        assert not self._thread.is_alive()


@pytest.fixture
def hosting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hosting]:
    windows = fake_windows.Windows()
    windows.install(monkeypatch)
    monkeypatch.setenv("PROGRAMDATA", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    made = Hosting(windows, tmp_path)
    yield made
    if made.service is not None:
        made.service.control.request_stop()
    made.join()


@pytest.mark.parametrize("request_name", ["SvcStop", "SvcShutdown"])
def test_windows_knows_each_state_and_can_stop_the_service(
    hosting: Hosting, request_name: str
) -> None:
    hosting.start()
    hosting.wait_for("started")
    address = re.search(r"address=127\.0\.0\.1:(\d+)", hosting.wait_for("listening"))
    assert address is not None
    hosting.wait_until_running()
    assert hosting.windows.reported == [START_PENDING, RUNNING]
    with wire.Connection(("127.0.0.1", int(address[1]))) as client:
        assert client.ask(bytes.fromhex("0300000001")) == bytes.fromhex("03020000")
    getattr(hosting.service, request_name)()
    hosting.join()
    assert hosting.failure is None
    states = hosting.windows.reported[2:]
    assert states
    assert set(states) == {STOP_PENDING}
    hosting.wait_for("stopped")


def test_windows_can_have_the_configuration_reread(hosting: Hosting) -> None:
    hosting.start()
    hosting.wait_until_running()
    hosting.file.write_text(CONFIGURATION.replace("ACCESS", "read-only"))
    hosting.service.SvcOtherEx(99, 0, None)
    hosting.service.SvcOtherEx(fake_windows.PARAMCHANGE, 0, None)
    assert "changed=" in hosting.wait_for("reloaded")


def test_a_failed_start_is_an_error_for_windows_and_the_log_has_the_reason(
    hosting: Hosting,
) -> None:
    hosting.start(access="rw")
    hosting.join()
    assert str(hosting.failure) == f"exit code 2: see {hosting.log}"
    assert "found 'rw', allowed: read-only or read-write" in hosting.log.read_text()
    assert hosting.windows.reported == [START_PENDING]


def test_a_question_for_the_state_reports_nothing(hosting: Hosting) -> None:
    hosting.start()
    hosting.wait_until_running()
    hosting.service.SvcInterrogate()
    assert hosting.windows.reported == [START_PENDING, RUNNING]


def test_the_log_file_is_rotated_and_never_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.windows_service.log_file.MAX_BYTES", 1000)
    file = tmp_path / "new" / "service.log"
    log = LogFile(file)
    for number in range(1000):
        print(f"line {number}: ä", file=log)
    files = sorted(one.name for one in file.parent.iterdir())
    assert files == ["service.log", *(f"service.log.{number}" for number in range(1, 6))]
    assert all(one.stat().st_size <= 1000 for one in file.parent.iterdir())
    assert file.read_text("utf-8").endswith("line 999: ä\n")
    for one in file.parent.iterdir():
        one.unlink()
    file.parent.rmdir()
    monkeypatch.setattr("holdfast.appliance.windows_service.log_file.MAX_BYTES", 1)
    for _ in range(100):
        log.write("dropped " * 20)
    log.close()


def test_the_log_file_has_the_text_that_commands_print(tmp_path: Path) -> None:
    log = LogFile(tmp_path / "service.log")
    with redirect_stdout(log):
        click.echo("a line")
    with pytest.raises(TypeError, match="a log takes text, found bytes"):
        log.write(b"")  # type: ignore[arg-type]
    log.close()
    assert (tmp_path / "service.log").read_text() == "a line\n"


def test_a_log_file_that_a_reader_has_open_grows_and_loses_no_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("holdfast.appliance.windows_service.log_file.MAX_BYTES", 100)
    file = tmp_path / "service.log"
    log = LogFile(file)
    for number in range(20):
        print(f"line {number}", file=log)
    older = {one.name: one.read_bytes() for one in tmp_path.iterdir() if one != file}
    allow = not_renamed(monkeypatch, file)
    for number in range(20, 50):
        print(f"line {number}", file=log)
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir() if one != file} == older
    assert file.read_text().splitlines()[-30:] == [f"line {number}" for number in range(20, 50)]
    assert caplog.messages == ["log_file_not_rotated"]
    allow()
    monkeypatch.setattr("holdfast.events.rotation.time.monotonic", lambda: float("inf"))
    print("line 50", file=log)
    log.close()
    assert file.read_text() == "line 50\n"
