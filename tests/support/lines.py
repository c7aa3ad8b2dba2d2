"""Serial lines made of pseudo-terminals, and the framing of Modbus on a line.

It shares no code with the library: check sums are calculated bit by bit, as the standard describes
them.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import struct
import termios
import threading
import time
import tty
from dataclasses import dataclass
from typing import TYPE_CHECKING

from support import wire
from support.config_folder import written

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path
    from types import TracebackType
    from typing import Any, Self

UNIT = 7


def crc(body: bytes) -> bytes:
    """CRC-16 with the polynomial x16 + x15 + x2 + 1, low byte first."""
    remainder = 0xFFFF
    for byte in body:
        remainder ^= byte
        for _ in range(8):
            carry = remainder & 1
            remainder >>= 1
            if carry:
                remainder ^= 0xA001
    return struct.pack("<H", remainder)


def rtu(pdu: bytes, unit: int = UNIT) -> bytes:
    body = bytes([unit]) + pdu
    return body + crc(body)


def from_rtu(frame: bytes) -> tuple[int, bytes]:
    """Parses a frame to unit id and PDU."""
    if len(frame) < 4 or crc(frame[:-2]) != frame[-2:]:
        raise AssertionError(f"no RTU frame: {frame.hex()}")
    return frame[0], frame[1:-2]


def rtu_length(received: bytes) -> int | None:
    """Returns the length of the RTU reply at the start of some bytes, from its function code."""
    if len(received) < 5:
        return None
    code = received[1]
    if code & 0x80:
        return 5
    if code == 8:
        # The reply has any number of words. It ends where the CRC first matches.
        ends = range(8, len(received) + 1, 2)
        return next(
            (end for end in ends if received.startswith(crc(received[: end - 2]), end - 2)), None
        )
    if code == 43:
        return identification_length(received)
    fixed = {5: 8, 6: 8, 7: 5, 11: 8, 15: 8, 16: 8, 22: 10}
    of_queue = {24: 6 + int.from_bytes(received[2:4], "big")}
    end = (fixed | of_queue).get(code, 5 + received[2])
    return end if len(received) >= end else None


def identification_length(received: bytes) -> int | None:
    """Returns the length of the reply to function 43/14, from its number of objects."""
    end = 8
    for _ in range(received[7] if len(received) > 7 else 0):
        if len(received) < end + 2:
            return None
        end += 2 + received[end + 1]
    return end + 2 if len(received) >= end + 2 else None


def lrc(body: bytes) -> int:
    return -sum(body) & 0xFF


def ascii_frame(pdu: bytes, unit: int = UNIT) -> bytes:
    body = bytes([unit]) + pdu
    return b":%s%02X\r\n" % (body.hex().upper().encode(), lrc(body))


def from_ascii(frame: bytes) -> tuple[int, bytes]:
    """Parses a frame to unit id and PDU."""
    if frame[:1] != b":" or frame[-2:] != b"\r\n" or frame != frame.upper():
        raise AssertionError(f"no ASCII frame: {frame!r}")
    body = bytes.fromhex(frame[1:-2].decode())
    if sum(body) & 0xFF:
        raise AssertionError(f"the LRC is wrong: {frame!r}")
    return body[0], body[1:-1]


def ascii_length(received: bytes) -> int | None:
    """Returns the length of the ASCII frame at the start of some bytes."""
    return received.index(b"\r\n") + 2 if b"\r\n" in received else None


@dataclass(frozen=True)
class Mode:
    """A mode of framing on a line."""

    name: str
    frame: Callable[..., bytes]
    """Builds a frame from a PDU and a unit id."""
    unframe: Callable[[bytes], tuple[int, bytes]]
    length: Callable[[bytes], int | None]

    @property
    def listener(self) -> str:
        """The listener type."""
        return f"modbus-{self.name}"

    def damaged(self, pdu: bytes, unit: int = UNIT) -> bytes:
        """Builds a frame whose check sum is wrong by one bit."""
        frame = bytearray(self.frame(pdu, unit))
        # The digits of a check sum stay digits: 0 and 1, 2 and 3… differ only in the last bit.
        frame[-1 if self is RTU else -3] ^= 1
        return bytes(frame)


RTU = Mode("rtu", rtu, from_rtu, rtu_length)
ASCII = Mode("ascii", ascii_frame, from_ascii, ascii_length)


def configuration(
    mode: Mode,
    device: Path,
    *,
    units: Mapping[int, str | dict[str, Any]] | None = None,
    memories: dict[str, Any] | None = None,
    rule: dict[str, Any] | None = None,
    more_rules: Sequence[dict[str, Any]] = (),
    serial: dict[str, Any] | None = None,
    listener: dict[str, Any] | None = None,
    **more: Any,
) -> str:
    """Builds a configuration with one listener, `line`, which serves unit 7 by default."""
    everything = dict.fromkeys(
        ("coils", "discrete_inputs", "holding_registers", "input_registers"), 1000
    )
    first = {"units": dict(units or {UNIT: "plant"}), "access": "read-write", **(rule or {})}
    rules = [first, *more_rules]
    line = {"device": str(device), "parity": "none", **(serial or {})}
    whole = {"type": mode.listener, "serial": line, "rules": rules, **(listener or {})}
    return written(
        {
            "memories": memories or {"plant": everything},
            "listeners": {"line": whole},
            **more,
        }
    )


class Terminal:
    """A pseudo-terminal whose device has the path `device`. `end` is the other end of its cable."""

    def __init__(self, device: Path) -> None:
        self.device = device
        self.end, self._held = os.openpty()
        # The line is not configured yet: disable echo and line editing.
        tty.setraw(self._held)
        os.set_blocking(self.end, False)
        device.symlink_to(os.ttyname(self._held))

    def waiting(self) -> int:
        """Returns the number of bytes that the opener of the device has not read yet."""
        count: int = struct.unpack("i", fcntl.ioctl(self._held, termios.FIONREAD, b"\0" * 4))[0]
        return count

    def close(self) -> None:
        self.device.unlink()
        os.close(self.end)
        os.close(self._held)


class Line:
    """A serial line: a server opens `device`, the test is the client at its other end."""

    def __init__(self, device: Path, mode: Mode) -> None:
        self.device = device
        self.mode = mode
        self._received = b""
        self._terminal: Terminal | None = None
        self.plug()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._terminal is not None:
            self.unplug()

    def plug(self) -> None:
        """Creates the device."""
        self._terminal = Terminal(self.device)

    def unplug(self) -> None:
        """Removes the device."""
        self._plugged.close()
        self._terminal = None

    @property
    def _plugged(self) -> Terminal:
        assert self._terminal is not None
        return self._terminal

    def send(self, data: bytes) -> None:
        """Sends all bytes."""
        rest = self.send_until_full(data, wire.DEADLINE)
        assert not rest, "the line takes no more"

    def send_until_full(self, data: bytes, patience: float) -> bytes:
        """Sends until nothing is accepted for `seconds`. Returns the unsent bytes."""
        while data and select.select([], [self._plugged.end], [], patience)[1]:
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self._plugged.end, data) :]
        return data

    def send_pieces(self, *pieces: bytes) -> None:
        """Sends each piece after the previous one was read."""
        for piece in pieces:
            self.send(piece)
            wire.until(lambda: self._plugged.waiting() == 0, "the server has read the piece")

    def pause(self, seconds: float) -> None:
        """Waits so long, in which nothing may arrive: a silence that ends a frame."""
        assert not select.select([self._plugged.end], [], [], seconds)[0]

    def receive(self) -> tuple[int, bytes]:
        """Returns the unit id and PDU of the next frame."""
        deadline = time.monotonic() + wire.DEADLINE
        while (end := self.mode.length(self._received)) is None:
            patience = deadline - time.monotonic()
            assert patience > 0, f"no frame within {wire.DEADLINE} s: {self._received!r}"
            if select.select([self._plugged.end], [], [], patience)[0]:
                self._received += os.read(self._plugged.end, 65536)
        frame, self._received = self._received[:end], self._received[end:]
        return self.mode.unframe(frame)

    def ask(self, pdu: bytes, unit: int = UNIT) -> bytes:
        """Sends a request. Returns the PDU of the reply, which must be the first frame."""
        self.send(self.mode.frame(pdu, unit))
        answered, reply = self.receive()
        assert answered == unit
        return reply

    def is_quiet(self) -> bool:
        """Returns whether no unread bytes have arrived."""
        return not self._received and not select.select([self._plugged.end], [], [], 0)[0]


class Cable:
    """Two connected serial devices: what is written to one is read from the other."""

    def __init__(self, folder: Path) -> None:
        self._one, self._other = Terminal(folder / "one"), Terminal(folder / "other")
        self.devices = self._one.device, self._other.device
        self._ended, self._end = os.pipe()
        self._thread = threading.Thread(target=self._carry, name="cable")
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._end)
        self._thread.join()
        os.close(self._ended)
        self._one.close()
        self._other.close()

    def _carry(self) -> None:
        one, other = self._one.end, self._other.end
        while True:
            ready, _, _ = select.select([one, other, self._ended], [], [])
            if self._ended in ready:
                return
            for end in ready:
                os.write(other if end == one else one, os.read(end, 4096))
