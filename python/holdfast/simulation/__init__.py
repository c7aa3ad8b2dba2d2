"""A simulated device: live values for the tags of a list, and faults on request.

`device` has the device, `generators` what its values do, `faults` a front that delays, drops and
refuses requests.
"""

from __future__ import annotations

from pathlib import Path

HEATER = Path(__file__).parent / "heater.yaml"
"""The tag list of a small heater."""
