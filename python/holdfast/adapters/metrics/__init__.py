"""Exports the diagnostics as Prometheus metrics, and answers probes, see docs/metrics.md."""

from __future__ import annotations

from holdfast.adapters.metrics.app import Metrics

__all__ = ["Metrics"]
