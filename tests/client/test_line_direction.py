"""RS-485 lines whose direction the driver switches. A pseudo-terminal has no such driver."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import holdfast
from support.lines import RTU, Line, configuration

if TYPE_CHECKING:
    from pathlib import Path

    from support.running import Run

REFUSED = "the driver can't switch an RS-485 line by RTS"


@pytest.mark.parametrize("direction", ["rts", "rts-low"])
def test_a_client_says_that_the_driver_can_not_switch(tmp_path: Path, direction: str) -> None:
    with Line(tmp_path / "line", RTU) as line:
        url = f"rtu://{line.device}?parity=none&rs485={direction}"
        with (
            holdfast.SyncClient(url) as client,
            pytest.raises(holdfast.ConnectFailed, match=REFUSED),
        ):
            client.read_coils(0, 1)


def test_a_listener_says_so_too(tmp_path: Path, run: Run) -> None:
    with Line(tmp_path / "line", RTU) as line:
        text = configuration(RTU, line.device, serial={"rs485": "rts"})
        with pytest.raises(OSError, match=REFUSED):
            run(text)


def test_other_directions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"rs485 is 'dtr', allowed: rts, rts-low"):
        holdfast.SyncClient("rtu:///dev/ttyS0?rs485=dtr")
