"""Runs a NATS server on a free port until standard input is closed."""

from __future__ import annotations

import sys

from holdfast.net.nats_server import TemporaryServer

with TemporaryServer(0) as server:
    print(f"listening {server.url.removeprefix('nats://')}", flush=True)
    sys.stdin.read()
