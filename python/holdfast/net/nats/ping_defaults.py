"""How often NATS servers are asked whether they are still there, if nothing is configured."""

from __future__ import annotations

PING_INTERVAL_S = 1.0
PINGS_OUTSTANDING = 3
"""A server that does not answer is found after 4 s."""
