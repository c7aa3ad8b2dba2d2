"""Parts of a node, without a server."""

from __future__ import annotations

import asyncio

from holdfast.net.nats import batch
from holdfast.net.nats.outbox import Outbox
from holdfast.scanner.fleet.agreement import Terms


def test_a_message_with_the_revision_of_its_lease_has_a_header() -> None:
    text = batch.text("modbus.data.boiler", b'{"value":"a\r\nb"}')
    assert batch.leased(text, 42) == (
        b"HPUB modbus.data.boiler 32 48\r\n"
        b"NATS/1.0\r\nHoldfast-Lease: 42\r\n\r\n"
        b'{"value":"a\r\nb"}\r\n'
    )


def test_a_node_that_was_stopped_for_too_long_drops_what_waits() -> None:
    class Connected:
        """As much of a client as is asked for."""

        is_connected = True
        pending_data_size = 0

    async def work() -> None:
        lost = asyncio.Event()
        outbox = Outbox(may_send=lambda: False, on_drop=lost.set)
        outbox.connected(Connected())  # type: ignore[arg-type]
        outbox.put([(("d", "t"), b"PUB")])
        running = asyncio.create_task(outbox.run())
        await lost.wait()
        assert (outbox.sent, outbox.dropped) == (0, 1)
        running.cancel()

    asyncio.run(work())


def test_the_first_difference_of_terms_is_named() -> None:
    own = Terms(
        protocol=1,
        partitions=256,
        prefix="modbus",
        allow=[],
        writes="tags",
        strict=False,
        defaults="",
        limits="",
        profiles="",
    )
    assert own.difference(own) is None
    other = Terms(**{key: getattr(own, key) for key in own.__struct_fields__} | {"strict": True})
    assert own.difference(other) == "strict is False, and True in the fleet"
