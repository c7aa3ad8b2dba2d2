"""A request's device: the only way from the gateway to the network."""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.errors import ConnectionLost, InvalidResponse, ModbusException, RequestTimeout
from holdfast.gateway.egress import NoSuchName, Refused
from holdfast.gateway.fields import malformed
from holdfast.gateway.pool import Full, could_not_connect
from holdfast.http_requests import Unfit

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.client import Client
    from holdfast.gateway.egress import Egress
    from holdfast.gateway.pool import Pool

Result = TypeVar("Result")


class Failed(Exception):
    """There was no connection, or no reply: why, in a word and in a sentence."""

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason}: {detail}")


class Device:
    """The device that a request names, for as long as the request takes."""

    def __init__(self, egress: Egress, pool: Pool, given: Mapping[str, Any]) -> None:
        if given["transport"] == "tls":
            raise malformed("transport is tls, which is not available in this version")
        self.host: str = given["host"]
        self.port: int = given["port"]
        self.unit: int = given["unitId"]
        self.transport = given["transport"]
        self.timeout: float = given["timeout"] / 1000
        self.rtt = 0
        """Milliseconds that the last call took."""
        self._egress = egress
        self._pool = pool

    @property
    def told(self) -> dict[str, Any]:
        """Where it is, for answers."""
        return {"host": self.host, "port": self.port, "unitId": self.unit}

    async def ask(
        self, call: Callable[[Client], Awaitable[Result]], *, repeat: bool = False
    ) -> Result:
        """What a call comes to, within the time of the request; only reads are to be repeated.

        Raises `Failed`, `Unfit`, and `ModbusException` for what the device answers.
        """
        try:
            return await self.attempt(call, repeat=repeat)
        except ModbusException:
            raise
        except RequestTimeout:
            raise Failed("timeout", "Connection timeout") from None
        except ConnectionLost as error:
            reason = "no_connection" if could_not_connect(error) else "connection_lost"
            raise Failed(reason, self._explained(error)) from None
        except InvalidResponse as error:
            raise Failed("invalid_reply", str(error)) from None

    async def attempt(
        self, call: Callable[[Client], Awaitable[Result]], *, repeat: bool = False
    ) -> Result:
        """The same, but what goes wrong between here and the device raises a `ModbusError`."""
        began = time.monotonic()
        try:
            async with asyncio.timeout(self.timeout):
                route = await self._egress.route(self.transport, self.host, self.port)
                return await self._pool.run(route, self.timeout, call, repeat=repeat)
        except Refused as error:
            raise Unfit("refused_target", str(error)) from None
        except NoSuchName as error:
            raise Failed("no_such_name", str(error)) from None
        except Full:
            raise Unfit("busy", "too many devices are talked to right now") from None
        except TimeoutError:
            raise RequestTimeout(f"no reply within {self.timeout} s") from None
        except ValueError as error:  # The client's own checks, before anything is sent.
            raise malformed(str(error)) from None
        finally:
            self.rtt = round(1000 * (time.monotonic() - began))

    def _explained(self, error: ConnectionLost) -> str:
        cause = error.__cause__
        if isinstance(cause, OSError) and cause.errno is not None:
            return f"can't connect to {self.host}:{self.port}: {os.strerror(cause.errno)}"
        return str(error)


def exception_name(error: ModbusException) -> str:
    """The name of a Modbus exception."""
    return error.name if error.name != "unknown" else f"Unknown exception: 0x{error.code:x}"


def exception_text(error: ModbusException) -> str:
    """A Modbus exception as a sentence."""
    return f"Modbus exception: {exception_name(error)} (code 0x{error.code:x})"
