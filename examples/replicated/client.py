#!/usr/bin/env python3
"""Writes through HAProxy without a pause, and counts what was confirmed and is not there.

python client.py            writes until Ctrl-C
python client.py NUMBER     writes so many values
"""

from __future__ import annotations

import signal
import sys
import time

import holdfast

URL = "tcp://127.0.0.1:5040"
REGISTERS = 1000
BLOCK = 100
PAUSE = 0.1
"""Seconds before a write that failed is sent again."""


def main() -> None:
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    confirmed: dict[int, int] = {}
    writes = failures = lost = 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with holdfast.SyncClient(URL, timeout=3.0) as client:
        try:
            while not number or writes < number:
                address, value = writes % REGISTERS, writes % 65535 + 1
                # Ctrl-C may come before the new value is confirmed: the old one counts no more.
                confirmed.pop(address, None)
                if write(client, address, value):
                    failures += 1
                    found = missing(client, confirmed | {address: value})
                    lost += found
                    print(f"back after {writes} writes: {found} missing", flush=True)
                confirmed[address] = value
                writes += 1
                if writes % 100 == 0:
                    print(f"{writes} writes", flush=True)
        except KeyboardInterrupt:
            pass
        lost += missing(client, confirmed)
    times = "1 interruption" if failures == 1 else f"{failures} interruptions"
    print(f"{writes} writes were confirmed, {times}, {lost} are missing")
    sys.exit(1 if lost else 0)


def write(client: holdfast.SyncClient, address: int, value: int) -> bool:
    """Writes until the write is confirmed. Returns whether it had to be sent again.

    A write that fails may still be carried out. It has one value here, so a second one is harmless.
    """
    failed = False
    while True:
        try:
            client.write_register(address, value)
            return failed
        except holdfast.ModbusError as error:
            if not failed:
                print(f"interrupted: {error}", flush=True)
            failed = True
            time.sleep(PAUSE)


def missing(client: holdfast.SyncClient, confirmed: dict[int, int]) -> int:
    """How many of the confirmed values are not there."""
    while True:
        try:
            # The node that confirms a write has everything that any node has confirmed before.
            for address, value in list(confirmed.items())[-1:]:
                client.write_register(address, value)
            found: list[int] = []
            while len(found) < REGISTERS:
                found += client.read_holding_registers(len(found), BLOCK)
        except holdfast.ModbusError:
            time.sleep(PAUSE)
            continue
        return sum(found[address] != value for address, value in confirmed.items())


if __name__ == "__main__":
    main()
