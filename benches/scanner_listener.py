"""Subscribes on NATS, and counts the scanner's messages and their latency.

It parses the protocol itself, because a client library would be slower than the scanner. For each
line on standard input it prints the figures since the previous line as JSON.
"""

from __future__ import annotations

import json
import re
import select
import socket
import sys
import time

TIMESTAMP = re.compile(rb'"timestamp":([0-9]{13})\}')


def main() -> None:
    """Listens at the address and subject of the command line."""
    host, _, port = sys.argv[1].rpartition(":")
    nats = socket.create_connection((host, int(port)))
    nats.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 * 1024 * 1024)
    nats.sendall(b'CONNECT {"verbose":false}\r\nSUB %b 1\r\nPING\r\n' % sys.argv[2].encode())
    rest = b""
    late: list[float] = []
    count, began = 0, time.monotonic()
    print("listening -", flush=True)
    while True:
        readable, _, _ = select.select([nats, sys.stdin], [], [])
        if nats in readable:
            piece = nats.recv(4 * 1024 * 1024)
            if not piece:
                return
            if b"PING\r\n" in piece:
                nats.sendall(b"PONG\r\n")
            now = time.time() * 1000
            text = rest + piece
            found = TIMESTAMP.findall(text)
            rest = text[text.rfind(b"}") + 1 :]
            count += len(found)
            # All values of a poll have the same time, so a sample is enough.
            late += [now - int(moment) for moment in found[::50]]
        if sys.stdin in readable:
            if not sys.stdin.readline():
                return
            late.sort()
            told = {"count": count, "seconds": time.monotonic() - began}
            if late:
                for name, part in (("p50", 0.5), ("p99", 0.99), ("max", 1.0)):
                    told[name] = late[min(int(part * len(late)), len(late) - 1)]
            print(json.dumps(told), flush=True)
            late, count, began = [], 0, time.monotonic()


if __name__ == "__main__":
    main()
