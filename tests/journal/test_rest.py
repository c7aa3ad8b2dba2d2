"""Writes of REST to memories that are kept wait for a disk or a log, and hold up nothing else."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any, cast

import holdfast
from holdfast import _core
from holdfast.events.audit import Audit
from holdfast.ingest import Grant, MemoryAccess
from support import audits, web, wire

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from journal.conftest import Node
    from support.brokers import NatsServer

MANY = 33
"""More writes than threads of an event loop: those of its default executor."""

GRANT = Grant("edge", ["plant"], ["holding_registers"])


def body(memory: str, value: int) -> bytes:
    return json.dumps(web.command("holding_registers", 0, [value], memory)).encode()


@contextlib.contextmanager
def kept(path: Path) -> Iterator[holdfast.Memory]:
    memory = holdfast.Memory(holding_registers=8)
    file = _core.MemoryFile(str(path), [("plant", memory)], 0.0)
    file.start()
    yield memory
    file.stop()


def test_writes_that_wait_for_a_log_hold_up_no_write_to_another_memory(
    nats: NatsServer, node: Callable[..., Node], tmp_path: Path
) -> None:
    slow = node("a", write_timeout=10 * wire.DEADLINE)
    with kept(tmp_path / "quick.redb") as quick, contextlib.ExitStack() as waiting:
        token = web.token("edge", "secret", memories=("slow", "quick"), manage=True)
        service = web.Service({"slow": slow.memory, "quick": quick}, tokens=[token])
        headers = ("Authorization: Bearer secret", "Connection: close")
        with web.supervised(service.supervisor, service.listener):
            nats.freeze()
            sent = [waiting.enter_context(wire.Connection(service.address)) for _ in range(MANY)]
            for value, connection in enumerate(sent):
                connection.send(web.post(body("slow", value), *headers))
            with contextlib.closing(web.Client(service.address, "secret")) as client:
                assert client.ingest(body("quick", 7)).status == 200
                answer = client.ask("POST", "/api/v1/sessions/end", {"id": "scada/1"})
                assert answer.json["reason"] == "unknown_session"
            nats.thaw()
            for connection in sent:
                [answer] = web.answers(connection.rest())
                assert answer.status == 200
    assert quick.read("holding_registers", 0, 1) == [7]


def test_a_write_whose_outcome_nobody_waited_for_is_recorded(
    nats: NatsServer, node: Callable[..., Node], tmp_path: Path
) -> None:
    """The log answers later than REST ends."""
    slow = node("a", write_timeout=10 * wire.DEADLINE)
    audit = Audit(tmp_path / "audit.jsonl", max_bytes=65536, keep=1)
    memory_access = MemoryAccess("rest", {"plant": slow.memory}, audit)

    async def cancelled() -> None:
        keeping = asyncio.create_task(memory_access.finish_async(begun))
        await asyncio.sleep(0)  # It begins.
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)

    nats.freeze()
    begun = memory_access.begin(body("plant", 7), GRANT, "127.0.0.1:50000")
    asyncio.run(cancelled())
    nats.thaw()
    wire.until(lambda: slow.read(0) == 7, "it is carried out")
    assert memory_access.counts()["refused"] == {"not_confirmed": 1}
    [line] = audits.writes(tmp_path / "audit.jsonl")
    assert (line["values"], line["outcome"]) == ([7], "not_confirmed")


def test_a_range_that_a_reload_gives_to_a_device_meanwhile_goes_there(tmp_path: Path) -> None:
    class Passage:
        def device_of(self, *_: object) -> str:
            return "drive"

    with kept(tmp_path / "plant.redb") as plant:
        passages = cast("Any", {"plant": Passage()})
        memory_access = MemoryAccess("rest", {"plant": plant}, passages=passages)
        begun = memory_access.begin(body("plant", 7), GRANT, "127.0.0.1:50000")
        plant.mirror([("holding_registers", 0, 8)])
        assert asyncio.run(memory_access.finish_async(begun)) is None
    assert begun.device == "drive"
    assert plant.read("holding_registers", 0, 1) == [0]
