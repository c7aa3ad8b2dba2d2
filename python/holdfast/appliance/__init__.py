"""The appliance runs a configuration: assembly, supervision and diagnostics."""

from __future__ import annotations

from holdfast.appliance.running import Appliance

__all__ = ["Appliance"]
