"""A serial line: its device, and the settings of its characters, with their defaults."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

from holdfast.client.tolerance import STRICT, Tolerance

Mode: TypeAlias = Literal["rtu", "ascii"]
Parity: TypeAlias = Literal["none", "even", "odd"]
Rs485: TypeAlias = Literal["rts", "rts-low"]


@dataclass(frozen=True)
class SerialTarget:
    """A serial line."""

    mode: Mode
    device: str
    baud: int = 19200
    parity: Parity = "even"
    stop_bits: int = 1
    data_bits: int = 8
    silence: float | None = None
    """Seconds that end an RTU frame; `None` for 3.5 characters."""
    tolerance: Tolerance = STRICT
    rs485: Rs485 | None = None
    """How the driver switches the direction of an RS-485 line; `None` if the adapter does."""

    def __str__(self) -> str:
        return f"{self.mode}://{self.device}"

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the line, as the native core has them."""
        known = asdict(self)
        return {key: known[key] for key in known if key not in ("device", "tolerance")}


def stop_bits(parity: Parity) -> Literal[1, 2]:
    """The usual stop bits: characters with and without a parity bit have the same length."""
    return 2 if parity == "none" else 1
