"""The messages of the scanner, and what programs of each dialect send and expect. Does no I/O."""

from __future__ import annotations

from holdfast.scanner.messages.decoding import decode_lenient
from holdfast.scanner.messages.dialects import DIALECTS
from holdfast.scanner.messages.leniency import Adjustments
from holdfast.scanner.messages.types import (
    Answer,
    BrowseRequest,
    FunctionCode,
    HeartbeatMetadata,
    ServiceReport,
    SubscribeRequest,
)

__all__ = [
    "DIALECTS",
    "Adjustments",
    "Answer",
    "BrowseRequest",
    "FunctionCode",
    "HeartbeatMetadata",
    "ServiceReport",
    "SubscribeRequest",
    "decode_lenient",
]
