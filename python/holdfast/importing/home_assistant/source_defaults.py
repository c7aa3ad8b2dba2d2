"""What Home Assistant uses for keys that its configuration does not have."""

from __future__ import annotations

TIMEOUT_S = 3
SCAN_INTERVAL_S = 15
SERIAL_WAIT_MS = 30
"""The pause between two requests on a serial line."""
UNIT = 1
"""Of newer versions; older ones asked unit 0."""
