"""MQTT: JSON commands from topics of a broker. Each subscription has its own grant."""

from __future__ import annotations

from holdfast.adapters.mqtt.adapter import Mqtt

__all__ = ["Mqtt"]
