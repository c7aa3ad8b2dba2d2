"""Runs the gateway under test, for many watchers, in the event loop of the first argument.

It may connect only to the device in the second argument.
"""

from __future__ import annotations

import sys

import event_loops

loop, device = sys.argv[1:]
event_loops.use(loop)

from holdfast.adapters import Stop  # noqa: E402
from holdfast.config.values.allow_entries import parse_allowed  # noqa: E402
from holdfast.gateway import Gateway, GatewayLimits, Settings  # noqa: E402
from holdfast.net.http.port import listen  # noqa: E402

LIMITS = GatewayLimits(streams=200, connections=200, requests=200, requests_of_device=200)
"""The watchers of a turn may come before those of the last one are gone."""

with listen("127.0.0.1", 0) as listener:
    gateway = Gateway(Settings((parse_allowed(device),), limits=LIMITS), listener)
    print(f"listening {gateway.address}", flush=True)
    gateway.run(Stop())
