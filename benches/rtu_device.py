"""An RTU device at the other end of pseudo-terminals: it answers every read of 8 bytes at once."""

from __future__ import annotations

import os
import select
import sys
import tty

QUANTITY = 10


def crc(body: bytes) -> bytes:
    remainder = 0xFFFF
    for byte in body:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xA001 if remainder & 1 else 0)
    return remainder.to_bytes(2, "little")


def main() -> None:
    """Prints the device of each line, then answers until it is killed."""
    body = bytes([1, 3, 2 * QUANTITY, *b"".join(n.to_bytes(2, "big") for n in range(QUANTITY))])
    reply = body + crc(body)
    ends: dict[int, bytes] = {}
    held = []
    for name in sys.argv[1:]:
        end, device = os.openpty()
        tty.setraw(device)
        ends[end] = b""
        held.append(device)
        print(f"listening {name} {os.ttyname(device)}", flush=True)
    while True:
        for end in select.select(list(ends), [], [])[0]:
            ends[end] += os.read(end, 4096)
            while len(ends[end]) >= 8:
                ends[end] = ends[end][8:]
                os.write(end, reply)


if __name__ == "__main__":
    main()
