"""A model of a Modbus server, written from docs/modbus.md as plainly as possible.

It shares no code with the library: values are integers in dictionaries, and checks are in the order
of that page. It is slow and has no transport. Counters are not modelled.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

ILLEGAL_FUNCTION = 0x01
ILLEGAL_ADDRESS = 0x02
ILLEGAL_VALUE = 0x03
BUSY = 0x06
NO_SUCH_UNIT = 0x0B

BITS = ("coils", "discrete_inputs")
READ = {1: "coils", 2: "discrete_inputs", 3: "holding_registers", 4: "input_registers"}
WRITES = (5, 6, 15, 16, 21, 22, 23)
SUB_FUNCTIONS = (0, 1, 2, 3, 4, *range(0x0A, 0x13), 0x14)
CHANGES_STATE = (1, 3, 4, 0x0A, 0x14)
COUNTERS = range(0x0B, 0x13)


class Refusal(Exception):
    """An exception response."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code:#04x}")
        self.code = code


def require(condition: bool, code: int) -> None:
    if not condition:
        raise Refusal(code)


def pack_bits(bits: list[int]) -> bytes:
    """Packs eight bits into a byte, lowest bit first; unused bits of the last byte are zero."""
    packed = bytearray((len(bits) + 7) // 8)
    for index, bit in enumerate(bits):
        packed[index // 8] |= bit << index % 8
    return bytes(packed)


def unpack_bits(packed: bytes, count: int) -> list[int]:
    return [packed[index // 8] >> index % 8 & 1 for index in range(count)]


def pack_registers(values: list[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


def unpack_registers(packed: bytes) -> list[int]:
    return list(struct.unpack(f">{len(packed) // 2}H", packed))


class ServerModel:
    """One unit of one listener."""

    def __init__(
        self,
        areas: Mapping[str, tuple[int, int]],
        *,
        unit: int = 1,
        read_only: bool = False,
        sealed: bool = False,
    ) -> None:
        self.values = {
            area: dict.fromkeys(range(start, start + size), 0)
            for area, (start, size) in areas.items()
        }
        self.unit = unit
        self.read_only = read_only
        self.sealed = sealed
        self.listen_only = False
        self._forms: dict[int, Callable[[bytes], Callable[[], bytes | None]]] = {
            **dict.fromkeys(READ, self._read),
            5: self._write_coil,
            6: self._write_register,
            8: self._diagnostics,
            15: self._write_coils,
            16: self._write_registers,
            22: self._mask_write,
            23: self._read_write,
        }

    def answer(self, unit: int, pdu: bytes) -> bytes | None:
        """Returns the PDU of the reply, or `None` if there is no reply."""
        try:
            return self._serve(unit, pdu)
        except Refusal as refusal:
            return bytes([pdu[0] | 0x80, refusal.code])

    def _serve(self, unit: int, pdu: bytes) -> bytes | None:
        if self.listen_only and unit == self.unit:
            restart = pdu in (b"\x08\x00\x01\x00\x00", b"\x08\x00\x01\xff\x00")
            if restart and self._allowed(pdu):
                self.listen_only = False
            return None
        require(self._allowed(pdu), ILLEGAL_FUNCTION)
        require(unit == self.unit, NO_SUCH_UNIT)
        carry_out = self._forms[pdu[0]](pdu)
        require(not self.sealed, BUSY)
        return carry_out()

    def _allowed(self, pdu: bytes) -> bool:
        if pdu[0] not in self._forms or (self.read_only and pdu[0] in WRITES):
            return False
        if pdu[0] == 8 and len(pdu) >= 3:
            sub_function = int.from_bytes(pdu[1:3], "big")
            known = sub_function in SUB_FUNCTIONS
            return known and not (self.read_only and sub_function in CHANGES_STATE)
        return True

    def _take(self, area: str, address: int, count: int) -> list[int]:
        held = self.values.get(area, {})
        wanted = range(address, address + count)
        require(all(at in held for at in wanted), ILLEGAL_ADDRESS)
        return [held[at] for at in wanted]

    def _put(self, area: str, address: int, values: list[int]) -> None:
        self._take(area, address, len(values))
        self.values[area].update(enumerate(values, address))

    def _read(self, pdu: bytes) -> Callable[[], bytes]:
        area = READ[pdu[0]]
        require(len(pdu) == 5, ILLEGAL_VALUE)
        address, quantity = struct.unpack(">HH", pdu[1:])
        require(1 <= quantity <= (2000 if area in BITS else 125), ILLEGAL_VALUE)

        def carry_out() -> bytes:
            values = self._take(area, address, quantity)
            data = pack_bits(values) if area in BITS else pack_registers(values)
            return bytes([pdu[0], len(data)]) + data

        return carry_out

    def _write_coil(self, pdu: bytes) -> Callable[[], bytes]:
        require(len(pdu) == 5, ILLEGAL_VALUE)
        address, value = struct.unpack(">HH", pdu[1:])
        require(value in (0x0000, 0xFF00), ILLEGAL_VALUE)

        def carry_out() -> bytes:
            self._put("coils", address, [int(value == 0xFF00)])
            return pdu

        return carry_out

    def _write_register(self, pdu: bytes) -> Callable[[], bytes]:
        require(len(pdu) == 5, ILLEGAL_VALUE)
        address, value = struct.unpack(">HH", pdu[1:])

        def carry_out() -> bytes:
            self._put("holding_registers", address, [value])
            return pdu

        return carry_out

    def _write_coils(self, pdu: bytes) -> Callable[[], bytes]:
        require(len(pdu) >= 6, ILLEGAL_VALUE)
        address, quantity, byte_count = struct.unpack(">HHB", pdu[1:6])
        require(1 <= quantity <= 1968, ILLEGAL_VALUE)
        require(byte_count == (quantity + 7) // 8 == len(pdu) - 6, ILLEGAL_VALUE)

        def carry_out() -> bytes:
            self._put("coils", address, unpack_bits(pdu[6:], quantity))
            return pdu[:5]

        return carry_out

    def _write_registers(self, pdu: bytes) -> Callable[[], bytes]:
        require(len(pdu) >= 6, ILLEGAL_VALUE)
        address, quantity, byte_count = struct.unpack(">HHB", pdu[1:6])
        require(1 <= quantity <= 123, ILLEGAL_VALUE)
        require(byte_count == quantity * 2 == len(pdu) - 6, ILLEGAL_VALUE)

        def carry_out() -> bytes:
            self._put("holding_registers", address, unpack_registers(pdu[6:]))
            return pdu[:5]

        return carry_out

    def _mask_write(self, pdu: bytes) -> Callable[[], bytes]:
        require(len(pdu) == 7, ILLEGAL_VALUE)
        address, and_mask, or_mask = struct.unpack(">HHH", pdu[1:])

        def carry_out() -> bytes:
            [now] = self._take("holding_registers", address, 1)
            new = (now & and_mask) | (or_mask & ~and_mask & 0xFFFF)
            self._put("holding_registers", address, [new])
            return pdu

        return carry_out

    def _read_write(self, pdu: bytes) -> Callable[[], bytes]:
        require(len(pdu) >= 10, ILLEGAL_VALUE)
        read_address, read_quantity, address, quantity, byte_count = struct.unpack(
            ">HHHHB", pdu[1:10]
        )
        require(1 <= read_quantity <= 125, ILLEGAL_VALUE)
        require(1 <= quantity <= 121, ILLEGAL_VALUE)
        require(byte_count == quantity * 2 == len(pdu) - 10, ILLEGAL_VALUE)

        def carry_out() -> bytes:
            self._take("holding_registers", read_address, read_quantity)
            self._put("holding_registers", address, unpack_registers(pdu[10:]))
            data = pack_registers(self._take("holding_registers", read_address, read_quantity))
            return bytes([23, len(data)]) + data

        return carry_out

    def _diagnostics(self, pdu: bytes) -> Callable[[], bytes | None]:
        require(len(pdu) >= 3, ILLEGAL_VALUE)
        sub_function, data = int.from_bytes(pdu[1:3], "big"), pdu[3:]
        if sub_function == 0:
            require(len(data) >= 2 and len(data) % 2 == 0, ILLEGAL_VALUE)
        elif sub_function == 1:
            require(data in (b"\x00\x00", b"\xff\x00"), ILLEGAL_VALUE)
        elif sub_function == 3:
            require(len(data) == 2 and data[0] < 0x80 and data[1] == 0, ILLEGAL_VALUE)
        else:
            require(data == b"\x00\x00", ILLEGAL_VALUE)

        def carry_out() -> bytes | None:
            assert sub_function not in COUNTERS, "counters are not modelled"
            if sub_function == 4:
                self.listen_only = True
                return None
            return pdu

        return carry_out
