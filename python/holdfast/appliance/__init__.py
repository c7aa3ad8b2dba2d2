"""The appliance runs a configuration: its parts, its services, and diagnostics of both.

`parts` has the parts that it starts, reloads and stops, `services` the supervised adapters, which
are one of the parts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast.appliance.appliance import Appliance
else:
    __getattr__ = imported_on_use(__name__, {"Appliance": "holdfast.appliance.appliance"})

__all__ = ["Appliance"]
