"""A NATS server on a free port, for as long as standard input is open."""

from __future__ import annotations

import sys

from holdfast.scanner.embedded import Embedded

with Embedded(0) as server:
    print(f"listening {server.url.removeprefix('nats://')}", flush=True)
    sys.stdin.read()
