"""The device that the appliance mirrors: it knows the time and the order of all its values.

It shares no code with the library. It changes by itself, takes writes, and sometimes misbehaves: it
refuses a write, hangs up, or does not answer, before or after it has taken a write.
"""

from __future__ import annotations

import random
import struct
import threading
from typing import TYPE_CHECKING, NamedTuple

from oracle.history import Version, now
from support.fake_device import Asked, Stream, exception
from support.server_model import pack_bits, pack_registers, unpack_bits, unpack_registers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from oracle.layout import Block

COILS = "coils"
REGISTERS = "holding_registers"


class Part(NamedTuple):
    """A block of the device, and the block of the memory that it is read into."""

    device: Block
    mirror: Block


class Fates(NamedTuple):
    """How often a request ends in another way than with a reply, of 1000."""

    refused: int = 30
    cut_before: int = 10
    cut_after: int = 10
    silent: int = 2
    cut_read: int = 15
    silent_read: int = 1


FATES = Fates()


class MirroredDevice(Stream):
    """Serves on a thread of its own until `stop`."""

    is_modelled = False

    def __init__(self, parts: Sequence[Part], seed: str, fates: Fates = FATES) -> None:
        super().__init__("tcp", then=self._serve_one)
        self.parts = list(parts)
        self.versions: list[list[Version]] = [[] for _ in parts]
        """For each part, what it had, in order."""
        self.before: list[int] = []
        """What they had at the beginning of the round."""
        self.is_obedient = False
        """Whether it answers all requests."""
        self._chance = random.Random(seed)
        self._fates = fates
        self._items: dict[str, dict[int, int]] = {COILS: {}, REGISTERS: {}}
        self._lock = threading.Lock()
        for part in parts:
            places = range(part.device.address, part.device.address + part.device.count)
            self._items[part.device.area].update(dict.fromkeys(places, 0))

    def begin_round(self) -> None:
        """Forgets what it had before."""
        with self._lock:
            self.before = self._held()
            self.versions = [[] for _ in self.parts]

    def change(self, at: int, write_id: int) -> None:
        """Changes a part, as a device does by itself."""
        block = self.parts[at].device
        with self._lock:
            self._put(block.area, block.address, block.encode(write_id))

    def held(self) -> list[int]:
        """The ids of all parts."""
        with self._lock:
            return self._held()

    def _held(self) -> list[int]:
        found = [self._id(part.device) for part in self.parts]
        return [each for each in found if each is not None]

    def _id(self, block: Block) -> int | None:
        return block.decode(tuple(self._take(block.area, block.address, block.count)))

    def _take(self, area: str, address: int, count: int) -> list[int]:
        items = self._items[area]
        return [items[at] for at in range(address, address + count)]

    def _put(self, area: str, address: int, items: Sequence[int]) -> None:
        self._items[area].update(enumerate(items, address))
        time = now()
        for part, versions in zip(self.parts, self.versions, strict=True):
            block = part.device
            is_inside = address <= block.address < address + len(items)
            if block.area == area and is_inside:
                found = self._id(block)
                assert found is not None, f"{block.name} was written in part"
                versions.append(Version(found, time))

    def _serve_one(self, asked: Asked) -> None:
        # The list of requests would grow for hours.
        self.requests.clear()
        pdu, fates = asked.pdu, self._fates
        dice = 1000 if self.is_obedient else self._chance.randrange(1000)
        with self._lock:
            if pdu[0] <= 4:
                if dice < fates.cut_read:
                    asked.peer.hang_up()
                elif dice >= fates.cut_read + fates.silent_read:
                    asked.answer(self._read(pdu))
                return
            for name, limit in (("refused", fates.refused), ("cut_before", fates.cut_before)):
                if dice < limit:
                    if name == "refused":
                        asked.answer(exception(pdu, 4))
                    else:
                        asked.peer.hang_up()
                    return
                dice -= limit
            reply = self._write(pdu)
            if dice < fates.cut_after:
                asked.peer.hang_up()
            elif dice >= fates.cut_after + fates.silent:
                asked.answer(reply)

    def _read(self, pdu: bytes) -> bytes:
        address, count = struct.unpack(">HH", pdu[1:5])
        try:
            items = self._take(COILS if pdu[0] == 1 else REGISTERS, address, count)
        except KeyError:
            return exception(pdu, 2)
        data = pack_bits(items) if pdu[0] == 1 else pack_registers(items)
        return bytes([pdu[0], len(data)]) + data

    def _write(self, pdu: bytes) -> bytes:
        code, address = pdu[0], int.from_bytes(pdu[1:3])
        if code in (5, 6):
            value = int.from_bytes(pdu[3:5])
            self._put(
                *((COILS, address, [value >> 15]) if code == 5 else (REGISTERS, address, [value]))
            )
            return pdu
        if code == 22:
            and_mask, or_mask = struct.unpack(">HH", pdu[3:7])
            [held] = self._take(REGISTERS, address, 1)
            self._put(REGISTERS, address, [held & and_mask | or_mask & ~and_mask & 0xFFFF])
            return pdu
        if code == 23:
            address = int.from_bytes(pdu[5:7])
            self._put(REGISTERS, address, unpack_registers(pdu[10:]))
            return bytes([23]) + self._read(b"\x03" + pdu[1:5])[1:]
        count = int.from_bytes(pdu[3:5])
        if code == 15:
            self._put(COILS, address, unpack_bits(pdu[6:], count))
        else:
            self._put(REGISTERS, address, unpack_registers(pdu[6:]))
        return pdu[:5]
