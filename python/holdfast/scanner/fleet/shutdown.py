"""Which nodes of a fleet a shutdown message ends."""

from __future__ import annotations

import msgspec

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.messages.types import ShutdownRequest


def ends(payload: bytes, node: str) -> bool:
    """Whether a message ends this node: one for all nodes, or for it. A malformed one ends none."""
    if payload.strip() in (b"", b"{}"):
        return True
    try:
        return msgspec.json.decode(payload, type=ShutdownRequest).node == node
    except MALFORMED_JSON as error:
        log_lines.refused(
            "message_malformed", kind="shutdown", reason=malformed_text(error, payload)
        )
        return False
