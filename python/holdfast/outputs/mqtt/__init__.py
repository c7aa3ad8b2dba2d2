"""MQTT: the values of tags to topics of a broker, and commands from there."""

from __future__ import annotations

from holdfast.outputs.mqtt.output import MqttOutput

__all__ = ["MqttOutput"]
