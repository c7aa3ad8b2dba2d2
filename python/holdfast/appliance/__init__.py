"""From a configuration to something that runs: assembly, supervision, diagnostics."""

from __future__ import annotations

from holdfast.appliance.running import Appliance

__all__ = ["Appliance"]
