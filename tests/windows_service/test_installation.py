"""`holdfast service` against a service control manager in memory: nothing here needs Windows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from support import fake_windows
from support.cli import done, failure, invoke

CONFIGURATION = """
memories:
  plant: {holding_registers: 10}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
"""


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> fake_windows.Windows:
    made = fake_windows.Windows()
    made.install(monkeypatch)
    monkeypatch.setattr("time.sleep", lambda _: None)
    return made


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "my plant.yaml"
    made.write_text(CONFIGURATION)
    return made


def test_a_service_runs_the_configuration_at_every_boot_without_a_privilege(
    windows: fake_windows.Windows, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PROGRAMDATA", "/data")
    told, log = done("service", "install", str(file))
    assert told == "Installed: holdfast-my-plant, with the account NT SERVICE\\holdfast-my-plant"
    assert log == "Log: /data/Holdfast/holdfast-my-plant.log"
    service = windows.services["holdfast-my-plant"]
    python = subprocess.list2cmdline([sys.executable])
    assert service.arguments == {
        "shown": "Holdfast (my plant.yaml)",
        "access": 0xF01FF,
        "type": 0x10,
        "start": 2,
        "error": 1,
        "program": f'{python} -m holdfast service host "{file}" --name holdfast-my-plant',
        "group": None,
        "tag": False,
        "needs": ["Tcpip"],
        "account": "NT SERVICE\\holdfast-my-plant",
        "password": None,
    }
    assert str(file) in service.settings[1]
    assert service.settings[2]["Actions"] == [(1, 5000), (1, 5000), (1, 60_000)]
    assert service.settings[4] is True
    assert windows.open_handles == 0


def test_a_service_that_can_not_be_described_is_not_installed(
    windows: fake_windows.Windows, file: Path
) -> None:
    windows.describes = False
    [told] = failure("service", "install", str(file))
    assert (
        told == "holdfast: can't install the service holdfast-my-plant: The parameter is incorrect"
    )
    assert (windows.services, windows.open_handles) == ({}, 0)


def test_a_configuration_with_an_error_is_not_installed(
    windows: fake_windows.Windows, file: Path
) -> None:
    file.write_text(CONFIGURATION.replace("read-only", "rw"))
    result = invoke("service", "install", str(file))
    assert (result.exit_code, windows.services) == (2, {})
    assert "found 'rw'" in result.stderr


def test_start_and_stop_wait_until_the_service_has_done_it(
    windows: fake_windows.Windows, file: Path
) -> None:
    done("service", "install", str(file), "--name", "boiler")
    service = windows.services["boiler"]
    assert done("service", "start", str(file), "--name", "boiler") == ["Started: boiler"]
    assert service.state == fake_windows.RUNNING
    [told] = done("service", "reload", str(file), "--name", "boiler")
    assert told.startswith("Requested: see ")
    assert done("service", "stop", str(file), "--name", "boiler") == ["Stopped: boiler"]
    assert service.state == fake_windows.STOPPED
    assert service.controls == [fake_windows.PARAMCHANGE, fake_windows.STOP]
    assert windows.open_handles == 0


@pytest.mark.parametrize("is_running", [False, True])
def test_removing_stops_the_service_first(
    windows: fake_windows.Windows, file: Path, is_running: bool
) -> None:
    done("service", "install", str(file))
    if is_running:
        done("service", "start", str(file))
    assert done("service", "remove", str(file)) == ["Removed: holdfast-my-plant"]
    assert (windows.services, windows.open_handles) == ({}, 0)


def test_a_service_that_ends_while_it_starts_is_an_error(
    windows: fake_windows.Windows, file: Path
) -> None:
    done("service", "install", str(file))
    windows.fails = True
    # The state before the start counts as an end too: the first look finds it starting.
    assert failure("service", "start", str(file)) == [
        "holdfast: the service holdfast-my-plant has ended: see its log"
    ]
    assert windows.open_handles == 0


def test_a_service_that_hangs_is_an_error(
    windows: fake_windows.Windows, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done("service", "install", str(file))
    clock = iter(range(0, 1000, 30))
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    service = windows.services["holdfast-my-plant"]
    monkeypatch.setattr(
        sys.modules["win32service"],
        "StartService",
        lambda *_: setattr(service, "state", fake_windows.START_PENDING),
    )
    [told] = failure("service", "start", str(file))
    assert told == "holdfast: the service holdfast-my-plant is not done after 60 s"


def test_errors_of_windows_say_what_to_do(windows: fake_windows.Windows, file: Path) -> None:
    [missing] = failure("service", "start", str(file))
    assert missing == (
        "holdfast: can't start the service holdfast-my-plant: The specified service does not exist "
        "as an installed service: install it with 'holdfast service install'"
    )
    done("service", "install", str(file))
    [twice] = failure("service", "install", str(file))
    assert "already exists: remove it first, or install this one with another --name" in twice
    done("service", "start", str(file))
    assert failure("service", "start", str(file)) == [
        "holdfast: can't start the service holdfast-my-plant: "
        "An instance of the service is already running"
    ]
    windows.is_administrator = False
    [denied] = failure("service", "remove", str(file))
    assert "Access is denied: run this command in a terminal of an administrator" in denied


@pytest.mark.parametrize("command", ["install", "remove", "start", "stop", "reload", "host"])
def test_without_windows_the_error_names_systemd(
    command: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("win32service", "pywintypes", "servicemanager"):
        monkeypatch.setitem(sys.modules, name, None)
    for name in fake_windows.OURS:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert failure("service", command, str(file)) == [
        "holdfast: services of Windows exist only there. On Linux, use systemd"
    ]
    monkeypatch.setattr(sys, "platform", "win32")
    [told] = failure("service", command, str(file))
    assert told == (
        "holdfast: service requires pywin32, not installed: pip install 'holdfast-modbus[windows]'"
    )
