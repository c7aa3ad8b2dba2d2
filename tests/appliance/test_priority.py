"""The priority of threads: adapters have a lower one than leases, on Linux."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from nats.errors import Error

from holdfast.appliance.services import supervision
from support import wire
from support.nats_bus import Caller, subscription, tag

if TYPE_CHECKING:
    import holdfast
    from holdfast.appliance import Appliance
    from support.brokers import NatsServer
    from support.running import Run

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads have no priority here")

NODE = """
nats:
  servers: ["{url}"]
  devices: [127.0.0.0/8]
  fleet: {{name: plant, node: a, partitions: 4}}
"""


@pytest.fixture
def lower(monkeypatch: pytest.MonkeyPatch) -> int:
    """The nice value of adapters: only one above that of the process, so that they get time."""
    own = os.getpriority(os.PRIO_PROCESS, 0)
    if own >= 19:
        pytest.skip("the tests have the lowest priority")
    monkeypatch.setattr(supervision, "NICE", own + 1)
    return own + 1


class Threads:
    """The threads that the test has started: others of its process may not have ended yet."""

    def __init__(self) -> None:
        self._before = set(threading.enumerate())

    def named(self, name: str) -> list[threading.Thread]:
        """The threads of that name that run already."""
        running = [each for each in threading.enumerate() if each.native_id is not None]
        return [each for each in running if each.name == name and each not in self._before]

    def nice(self, name: str) -> int:
        """The nice value of a thread."""
        [thread] = self.named(name)
        stat = Path(f"/proc/self/task/{thread.native_id}/stat").read_text()
        return int(stat.rpartition(")")[2].split()[16])


@pytest.fixture
def threads() -> Threads:
    return Threads()


def test_leases_have_the_priority_of_the_process(
    run: Run, own_nats: NatsServer, server: holdfast.Server, lower: int, threads: Threads
) -> None:
    run(NODE.format(url=own_nats.url))
    wire.until(lambda: threads.named("holdfast-leases"), "the leases have their thread")
    assert threads.nice("holdfast-leases") == lower - 1
    wire.until(
        lambda: threads.nice("holdfast-nats") == lower, "the adapter has lowered its priority"
    )
    with Caller(own_nats.url) as caller:
        request = subscription(server, tag("a", 10))
        wire.until(lambda: is_done(caller, request), "the node has its leases")


def is_done(caller: Caller, request: dict[str, object]) -> bool:
    with suppress(Error):  # Nobody answers yet.
        return bool(caller.request("modbus.subscribe", request)["success"])
    return False


def is_connected(appliance: Appliance) -> bool:
    status = appliance.diagnostics.adapter("nats")
    return status is not None and bool(status.get("connected"))


def test_a_starter_tells_that_a_thread_can_not_be_started(threads: Threads) -> None:
    starter = supervision.Starter()
    starter.open()
    started = threading.Thread(target=int)
    starter.start(started)
    with pytest.raises(RuntimeError, match="once"):
        starter.start(started)
    starter.close()
    wire.until(lambda: not threads.named("holdfast-starter_0"), "it has ended")


def test_the_starter_ends_with_the_adapter(
    run: Run, own_nats: NatsServer, threads: Threads
) -> None:
    appliance = run(NODE.format(url=own_nats.url))
    wire.until(lambda: threads.named("holdfast-leases"), "the leases have their thread")
    assert threads.named("holdfast-starter_0")
    wire.until(lambda: is_connected(appliance), "the scanner is connected")
    appliance.stop()
    wire.until(lambda: not threads.named("holdfast-starter_0"), "it has ended")
