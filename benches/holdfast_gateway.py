"""Runs the gateway under test. It may connect only to the device in the first argument."""

from __future__ import annotations

import sys

from holdfast.adapters import Stop
from holdfast.config.egress import parse_allowed
from holdfast.gateway import Gateway, Settings
from holdfast.web.port import listen

with listen("127.0.0.1", 0) as listener:
    gateway = Gateway(Settings((parse_allowed(sys.argv[1]),)), listener)
    print(f"listening {gateway.address}", flush=True)
    gateway.run(Stop())
