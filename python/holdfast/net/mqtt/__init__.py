"""What all connections to MQTT brokers have in common: opening them, waiting, parsing messages."""

from __future__ import annotations

MAX_TEXT = 65535
"""The bytes of the longest text of MQTT, which has its length in 16 bits."""
