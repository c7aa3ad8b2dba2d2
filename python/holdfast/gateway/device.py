"""The device of a request. All connections of the gateway to devices are made through it."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast import logs
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
    TlsFailed,
)
from holdfast.gateway.broadcasting import broadcast
from holdfast.gateway.egress import Refused
from holdfast.gateway.fields import listed, malformed
from holdfast.gateway.pool import Full, Unusable
from holdfast.gateway.sharing import QueueFull, SharedClient
from holdfast.net.resolver import NoSuchName
from holdfast.protocol import BROADCAST_CODES, usual_port
from holdfast.types import SERIAL_FRAMES
from holdfast.web.requests import BadRequest

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.client import Client
    from holdfast.gateway.egress import Egress
    from holdfast.gateway.pool import Pool
    from holdfast.types import Transport

Result = TypeVar("Result")

TOO_MANY_BEFORE = (
    "Connection timeout: the request waited behind other requests to this device, and was not sent"
)
NO_BROADCAST = (
    "unitId 0 is the broadcast of a serial line, which has no response; with transport "
    f"{listed(SERIAL_FRAMES)} it allows only writes with functions {listed(BROADCAST_CODES)}"
)
UNIT_0 = "unit id 0 is the broadcast of serial lines, which has no response"


class Failed(Exception):
    """No connection, or no valid response: `reason` is a word, `detail` a sentence."""

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason}: {detail}")


class RequestedDevice:
    """The device of one request."""

    def __init__(
        self, egress: Egress, pool: Pool, given: Mapping[str, Any], *, broadcast: bool = False
    ) -> None:
        """`broadcast`: whether the request may be a broadcast. Raises `BadRequest`."""
        self.transport: Transport = given["transport"]
        if given["serverName"] is not None and self.transport != "tls":
            raise malformed("serverName requires transport tls")
        self.host: str = given["host"]
        self.port: int = given["port"] or usual_port(self.transport)
        self.unit: int = given["unitId"]
        self.is_broadcast = self.unit == 0 and self.transport in SERIAL_FRAMES
        if self.is_broadcast and not broadcast:
            raise malformed(NO_BROADCAST)
        self._name: str | None = given["serverName"]
        self.timeout: float = given["timeout"] / 1000
        self.rtt = 0
        """The duration of the last call, in milliseconds."""
        self.asked = False
        """Whether a call was started, so that the device may have received a request."""
        self._waits = False
        self._egress = egress
        self._pool = pool

    @property
    def told(self) -> dict[str, Any]:
        """The address of the device, for answers."""
        return {"host": self.host, "port": self.port, "unitId": self.unit}

    async def ask(self, call: Callable[[Client], Awaitable[Result]]) -> Result:
        """Returns the result of a call, within the timeout of the request.

        Raises `Failed`, `BadRequest`, and `ModbusException` for exception responses.
        """
        if self.is_broadcast:
            call = broadcast(call)
        try:
            return await self.attempt(call)
        except ModbusException:
            raise
        except (RequestTimeout, ConnectionLost, InvalidResponse) as error:
            raise self.failure(error) from None

    def failure(self, error: ModbusError) -> Failed:
        """Returns the failure for an error of `attempt` other than a Modbus exception."""
        if isinstance(error, RequestTimeout):
            return Failed("timeout", self._timed_out())
        if isinstance(error, ConnectionLost):
            if not error.maybe_sent:
                self.asked = False
            return Failed(self._reason(error), self._explained(error))
        return Failed("invalid_reply", str(error))

    async def attempt(self, call: Callable[[Client], Awaitable[Result]]) -> Result:
        """As `ask`, but connection errors, timeouts and invalid responses raise `ModbusError`."""
        began = time.monotonic()
        asked_before, shared, route = self.asked, None, None

        def turn(client: Client) -> Awaitable[Result]:
            nonlocal shared
            shared = client if isinstance(client, SharedClient) else None
            self.asked, self._waits = True, False
            return call(client)

        self._waits = False
        try:
            async with asyncio.timeout(self.timeout):
                route = await self._egress.route(self.transport, self.host, self.port, self._name)
                self._waits = True
                return await self._pool.run(route, self.timeout, turn)
        except Refused as error:
            raise BadRequest("refused_target", str(error)) from None
        except NoSuchName as error:
            raise Failed("no_such_name", str(error)) from None
        except Full:
            raise BadRequest("busy", "too many devices are in use, try again later") from None
        except QueueFull:
            detail = f"too many requests wait for {self.host}:{self.port}, try again later"
            raise BadRequest("busy", detail) from None
        except Unusable as error:
            logs.refused("tls_unusable", kind="gateway", listener="gateway", error=str(error))
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
            if shared is not None and not shared.is_sent:
                self.asked, self._waits = asked_before, True
            self.rtt = round(1000 * (time.monotonic() - began))

    def _timed_out(self) -> str:
        if self._waits:
            return TOO_MANY_BEFORE
        return "Connection timeout" if self.unit else f"Connection timeout: {UNIT_0}"

    def _reason(self, error: ConnectionLost) -> str:
        """Returns the word for a failed or lost connection."""
        if isinstance(error, TlsFailed):
            return "tls_failed"
        return "connection_lost" if error.maybe_sent else "no_connection"

    def _explained(self, error: ConnectionLost) -> str:
        """Returns the message for a failed or lost connection, with the host as requested."""
        if isinstance(error, ConnectFailed | TlsFailed) and not error.maybe_sent:
            return f"can't connect to {self.host}:{self.port}: {error.detail}"
        return str(error)


def exception_name(error: ModbusException) -> str:
    """Returns the name of a Modbus exception."""
    return error.name if error.name != "unknown" else f"Unknown exception: 0x{error.code:x}"


def exception_text(error: ModbusException) -> str:
    """Returns the message for a Modbus exception."""
    return f"Modbus exception: {exception_name(error)} (code 0x{error.code:x})"
