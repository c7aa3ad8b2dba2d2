"""Runs the Holdfast server under test: 1,000 holding registers, unit 1."""

from __future__ import annotations

import sys

import holdfast

memory = holdfast.Memory(holding_registers=1000)
memory.write("holding_registers", 0, range(1000))
with holdfast.Server(
    {1: memory}, bind="127.0.0.1:0", access="read-write", max_connections=2000
) as server:
    host, port = server.address
    print(f"listening {host}:{port}", flush=True)
    sys.stdin.read()
