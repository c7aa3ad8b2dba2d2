"""From polls to messages for NATS."""

from __future__ import annotations

from holdfast.scanner.publish.publisher import Publisher

__all__ = ["Publisher"]
