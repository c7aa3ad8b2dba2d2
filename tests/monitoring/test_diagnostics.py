"""The counters that metrics are made of."""

from __future__ import annotations

from typing import Any

from holdfast.appliance.diagnostics import Diagnostics
from holdfast.appliance.liveness import Liveness


class Removed(dict[str, Any]):
    """Adapters that a reload removes after their names were read."""

    def get(self, *_: object) -> Any:
        return None


def test_an_adapter_that_is_removed_meanwhile_is_left_out() -> None:
    adapters = Removed(mqtt=None)
    diagnostics = Diagnostics({}, Liveness(list), [], adapters, list)
    assert diagnostics.stats()["adapters"] == {}
