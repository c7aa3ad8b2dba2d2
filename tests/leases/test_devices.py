"""What the leases of devices show of a holder."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance.parts.device_leases import _LogLeases
from holdfast.config import load
from holdfast.replication.leases.bucket import Entry, Holding
from support.config_folder import written
from support.nats_bus import logged

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def leases(tmp_path: Path) -> _LogLeases:
    file = tmp_path / "node.yaml"
    rules = [{"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-only"}]
    parts = {
        "memories": {"plant": {"holding_registers": 100, "replicate": {"log": "site"}}},
        "logs": {"site": {"servers": ["nats://127.0.0.1:4222"], "node": "a"}},
        "listeners": {"scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": rules}},
    }
    file.write_text(written(parts))
    return _LogLeases("site", load(file), None, lambda _: None)


@pytest.mark.parametrize(
    ("about", "is_known"),
    [
        ({}, True),
        ({"devices": None}, True),
        ({"devices": 5}, True),
        ({"devices": {"meter": 1}}, True),
        ({"devices": ["meter"]}, True),
        ({"devices": [None, 5]}, False),
    ],
)
def test_what_a_holder_says_of_its_devices_may_be_anything(
    leases: _LogLeases, about: dict[str, Any], caplog: pytest.LogCaptureFixture, *, is_known: bool
) -> None:
    leases.adopt({"key": ["meter"]})
    holding = Holding(node="b", process="b", about=about)
    leases.leases.seen["key"] = Entry(1, holding, time.monotonic())
    leases.changed()
    reason = None if is_known else "b has its address, and not this device"
    node = "b" if is_known else None
    assert leases.status() == {"meter": {"node": node, "polled_here": False, "reason": reason}}
    assert bool(logged(caplog, "device_not_polled")) != is_known


def test_a_device_whose_lease_nobody_takes_in_time_is_not_polled(leases: _LogLeases) -> None:
    leases.adopt({"key": ["meter"]})
    assert leases.unpolled() == {}, "it may be taken soon"
    long_ago = time.monotonic() - 2 * leases.leases.times.unheld_s
    leases._wanted_since["key"] = long_ago
    leases.adopt({"key": ["meter"]})
    reason = "leases can't be taken: not connected"
    assert leases.unpolled() == {"meter": reason}
    assert leases.status()["meter"] == {"node": None, "polled_here": False, "reason": reason}
    leases.leases.set_reason(None)
    assert leases.unpolled() == {"meter": "no node takes its lease"}
    leases.obstacle = lambda _: "it has failed"
    assert leases.unpolled() == {"meter": "the log is not usable here: it has failed"}
    leases.leases.seen["key"] = Entry(1, Holding(node="b", process="b"), time.monotonic())
    assert leases.unpolled() == {}, "another node holds it"
    leases.leases.seen["key"] = Entry(2, None, time.monotonic())
    assert leases.unpolled() == {}, "it was given back just now"
    leases.leases.seen["key"] = Entry(2, None, long_ago)
    assert list(leases.unpolled()) == ["meter"]
