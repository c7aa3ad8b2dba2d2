"""The modules of pywin32 that Holdfast uses, and a service control manager that lives in memory.

The numbers are those of Windows. `ServiceFramework` does what that of pywin32 does with them.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest

STOPPED, START_PENDING, STOP_PENDING, RUNNING = 1, 2, 3, 4
STOP, SHUTDOWN, PARAMCHANGE = 1, 5, 6

OURS = (
    "holdfast.appliance.windows_service.installation",
    "holdfast.appliance.windows_service.host",
)
"""Modules that import pywin32, and so have to be imported anew."""

CONSTANTS = {
    "SC_MANAGER_ALL_ACCESS": 0xF003F,
    "SERVICE_ALL_ACCESS": 0xF01FF,
    "SERVICE_WIN32_OWN_PROCESS": 0x10,
    "SERVICE_AUTO_START": 2,
    "SERVICE_ERROR_NORMAL": 1,
    "SERVICE_STOPPED": STOPPED,
    "SERVICE_START_PENDING": START_PENDING,
    "SERVICE_STOP_PENDING": STOP_PENDING,
    "SERVICE_RUNNING": RUNNING,
    "SERVICE_CONTROL_STOP": STOP,
    "SERVICE_CONTROL_PARAMCHANGE": PARAMCHANGE,
    "SERVICE_ACCEPT_STOP": 1,
    "SERVICE_ACCEPT_SHUTDOWN": 4,
    "SERVICE_ACCEPT_PARAMCHANGE": 8,
    "SERVICE_CONFIG_DESCRIPTION": 1,
    "SERVICE_CONFIG_FAILURE_ACTIONS": 2,
    "SERVICE_CONFIG_FAILURE_ACTIONS_FLAG": 4,
    "SC_ACTION_RESTART": 1,
}

ERRORS = {
    "ERROR_ACCESS_DENIED": 5,
    "ERROR_SERVICE_EXISTS": 1073,
    "ERROR_SERVICE_DOES_NOT_EXIST": 1060,
    "ERROR_SERVICE_MARKED_FOR_DELETE": 1072,
}


class Error(Exception):
    """`pywintypes.error`."""

    def __init__(self, winerror: int, funcname: str, strerror: str) -> None:
        super().__init__(winerror, funcname, strerror)
        self.winerror, self.funcname, self.strerror = winerror, funcname, strerror


@dataclass
class Service:
    """A service as the service control manager has it."""

    arguments: dict[str, Any]
    settings: dict[int, Any] = field(default_factory=dict)
    state: int = STOPPED
    next_states: list[int] = field(default_factory=list)
    controls: list[int] = field(default_factory=list)


class Windows:
    """The service control manager, and the functions of pywin32 that reach it."""

    def __init__(self) -> None:
        self.services: dict[str, Service] = {}
        self.is_administrator = True
        self.fails = False
        self.describes = True
        self.open_handles = 0
        self.reported: list[tuple[int, ...]] = []
        self.hosted: Any = None
        self.dispatch: Callable[[], None] = lambda: None

    def OpenSCManager(self, machine: None, database: None, access: int) -> Windows:
        assert (machine, database, access) == (None, None, 0xF003F)
        if not self.is_administrator:
            raise Error(5, "OpenSCManager", "Access is denied.")
        self.open_handles += 1
        return self

    def CloseServiceHandle(self, handle: object) -> None:
        assert handle is not None
        self.open_handles -= 1

    def CreateService(self, manager: Windows, name: str, *arguments: Any) -> Service:
        assert manager is self
        if name in self.services:
            raise Error(1073, "CreateService", "The specified service already exists.")
        keys = "shown access type start error program group tag needs account password"
        made = Service(dict(zip(keys.split(), arguments, strict=True)))
        self.services[name] = made
        self.open_handles += 1
        return made

    def ChangeServiceConfig2(self, service: Service, level: int, value: object) -> None:
        if not self.describes:
            raise Error(87, "ChangeServiceConfig2", "The parameter is incorrect.")
        service.settings[level] = value

    def OpenService(self, manager: Windows, name: str, access: int) -> Service:
        assert (manager, access) == (self, 0xF01FF)
        if name not in self.services:
            raise Error(
                1060, "OpenService", "The specified service does not exist as an installed service."
            )
        self.open_handles += 1
        return self.services[name]

    def StartService(self, service: Service, arguments: None) -> None:
        assert arguments is None
        if service.state != STOPPED:
            raise Error(1056, "StartService", "An instance of the service is already running.")
        service.next_states = [START_PENDING, STOPPED if self.fails else RUNNING]

    def ControlService(self, service: Service, control: int) -> None:
        service.controls.append(control)
        if service.state != RUNNING:
            raise Error(1062, "ControlService", "The service has not been started.")
        if control == STOP:
            service.next_states = [STOP_PENDING, STOPPED]

    def QueryServiceStatus(self, service: Service) -> tuple[int, ...]:
        if service.next_states:
            service.state = service.next_states.pop(0)
        return (0x10, service.state, 0, 0, 0, 0, 0)

    def DeleteService(self, service: Service) -> None:
        assert service.state == STOPPED
        name = next(name for name, found in self.services.items() if found is service)
        del self.services[name]

    def SetServiceStatus(self, handle: object, status: tuple[int, ...]) -> None:
        assert handle is not None
        self.reported.append(status)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Makes the modules importable, and has ours imported anew."""
        service = module("win32service", **CONSTANTS)
        for name in dir(Windows):
            if name[0].isupper():
                setattr(service, name, getattr(self, name))
        manager = module(
            "servicemanager",
            RegisterServiceCtrlHandler=lambda *_: object(),
            SetEventSourceName=lambda _: None,
            Initialize=lambda *_: None,
            PrepareToHostSingle=self._host,
            StartServiceCtrlDispatcher=lambda: self.dispatch(),
        )
        made = {
            "win32service": service,
            "servicemanager": manager,
            "pywintypes": module("pywintypes", error=Error),
            "winerror": module("winerror", **ERRORS),
            "win32serviceutil": module("win32serviceutil", ServiceFramework=framework(self)),
        }
        for name, one in made.items():
            monkeypatch.setitem(sys.modules, name, one)
        for name in OURS:
            monkeypatch.delitem(sys.modules, name, raising=False)

    def _host(self, hosted: Any) -> None:
        self.hosted = hosted


def module(name: str, **contents: Any) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(contents)
    return made


def framework(windows: Windows) -> type:
    """`win32serviceutil.ServiceFramework`, which reports to that service control manager."""

    class ServiceFramework:
        def __init__(self, arguments: list[str]) -> None:
            assert arguments
            self.handle = object()

        def GetAcceptedControls(self) -> int:
            return 1 | (4 if hasattr(self, "SvcShutdown") else 0)

        def ReportServiceStatus(self, state: int, waitHint: int = 5000) -> None:
            accepted = 0 if state == START_PENDING else self.GetAcceptedControls()
            windows.SetServiceStatus(self.handle, (state, accepted, waitHint))

        def SvcInterrogate(self) -> None:
            self.ReportServiceStatus(RUNNING)

    return ServiceFramework
