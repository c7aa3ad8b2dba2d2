"""Error codes of JetStream."""

from __future__ import annotations

NO_MESSAGE = 10037
"""No message matches."""

STREAM_EXISTS = 10058
"""The stream exists with other settings."""

STREAM_NOT_FOUND = 10059
"""The stream does not exist."""

WRONG_SEQUENCE = (10071, 10164)
"""The key has another revision than expected."""

NOT_CLUSTERED = 10074
"""The server is alone, and has no room for replicas."""
