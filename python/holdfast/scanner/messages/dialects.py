"""The dialects by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.scanner.messages.tentacle import Tentacle
from holdfast.scanner.messages.tentacle_next import TentacleNext

if TYPE_CHECKING:
    from holdfast.config import scanning
    from holdfast.scanner.messages.dialect import Dialect

TENTACLE = Tentacle()

DIALECTS: dict[scanning.Dialect, Dialect] = {each.name: each for each in (TENTACLE, TentacleNext())}
