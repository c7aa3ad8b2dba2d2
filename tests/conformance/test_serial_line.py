"""Requirements of Modbus over Serial Line that no test of a part shows."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import NetworkTarget, parse
from holdfast.config import ConfigError, load
from holdfast.config.models.listeners import AsciiSerialConfig, RtuSerialConfig
from support.fake_device import Serial
from support.lines import RTU, Line, configuration

if TYPE_CHECKING:
    from pathlib import Path

    from support.running import Run

TCGETS2 = 0x802C542A
TERMIOS2 = struct.Struct("=IIII20sII")


def test_the_defaults_of_a_line_are_those_of_the_standard() -> None:
    some = {"device": "/dev/ttyX"}
    rtu, ascii_mode = RtuSerialConfig.model_validate(some), AsciiSerialConfig.model_validate(some)
    targets = parse("rtu:///dev/ttyX"), parse("ascii:///dev/ttyX")

    for line in (rtu, ascii_mode, *targets):
        assert not isinstance(line, NetworkTarget)
        assert (line.baud, line.parity, line.stop_bits) == (19200, "even", 1)
    assert ascii_mode.data_bits == 7
    assert [target.data_bits for target in targets if isinstance(target, SerialTarget)] == [8, 7]


@pytest.mark.parametrize("unit", [248, 255])
def test_a_listener_of_a_line_has_no_unit_above_247(unit: int, tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text(configuration(RTU, tmp_path / "line", units={unit: "plant"}))

    with pytest.raises(ConfigError, match=rf"units.*{unit}.*1 to 247"):
        load(file)


@pytest.mark.parametrize("baud", [9600, 19200, 115200])
@pytest.mark.parametrize("stop_bits", [1, 2])
def test_a_line_is_opened_with_its_baud_rate_and_stop_bits(
    baud: int, stop_bits: int, tmp_path: Path, run: Run
) -> None:
    wanted = (baud, stop_bits == 2)
    with Line(tmp_path / "line", RTU) as line:
        serial = {"baud": baud, "stop_bits": stop_bits}
        run(configuration(RTU, line.device, serial=serial))
        assert settings(line.device) == wanted
    device = tmp_path / "other"
    with (
        Serial(RTU, device, baud=baud, stop_bits=stop_bits) as served,
        holdfast.SyncClient(served.url) as client,
    ):
        client.read_holding_registers(0, 1)
        assert settings(device) == wanted


def settings(device: Path) -> tuple[int, bool]:
    """The baud rate of a device, and whether it has two stop bits."""
    line = os.open(device, os.O_RDWR | os.O_NOCTTY)
    try:
        # struct termios2: what `termios` reads has no rates but those with a name.
        found = fcntl.ioctl(line, TCGETS2, bytes(TERMIOS2.size))
    finally:
        os.close(line)
    _, _, cflag, _, _, _, speed = TERMIOS2.unpack(found)
    return speed, bool(cflag & termios.CSTOPB)
