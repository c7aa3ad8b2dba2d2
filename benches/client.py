"""Compares the clients with those of pymodbus and libmodbus, and with plain asyncio.

The Holdfast server has one core, the measured client the other. The order of the clients rotates,
so that changes of the machine's speed affect all alike. Ratios compare results of the same round;
figures are the medians of all rounds. Every reply is checked: register N holds N. `--loop` and
`--against` compare event loops and versions.
"""

from __future__ import annotations

import asyncio
import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias, cast

import common
from common import Result, TurnFailed

import holdfast
from holdfast.net import event_loop

LOOPS = {"asyncio": asyncio.new_event_loop, "uvloop": event_loop.fastest}
SHAPES = [(1, 1), (1, 16), (16, 1), (64, 1)]
"""The number of connections, and of concurrent calls on each."""
QUANTITY = 10
REGISTERS = list(range(QUANTITY))
REQUEST = common.REQUEST[:-1] + bytes([QUANTITY])
PATIENT: dict[str, Any] = {"timeout": 10}

Read: TypeAlias = Callable[[], Awaitable[None]]
"""One read of an asyncio client, with a check of the reply."""
Calls: TypeAlias = tuple[list[Read], Callable[[], Any]]
"""The read of each connection, and a function that closes all connections."""


def main() -> None:
    """Prints a table for each shape, and writes all results to the file of `--json`."""
    if sys.argv[1:2] == ["turn"]:
        print(json.dumps(turn(*sys.argv[2:])))
        return
    parser = common.parser(__doc__, seconds=1, rounds=9)
    parser.add_argument("--loop", choices=LOOPS, default="asyncio", help="default asyncio")
    parser.add_argument("--against", type=Path, help="another checkout, whose Client is measured")
    options = common.parsed(parser)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        libmodbus = compiled(Path(folder))
        with common.started(
            "holdfast", common.python("holdfast_server.py"), options.core
        ) as server:
            host, port = server.address.rsplit(":", 1)
            blocking = {
                name: common.python("client.py", "turn", name, server.address) for name in BLOCKING
            }
            blocking["libmodbus"] = [libmodbus, host, port, str(QUANTITY)]
            results.append(measure("blocking, one call at a time", blocking, options))
            for connections, at_once in SHAPES:
                title = f"{connections} connections, {at_once} concurrent calls on each, asyncio"
                shape = (server.address, options.loop, connections, at_once)
                commands = {
                    name: common.python("client.py", "turn", name, *shape) for name in ASYNCIO
                }
                if options.against:
                    interpreter = options.against / ".venv" / "bin" / "python"
                    commands["Client before"] = [str(interpreter), *commands["Client"][1:]]
                if at_once > 1:
                    del commands["asyncio itself"]
                results.append(measure(title, commands, options))
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def compiled(folder: Path) -> str:
    """Compiles the libmodbus client and returns its path."""
    asked = ["pkg-config", "--cflags", "--libs", "libmodbus"]
    try:
        flags = subprocess.check_output(asked, text=True)
    except (OSError, subprocess.CalledProcessError):
        sys.exit("libmodbus with its headers is not installed (package libmodbus-dev)")
    source = Path(__file__).with_name("libmodbus_client.c")
    program = str(folder / "client")
    subprocess.run(["cc", "-O2", "-o", program, source, *shlex.split(flags)], check=True)
    return program


def measure(title: str, commands: dict[str, list[str]], options: Any) -> dict[str, Any]:
    """Measures every client once per round, and prints the table."""
    rounds: list[dict[str, Result]] = []
    failures: dict[str, str] = {}
    for index in range(options.rounds):
        results: dict[str, Result] = {}
        for name in common.turns(list(commands), index):
            command = [*commands[name], str(options.seconds)]
            try:
                results[name] = common.outcome(command, options.seconds, options.other)
            except TurnFailed as failure:
                failures[name] = str(failure)
        rounds.append(results)
    show(title, list(commands), rounds, failures)
    return {"title": title, "rounds": rounds, "failures": failures}


def show(
    title: str, names: list[str], rounds: list[dict[str, Result]], failures: dict[str, str]
) -> None:
    print(f"\n{title}:")
    print(f"  client           reads/s  cpu us/read  {names[0]} / client (min to max)")
    for name in names:
        if name in failures:
            print(f"  {name:14}  failed: {failures[name]}")
            continue
        rate, cpu = common.medians(rounds, name, "rate", "cpu_us")
        against = "" if name == names[0] else common.ratio(rounds, names[0], name)
        print(f"  {name:14} {rate:9,.0f}  {cpu:11.1f}  {against}".rstrip())
    sys.stdout.flush()


# One turn, in a process of its own


def turn(name: str, address: str, *numbers: str) -> Result:
    """Reads for some seconds. Returns the rate and the processor time per read."""
    host, port = address.rsplit(":", 1)
    *shape, seconds = numbers
    if name in BLOCKING:
        return blocking_turn(BLOCKING[name](host, int(port)), float(seconds))
    loop, *counts = shape
    connections, at_once = map(int, counts)
    made = ASYNCIO[name](host, int(port), connections, at_once)
    with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
        return runner.run(asyncio_turn(made, at_once, float(seconds)))


def checked(registers: Sequence[int]) -> None:
    if registers != REGISTERS:
        raise RuntimeError(f"wrong reply: {registers}")


def blocking_turn(read: Callable[[], Sequence[int]], seconds: float) -> Result:
    def until(end: float) -> int:
        count = 0
        while time.perf_counter() < end:
            checked(read())
            count += 1
        return count

    until(time.perf_counter() + seconds / 10)
    began, worked = time.perf_counter(), time.process_time()
    return figures(until(began + seconds), began, worked)


def figures(count: int, began: float, worked: float) -> Result:
    took, work = time.perf_counter() - began, time.process_time() - worked
    return {"rate": count / took, "cpu_us": work / count * 1e6}


async def asyncio_turn(made: Awaitable[Calls], at_once: int, seconds: float) -> Result:
    reads, close = await made

    async def until(read: Read, end: float) -> int:
        count = 0
        while time.perf_counter() < end:
            await read()
            count += 1
        return count

    async def all_until(end: float) -> int:
        return sum(await asyncio.gather(*[until(read, end) for read in reads * at_once]))

    await all_until(time.perf_counter() + seconds / 10)
    began, worked = time.perf_counter(), time.process_time()
    result = figures(await all_until(began + seconds), began, worked)
    await close()
    return result


async def holdfast_calls(host: str, port: int, connections: int, at_once: int) -> Calls:
    url = f"tcp://{host}:{port}"
    clients = [holdfast.Client(url, max_in_flight=at_once, **PATIENT) for _ in range(connections)]

    def reading(client: holdfast.Client) -> Read:
        async def read() -> None:
            checked(await client.read_holding_registers(0, QUANTITY))

        return read

    async def close() -> None:
        for client in clients:
            await client.close()

    return [reading(client) for client in clients], close


async def pymodbus_calls(host: str, port: int, connections: int, _: int) -> Calls:
    from pymodbus.client import AsyncModbusTcpClient

    clients = [AsyncModbusTcpClient(host, port=port, **PATIENT) for _ in range(connections)]
    for client in clients:
        await client.connect()

    def reading(client: AsyncModbusTcpClient) -> Read:
        async def read() -> None:
            checked((await client.read_holding_registers(0, count=QUANTITY)).registers)

        return read

    async def close() -> None:
        for client in clients:
            client.close()

    return [reading(client) for client in clients], close


class Bare(asyncio.Protocol):
    """The upper limit of asyncio: a request and a future, without a check of the reply."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)  # Those of uvloop have no such base.
        self.loop = asyncio.get_running_loop()

    def data_received(self, _: bytes) -> None:
        self.reply.set_result(None)

    async def read(self) -> None:
        self.reply: asyncio.Future[None] = self.loop.create_future()
        self.transport.write(REQUEST)
        await self.reply


async def bare_calls(host: str, port: int, connections: int, _: int) -> Calls:
    loop = asyncio.get_running_loop()
    made = [(await loop.create_connection(Bare, host, port))[1] for _ in range(connections)]

    async def close() -> None:
        for protocol in made:
            protocol.transport.abort()

    return [protocol.read for protocol in made], close


ASYNCIO: dict[str, Callable[[str, int, int, int], Awaitable[Calls]]] = {
    "Client": holdfast_calls,
    "pymodbus": pymodbus_calls,
    "asyncio itself": bare_calls,
}


def holdfast_read(host: str, port: int) -> Callable[[], Sequence[int]]:
    client = holdfast.SyncClient(f"tcp://{host}:{port}", **PATIENT)
    return lambda: client.read_holding_registers(0, QUANTITY)


def pymodbus_read(host: str, port: int) -> Callable[[], Sequence[int]]:
    from pymodbus.client import ModbusTcpClient

    client: Any = ModbusTcpClient(host, port=port, **PATIENT)
    client.connect()
    return lambda: client.read_holding_registers(0, count=QUANTITY).registers


BLOCKING: dict[str, Callable[[str, int], Callable[[], Sequence[int]]]] = {
    "SyncClient": holdfast_read,
    "pymodbus sync": pymodbus_read,
}


if __name__ == "__main__":
    main()
