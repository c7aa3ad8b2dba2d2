"""pymodbus as a client: a blocking facade for its asyncio clients, and a tour of all functions."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence

    import holdfast

OPTIONS: dict[str, Any] = {"timeout": 10, "retries": 0}


@contextlib.contextmanager
def connected(client: Any) -> Iterator[Any]:
    """Connects a synchronous client, and closes it at the end."""
    assert client.connect()
    try:
        yield client
    finally:
        client.close()


class Patient:
    """A blocking facade for an asyncio client, so that the same tests cover both kinds."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._loop = asyncio.new_event_loop()
        self._client = self.run(self._connected(make))

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def _connected(self, make: Callable[[], Any]) -> Any:
        client = make()
        assert await client.connect()
        return client

    def run(self, awaitable: Awaitable[Any]) -> Any:
        async def awaited() -> Any:
            return await awaitable

        return self._loop.run_until_complete(awaited())

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return lambda *args, **named: self.run(getattr(self._client, name)(*args, **named))

    def many(self, name: str, addresses: Sequence[int]) -> list[Any]:
        """Calls one method concurrently for many addresses."""

        async def gathered() -> list[Any]:
            method = getattr(self._client, name)
            return list(await asyncio.gather(*[method(address) for address in addresses]))

        return list(self.run(gathered()))

    def close(self) -> None:
        self._client.close()
        # The transport closes its socket in the next iteration of the loop.
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()


def tour(client: Any, memory: holdfast.Memory, unit: int) -> None:
    """Calls every function once, and provokes exceptions.

    The unit has 1000 items in every area, all zero, and the vendor name Acme.
    """
    of = {"device_id": unit}
    memory.write("input_registers", 5, range(125))
    memory.write("discrete_inputs", 3, [1, 0, 1])

    assert client.read_input_registers(5, count=125, **of).registers == list(range(125))
    assert client.read_discrete_inputs(3, count=3, **of).bits[:3] == [True, False, True]
    assert not client.write_register(3, 4711, **of).isError()
    assert not client.write_registers(0, [1, 2, 3], **of).isError()
    assert client.read_holding_registers(0, count=4, **of).registers == [1, 2, 3, 4711]
    assert not client.write_coil(2, True, **of).isError()
    assert not client.write_coils(3, [True, False, True], **of).isError()
    assert client.read_coils(2, count=4, **of).bits[:4] == [True, True, False, True]
    assert not client.mask_write_register(address=0, and_mask=0, or_mask=9, **of).isError()
    both = client.readwrite_registers(
        read_address=0, read_count=3, write_address=1, values=[70, 80], **of
    )
    assert both.registers == [9, 70, 80]
    assert memory.read("holding_registers", 0, 5) == [9, 70, 80, 4711, 0]
    assert not client.write_registers(100, list(range(123)), **of).isError()
    assert memory.read("holding_registers", 100, 123) == list(range(123))

    assert client.diag_query_data(b"\x12\x34", **of).message == b"\x12\x34"
    assert client.diag_read_bus_message_count(**of).message > 10
    assert client.diag_get_comm_event_counter(**of).count > 10
    assert b"Acme" in client.report_device_id(**of).identifier
    assert client.read_device_information(read_code=1, **of).information[0] == b"Acme"

    assert client.read_coils(1000, **of).exception_code == 2
    assert client.write_registers(999, [1, 2], **of).exception_code == 2
