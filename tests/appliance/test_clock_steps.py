"""Steps of the wall clock: in the log and in the audit log."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from holdfast.runtime.standstill import WallClock
from support import wire
from support.audits import lines
from support.config_folder import written

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run

RULE = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}
CONFIGURATION = written(
    {
        "memories": {"plant": {"coils": 8}},
        "listeners": {"scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": [RULE]}},
        "audit": {"file": "audit.log"},
    }
)


@pytest.mark.parametrize("step", [-3600.0, 5.0])
def test_a_step_of_the_wall_clock_is_logged_and_recorded(
    step: float,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0.0)
    appliance = run(CONFIGURATION)
    appliance.log_events(0)
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + step)

    def told(appliance: Appliance) -> list[float]:
        appliance.log_events(0)
        return [
            record.fields["step"]  # type: ignore[attr-defined]
            for record in caplog.records
            if record.message == "clock_stepped"
        ]

    wire.until(lambda: told(appliance), "the step is logged")
    assert told(appliance) == [pytest.approx(step, abs=1)]
    appliance.stop()
    [line] = [
        line for line in lines(tmp_path / "audit.log") if line.get("event") == "clock_stepped"
    ]
    assert line["step"] == pytest.approx(step, abs=1)


def test_a_process_that_stood_still_between_two_clocks_is_not_a_step(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = WallClock()
    steady = iter([0.0, 60.0])
    with monkeypatch.context() as patched:
        patched.setattr("holdfast.runtime.standstill.now", lambda: next(steady))
        assert clock.look() is None
    assert clock.look() is None
    assert "clock_stepped" not in caplog.messages
