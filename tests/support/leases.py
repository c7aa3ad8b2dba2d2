"""Times of leases for tests, and buckets in which nobody waits for a former holder."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from nats.aio.client import Client

from holdfast.replication.leases.bucket import LeaseBucket
from holdfast.replication.leases.times import LeaseTimes

if TYPE_CHECKING:
    from collections.abc import Iterable


SHORT = LeaseTimes(ttl_s=0.6, hold_s=0.4, renewal_s=0.2)
"""For leases that may end at any time: a loaded machine can be too late to renew them."""

BRIEF = LeaseTimes(ttl_s=2.0, hold_s=0.75, renewal_s=0.25)
"""The same, with devices: what is on its way to one when its node stops has longer to arrive than
by default, because a device of a test may be late to notice it."""

LASTING = LeaseTimes(ttl_s=1.5, hold_s=1.0, renewal_s=0.1)
"""For leases that must not end while they are renewed."""

ENDLESS = LeaseTimes(ttl_s=3600.0)
"""For leases that can only be given back."""


def make_settled(url: str, name: str, given_back: Iterable[str] = (), replicas: int = 1) -> None:
    """Makes a bucket that has existed for long enough: leases may be taken at once.

    The leases `given_back` were held, so the first write to their devices does not wait either.
    """

    async def make() -> None:
        client = Client()
        await client.connect(url)
        bucket = LeaseBucket(client, name)
        await bucket.open(replicas)
        await bucket.settle()
        for key in given_back:
            await bucket.delete(key, 0)
        await client.close()

    asyncio.run(make())
