"""The device of a request. All connections of the gateway to devices are made through it."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.client import Client
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
    TlsFailed,
)
from holdfast.events import log_lines
from holdfast.gateway.broadcast import is_broadcast
from holdfast.gateway.pool import Unusable
from holdfast.gateway.shared_devices import QueueFull
from holdfast.net.addresses import joined
from holdfast.net.http.fields import malformed
from holdfast.net.http.requests import BadRequest, RequestError
from holdfast.net.resolver import NoSuchName
from holdfast.protocol import BROADCAST_CODES, usual_port
from holdfast.runtime import standstill
from holdfast.runtime.text import all_of
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.gateway.device_routes import DeviceRoutes
    from holdfast.gateway.pool import Pool
    from holdfast.gateway.shared_devices import Turns
    from holdfast.types import Transport

Result = TypeVar("Result")

NOT_SENT = (
    "Connection timeout: the request was not sent: there was no connection, or it waited behind "
    "other requests to this device"
)
NO_BROADCAST = (
    "unitId 0 is the broadcast of a serial line, which has no response; with transport "
    f"{all_of(SERIAL_FRAMES)} it allows only writes with functions {all_of(BROADCAST_CODES)}"
)
UNIT_0 = "unit id 0 is the broadcast of serial lines, which has no response"


class Failed(RequestError):
    """No connection to the device, or no valid response from it."""


class _RequestClient(Client):
    """A client for the calls of one HTTP request, on a connection with other users."""

    def __init__(self, turns: Turns, unit: int, timeout: float) -> None:
        # It has no connection of its own, which the constructor of its base would create.
        self._target, self.unit, self.timeout = turns.target, unit, timeout
        self._transport = turns


class RequestedDevice:
    """The device of one request."""

    def __init__(
        self,
        routes: DeviceRoutes,
        pool: Pool,
        given: Mapping[str, Any],
        *,
        broadcast: bool = False,
        check_client: Callable[[], None] | None = None,
    ) -> None:
        """Raises `BadRequest`.

        `broadcast`: whether the request may be a broadcast. `check_client` raises if the client of
        a write no longer waits for it. It is called in any thread.
        """
        self.transport: Transport = given["transport"]
        if given["serverName"] is not None and self.transport != "tls":
            raise malformed("serverName requires transport tls")
        self.host: str = given["host"]
        self.port: int = given["port"] or usual_port(self.transport)
        self.unit: int = given["unitId"]
        self.is_broadcast = is_broadcast(self.transport, self.unit)
        if self.is_broadcast and not broadcast:
            raise malformed(NO_BROADCAST)
        self._name: str | None = given["serverName"]
        self.timeout: float = given["timeout"] / 1000
        self.rtt = 0
        """The duration of the last call, in milliseconds."""
        self.maybe_sent = False
        """Whether the device may have received a request."""
        self._is_unsent = False
        """Whether the last call has sent nothing."""
        self._routes = routes
        self._pool = pool
        self._check_client = check_client

    @property
    def where(self) -> str:
        """The host as requested, and the port."""
        return joined(self.host, self.port)

    @property
    def target_fields(self) -> dict[str, Any]:
        """The address of the device, for answers."""
        return {"host": self.host, "port": self.port, "unitId": self.unit}

    async def ask(self, call: Callable[[Client], Awaitable[Result]]) -> Result:
        """Returns the result of a call, within the timeout of the request.

        Raises `Failed`, `BadRequest`, and `ModbusException` for exception responses.
        """
        try:
            return await self.attempt(call)
        except (RequestTimeout, ConnectionLost, InvalidResponse) as error:
            raise self.failure(error) from None

    def failure(self, error: ModbusError) -> Failed:
        """Returns the failure for an error of `attempt` other than a Modbus exception."""
        if isinstance(error, RequestTimeout):
            return Failed("timeout", self._timed_out())
        if not isinstance(error, ConnectionLost):
            return Failed("invalid_reply", str(error))
        reason, detail = "connection_lost" if error.maybe_sent else "no_connection", str(error)
        unsent = (ConnectFailed,) if error.maybe_sent else (ConnectFailed, TlsFailed)
        if isinstance(error, unsent):  # With the host as requested.
            detail = f"can't connect to {self.where}: {error.detail}"
        return Failed("tls_failed" if isinstance(error, TlsFailed) else reason, detail)

    async def attempt(self, call: Callable[[Client], Awaitable[Result]]) -> Result:
        """As `ask`, but connection errors, timeouts and invalid responses raise `ModbusError`."""
        began, latest = time.perf_counter(), standstill.now() + self.timeout
        turns, route = None, None

        def check_write() -> None:
            if self._check_client is not None:
                self._check_client()
            # After a standstill, the event loop may come here before it finds the timeout.
            if standstill.now() > latest:
                raise RequestTimeout(f"not sent within {self.timeout} s", maybe_sent=False)

        def run(given: Turns) -> Awaitable[Result]:
            nonlocal turns
            turns = given
            turns.check_write = check_write
            return call(_RequestClient(turns, self.unit, self.timeout))

        try:
            async with asyncio.timeout(self.timeout):
                route = await self._routes.route(self.transport, self.host, self.port, self._name)
                return await self._pool.run(route, self.timeout, run)
        except NoSuchName as error:
            raise Failed("no_such_name", str(error)) from None
        except QueueFull:
            detail = f"too many requests wait for {self.where}, try again later"
            raise BadRequest("busy", detail) from None
        except Unusable as error:
            log_lines.refused("tls_unusable", kind="gateway", listener="gateway", error=str(error))
            detail = "the gateway's TLS files can't be used, see the log of the gateway"
            raise Failed("internal_error", detail) from None
        except TimeoutError:
            if route is None:
                late = NoSuchName.unanswered(self.host, self.timeout)
                raise Failed("no_such_name", f"Connection timeout: {late}") from None
            raise RequestTimeout(f"no reply within {self.timeout} s") from None
        except ValueError as error:  # A check of the client, before anything is sent.
            raise malformed(str(error)) from None
        finally:
            is_sent = turns is not None and turns.is_sent
            self.maybe_sent |= is_sent
            self._is_unsent = not is_sent
            self.rtt = round(1000 * (time.perf_counter() - began))

    def _timed_out(self) -> str:
        if self._is_unsent:
            return NOT_SENT
        return "Connection timeout" if self.unit else f"Connection timeout: {UNIT_0}"


def exception_name(error: ModbusException) -> str:
    """Returns the name of a Modbus exception."""
    return error.name if error.name != "unknown" else f"Unknown exception: 0x{error.code:x}"


def exception_text(error: ModbusException) -> str:
    """Returns the message for a Modbus exception."""
    return f"Modbus exception: {exception_name(error)} (code 0x{error.code:x})"


def error_fields(error: ModbusException | Failed | BadRequest) -> dict[str, Any]:
    """Returns the fields for an error in events of a stream."""
    if isinstance(error, ModbusException):
        return {"reason": "exception", "error": exception_text(error), "code": error.code}
    return {"reason": error.reason, "error": error.detail}
