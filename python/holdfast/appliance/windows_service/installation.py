"""Installs, removes, starts, stops and reloads a service of Windows."""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeAlias

import pywintypes
import win32service
import winerror

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

Handle: TypeAlias = Any
"""A handle of the service control manager, or of a service; pywin32 has no public name for it."""

LOOK_INTERVAL_S = 0.2
"""Seconds between two looks at a service that starts or stops."""

TIMEOUT_S = 60.0
"""Seconds that a service may take to start or stop before a command gives up."""

RESTART_DELAYS_S = (5, 5, 60)
"""Seconds before the first, the second, and each further restart after a failure."""

DAY_S = 24 * 60 * 60

HINTS = {
    winerror.ERROR_ACCESS_DENIED: "run this command in a terminal of an administrator",
    winerror.ERROR_SERVICE_DOES_NOT_EXIST: "install it with 'holdfast service install'",
    winerror.ERROR_SERVICE_EXISTS: "remove it first, or install this one with another --name",
    winerror.ERROR_SERVICE_MARKED_FOR_DELETE: "close programs that show services, then try again",
}


class ServiceError(Exception):
    """Windows refused an operation, or the service did not do it."""


class InstalledService:
    """The service with this name, whether or not it is installed already."""

    def __init__(self, name: str) -> None:
        self.name = name

    def install(self, file: Path) -> None:
        """Creates the service, which runs the configuration `file` from the next boot on.

        It runs as an account of its own, `NT SERVICE\\NAME`, without a password and without the
        rights of an administrator. If it fails, Windows starts it again.
        """
        with self._errors("install"), _opened(_manager()) as manager:
            service = win32service.CreateService(
                manager,
                self.name,
                f"Holdfast ({file.name})",
                win32service.SERVICE_ALL_ACCESS,
                win32service.SERVICE_WIN32_OWN_PROCESS,
                win32service.SERVICE_AUTO_START,
                win32service.SERVICE_ERROR_NORMAL,
                command_line(self.name, file),
                None,
                False,
                ["Tcpip"],
                f"NT SERVICE\\{self.name}",
                None,
            )
            with _opened(service):
                try:
                    _describe(service, file)
                except pywintypes.error:
                    win32service.DeleteService(service)
                    raise

    def remove(self) -> None:
        """Stops the service, and deletes it."""
        with self._service("remove") as service:
            if _state(service) != win32service.SERVICE_STOPPED:
                self._stop(service)
            win32service.DeleteService(service)

    def start(self) -> None:
        """Starts the service, and waits until the appliance serves."""
        with self._service("start") as service:
            win32service.StartService(service, None)
            self._wait(service, win32service.SERVICE_RUNNING)

    def stop(self) -> None:
        """Stops the service, and waits until it has ended."""
        with self._service("stop") as service:
            self._stop(service)

    def reload(self) -> None:
        """Has the service reread its configuration. The log has the result."""
        with self._service("reload") as service:
            win32service.ControlService(service, win32service.SERVICE_CONTROL_PARAMCHANGE)

    def _stop(self, service: Handle) -> None:
        win32service.ControlService(service, win32service.SERVICE_CONTROL_STOP)
        self._wait(service, win32service.SERVICE_STOPPED)

    def _wait(self, service: Handle, state: int) -> None:
        over = time.monotonic() + TIMEOUT_S
        while (now := _state(service)) != state:
            if now == win32service.SERVICE_STOPPED:
                raise ServiceError(f"the service {self.name} has ended: see its log")
            if time.monotonic() > over:
                raise ServiceError(f"the service {self.name} is not done after {TIMEOUT_S:g} s")
            time.sleep(LOOK_INTERVAL_S)

    @contextmanager
    def _service(self, verb: str) -> Iterator[Handle]:
        with self._errors(verb), _opened(_manager()) as manager:
            service = win32service.OpenService(manager, self.name, win32service.SERVICE_ALL_ACCESS)
            with _opened(service):
                yield service

    @contextmanager
    def _errors(self, verb: str) -> Iterator[None]:
        try:
            yield
        except pywintypes.error as error:
            hint = HINTS.get(error.winerror)
            reason = error.strerror.rstrip(".") + (f": {hint}" if hint else "")
            raise ServiceError(f"can't {verb} the service {self.name}: {reason}") from error


def command_line(name: str, file: Path) -> str:
    """What Windows runs: this interpreter, as that of pywin32 does not find an environment."""
    host = [sys.executable, "-m", "holdfast", "service", "host", str(file), "--name", name]
    return subprocess.list2cmdline(host)


def _manager() -> Handle:
    return win32service.OpenSCManager(None, None, win32service.SC_MANAGER_ALL_ACCESS)


@contextmanager
def _opened(handle: Handle) -> Iterator[Handle]:
    try:
        yield handle
    finally:
        win32service.CloseServiceHandle(handle)


def _state(service: Handle) -> int:
    return win32service.QueryServiceStatus(service)[1]


def _describe(service: Handle, file: Path) -> None:
    """Sets what the service does after a failure, and the text that administrators see."""
    restarts = [(win32service.SC_ACTION_RESTART, delay * 1000) for delay in RESTART_DELAYS_S]
    actions = {"ResetPeriod": DAY_S, "RebootMsg": None, "Command": None, "Actions": restarts}
    for level, value in (
        (win32service.SERVICE_CONFIG_DESCRIPTION, f"Modbus appliance with {file}"),
        (win32service.SERVICE_CONFIG_FAILURE_ACTIONS, actions),
        # Also when the process has ended with an error, not only when it has crashed.
        (win32service.SERVICE_CONFIG_FAILURE_ACTIONS_FLAG, True),
    ):
        win32service.ChangeServiceConfig2(service, level, value)
