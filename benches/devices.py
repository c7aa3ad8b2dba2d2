"""Runs Modbus devices, one on each address of 127.0.0.0/8: 1,000 holding registers, unit 1."""

from __future__ import annotations

import resource
import sys

import holdfast

hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
memory = holdfast.Memory(holding_registers=1000)
memory.write("holding_registers", 0, range(1000))
with holdfast.Server(
    {1: memory},
    bind="0.0.0.0:0",
    sources=["127.0.0.0/8"],
    access="read-only",
    max_connections=10_000,
) as server:
    print(f"listening 127.0.0.1:{server.address[1]}", flush=True)
    sys.stdin.read()
