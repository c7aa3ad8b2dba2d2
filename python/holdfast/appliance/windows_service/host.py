"""The process of a service: it answers the service control manager while it runs an appliance."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import servicemanager
import win32service
from win32serviceutil import ServiceFramework

from holdfast.appliance.windows_service.control import ServiceControl

if TYPE_CHECKING:
    from collections.abc import Callable

    Serve = Callable[[ServiceControl], None]

START_LIMIT_MS = 180_000
"""Milliseconds that the start may take. Other nodes of a log can delay it."""

STOP_LIMIT_MS = 20_000
"""Milliseconds that the stop may take."""


class ServiceFailed(Exception):
    """The appliance could not start. pywin32 reports it to Windows, and logs it as an event."""


class HostedService(ServiceFramework):
    """Runs `serve`. pywin32 makes it, and calls the methods whose names begin with `Svc`."""

    _svc_name_: ClassVar[str]
    serve: ClassVar[Serve]
    log: ClassVar[str]

    def __init__(self, arguments: list[str]) -> None:
        super().__init__(arguments)
        self.control = ServiceControl(self.running, self.stopping)

    def GetAcceptedControls(self) -> int:
        """The requests of Windows that are answered."""
        accepted: int = super().GetAcceptedControls()  # type: ignore[no-untyped-call]
        return accepted | win32service.SERVICE_ACCEPT_PARAMCHANGE

    def SvcRun(self) -> None:
        """Runs the appliance until Windows stops the service."""
        self.ReportServiceStatus(win32service.SERVICE_START_PENDING, waitHint=START_LIMIT_MS)
        try:
            type(self).serve(self.control)
        except SystemExit as end:
            # After a stop on request, an error would make Windows start the service again.
            if end.code and not self.control.received:
                raise ServiceFailed(f"exit code {end.code}: see {self.log}") from None

    def SvcStop(self) -> None:
        """Windows stops the service."""
        self.stopping()
        self.control.request_stop()

    SvcShutdown = SvcStop
    """Windows shuts down."""

    def SvcInterrogate(self) -> None:
        """Nothing: Windows knows the state already. pywin32 would report that the service runs."""

    def SvcOtherEx(self, control: int, event_type: int, data: object) -> None:  # noqa: ARG002
        """Windows passes on a request to reload."""
        if control == win32service.SERVICE_CONTROL_PARAMCHANGE:
            self.control.request_reload()

    def running(self) -> None:
        """Reports that the service runs."""
        self.ReportServiceStatus(win32service.SERVICE_RUNNING)

    def stopping(self) -> None:
        """Reports that the service is about to end."""
        self.ReportServiceStatus(win32service.SERVICE_STOP_PENDING, waitHint=STOP_LIMIT_MS)


def answer(name: str, log: str, serve: Serve) -> None:
    """Connects this process to the service control manager, and returns when the service ends.

    Only a process that Windows has started as a service can do that.
    """
    hosted = type("Hosted", (HostedService,), {"_svc_name_": name, "serve": serve, "log": log})
    servicemanager.Initialize(name, None)
    servicemanager.PrepareToHostSingle(hosted)
    servicemanager.StartServiceCtrlDispatcher()  # type: ignore[no-untyped-call]
