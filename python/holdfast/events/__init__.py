"""Log lines, security events, and the audit log."""

from __future__ import annotations

from typing import Literal, TypeAlias

Level: TypeAlias = Literal["debug", "info", "warning", "error"]
"""The lowest level that is logged."""

Format: TypeAlias = Literal["text", "json", "ecs"]
"""The forms of log lines."""

LEVEL: Level = "info"
FORMAT: Format = "text"
"""What is logged, and how, where nothing else is configured."""
