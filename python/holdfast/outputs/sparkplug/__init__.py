"""Sparkplug B 3.0: an edge node whose devices are those that are polled."""

from __future__ import annotations

from holdfast.outputs.sparkplug.output import SparkplugOutput

__all__ = ["SparkplugOutput"]
