"""The dialects by name: what the programs of each generation send and expect."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from holdfast.scanner.dialects.tentacle import Tentacle
from holdfast.scanner.dialects.tentacle_next import TentacleNext

if TYPE_CHECKING:
    from holdfast.config.values import scanner_settings

Dialect: TypeAlias = Tentacle | TentacleNext
"""The rules of one generation of programs. They do no I/O, and have no state."""

TENTACLE = Tentacle()

DIALECTS: dict[scanner_settings.Dialect, Dialect] = {
    "tentacle": TENTACLE,
    "tentacle-next": TentacleNext(),
}
