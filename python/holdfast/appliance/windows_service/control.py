"""What the service control manager of Windows requests, in the places of signals and of systemd."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from holdfast.appliance.service_manager import ServiceManager

if TYPE_CHECKING:
    from collections.abc import Callable


class ServiceControl(ServiceManager):
    """Requests to stop and to reload, and reports of what the appliance does."""

    def __init__(self, running: Callable[[], None], stopping: Callable[[], None]) -> None:
        """`running` and `stopping` report these states of the service to Windows."""
        super().__init__({})
        self._report_running, self._report_stopping = running, stopping
        self._reload = False
        self.received = False
        """Whether the service is to stop."""

    def request_stop(self) -> None:
        """Ends the service soon."""
        self.received = True

    def request_reload(self) -> None:
        """Has the configuration reread soon."""
        self._reload = True

    def take_reload(self) -> bool:
        """Whether a reload was requested since the last call."""
        requested, self._reload = self._reload, False
        return requested

    def interrupting(self) -> contextlib.AbstractContextManager[None]:
        """Nothing: a service that starts accepts no requests."""
        return contextlib.nullcontext()

    def ready(self) -> None:
        """Reports that the appliance serves."""
        self._report_running()

    def stopping(self) -> None:
        """Reports that the appliance begins to stop."""
        self._report_stopping()
