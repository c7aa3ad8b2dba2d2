"""A Modbus server in five lines: `python examples/five_lines.py`, then read it with any client."""

from __future__ import annotations

import holdfast

memory = holdfast.Memory(holding_registers=100, coils=16)
memory.write("holding_registers", 0, [100, 200, 300])
with holdfast.Server({1: memory}, bind="127.0.0.1:5020", access="read-write") as server:
    input(f"Serving on {server.address}. Enter stops it. ")
