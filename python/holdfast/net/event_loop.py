"""The event loops that services run in.

asyncio makes lookups of names in threads, and waits for them at its end: many seconds if no name
server answers. Programs that hand names to asyncio, such as nats-py, run in `EventLoop`, which does
not wait. HTTP hosts look no names up: they run in the fastest one.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.net.resolver import CONFIGURED

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

if sys.platform == "win32":
    _Usual = asyncio.ProactorEventLoop
else:
    _Usual = asyncio.SelectorEventLoop

Result = TypeVar("Result")


class EventLoop(_Usual):
    """The usual event loop of the system, which looks names up with `Resolver`."""

    async def getaddrinfo(
        self,
        host: Any,
        port: Any,
        *,
        family: int = 0,
        type: int = 0,
        proto: int = 0,
        flags: int = 0,
    ) -> Any:
        """As that of asyncio. For a connection, in the threads of the resolver."""
        if not isinstance(host, str) or type != socket.SOCK_STREAM or proto or flags:
            return await super().getaddrinfo(
                host, port, family=family, type=type, proto=proto, flags=flags
            )
        found = await asyncio.wrap_future(CONFIGURED.look_up(host, port))
        addresses = [each for each in found if family in (0, each[0])]
        if not addresses:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [(each, type, socket.IPPROTO_TCP, "", address) for each, address in addresses]


def run(
    main: Coroutine[Any, Any, Result],
    loop_factory: Callable[[], asyncio.AbstractEventLoop] = EventLoop,
) -> Result:
    """As `asyncio.run`, in such a loop."""
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        return runner.run(main)


def fastest() -> asyncio.AbstractEventLoop:
    """Creates an event loop of uvloop if it is installed, otherwise the usual one."""
    try:
        import uvloop
    except ImportError:
        return _Usual()
    return uvloop.new_event_loop()
