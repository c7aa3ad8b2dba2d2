"""MQTT: JSON commands from the topics of a broker, each subscription with a grant of its own."""

from __future__ import annotations

from holdfast.adapters.mqtt.adapter import Mqtt

__all__ = ["Mqtt"]
