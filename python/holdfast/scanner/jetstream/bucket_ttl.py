"""Removes the TTL of a bucket of subscriptions, after which the server would remove them.

Holdfast makes such buckets without one, so somebody else has set it. The subscriptions are used in
any case: one that ends later is worth more than none.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.scanner.jetstream.availability import JETSTREAM_TIMEOUT_S, reason_of

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.js.api import StreamConfig

RETRY_S = 600.0
"""Seconds before a TTL that could not be removed is tried, and logged, again."""


class TtlRemoval:
    """Removes the TTL of one bucket."""

    def __init__(self) -> None:
        self._failed_at = -math.inf

    async def remove(self, client: Client, found: StreamConfig) -> bool:
        """Returns whether there was a TTL and it is removed. All other settings stay.

        Logs the removal, and why it has failed.
        """
        if not found.max_age or time.monotonic() < self._failed_at + RETRY_S:
            return False
        stream = found.name or ""
        fields = {"bucket": stream.removeprefix("KV_")}
        ttl = f"TTL of {found.max_age:.10g} s"
        try:
            jetstream = client.jetstream(timeout=JETSTREAM_TIMEOUT_S)
            await jetstream.update_stream(replace(found, max_age=0.0))
        except Exception as error:  # As for all that is kept, see `EntryStore`.
            self._failed_at = time.monotonic()
            reason = f"the bucket removes them after its {ttl}, which stays: {reason_of(error)}"
            todo = f"nats stream edit {stream} --max-age=0"
            log_lines.write(
                logging.WARNING, "subscriptions_not_kept", **fields, reason=reason, todo=todo
            )
            return False
        reason = f"the {ttl} of the bucket was removed"
        log_lines.write(logging.INFO, "subscriptions_kept", **fields, reason=reason)
        return True
