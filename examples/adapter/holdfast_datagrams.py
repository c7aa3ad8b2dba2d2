"""An adapter that writes text datagrams, `address value value …`, to input registers."""

from __future__ import annotations

import socket

from holdfast.adapters import Context, Refused, Stop


class Datagrams:
    def __init__(self, context: Context) -> None:
        self.context = context

    def run(self, stop: Stop) -> None:
        memory = next(iter(self.context.grant.memories))
        with socket.socket(type=socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", self.context.options["port"]))
            receiver.settimeout(0.2)
            while not stop.is_set():
                try:
                    text, peer = receiver.recvfrom(65535)
                    address, *values = [int(word) for word in text.split()]
                    command = {"memory": memory, "area": "input_registers", "address": address}
                    self.context.memory_access.write(
                        [command | {"values": values}], self.context.grant, f"{peer[0]}:{peer[1]}"
                    )
                except (TimeoutError, ValueError, Refused):
                    continue  # The memory access has counted and logged the refusal.

    def status(self) -> dict[str, object]:
        return {"port": self.context.options["port"]}
