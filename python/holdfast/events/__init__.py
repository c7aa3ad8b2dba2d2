"""Log lines, security events, and the audit log."""

from __future__ import annotations

from typing import Literal, TypeAlias

Format: TypeAlias = Literal["text", "json", "ecs"]
"""The forms of log lines."""
