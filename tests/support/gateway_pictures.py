"""Takes pictures for docs/gateway.md: `python -m support.gateway_pictures [NAME …]` in `tests`."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from playwright.sync_api import expect

from support import gateway_pages
from support.fake_device import HANG_UP, FakeDevice, exception, registers
from support.gateway_pages import DESK, PHONE, Opened, Pages, View, browsing, floats, opening
from support.paths import DOCS

if TYPE_CHECKING:
    from collections.abc import Callable

    Scheme: TypeAlias = Literal["light", "dark"]
    Scene: TypeAlias = Callable[[Opened, Scheme], View]

IMAGES = DOCS / "images"
MAX_BYTES = 140 * 1024
SCHEMES: tuple[Scheme, ...] = ("light", "dark")
LOW: Any = {"viewport": {"width": 1100, "height": 400}}

RANGES = {
    1: [range(64), range(512, 640)],
    2: [range(64), range(1024, 1500), range(4096, 4200)],
    3: [range(125), range(1000, 3200), range(4096, 4160), range(9000, 9512), range(40000, 40064)],
    4: [range(300), range(30000, 31000)],
}


def like_a_drive(pdu: bytes) -> bytes:
    """Answers as a device with many ranges; some addresses fail with other exceptions."""
    first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
    asked = range(first, first + count)
    if pdu[0] == 3 and first < 20100 and asked[-1] >= 20000:
        return exception(pdu, 4)
    if not any(first in each and asked[-1] in each for each in RANGES.get(pdu[0], [])):
        return exception(pdu, 2)
    if pdu[0] > 2:
        return registers(pdu)
    size = (count + 7) // 8
    return bytes([pdu[0], size, *[0] * size])


class Meter:
    """A device with changing registers, which can be switched off."""

    def __init__(self) -> None:
        self.is_off = False
        self._polls = 0

    def __call__(self, pdu: bytes) -> Any:
        self._polls += 1
        value = 500 + round(200 * math.sin(self._polls / 7))
        return HANG_UP if self.is_off else registers(pdu, value)


def connect(opened: Opened, scheme: Scheme) -> View:
    """A device that responds."""
    view = opened(DESK, scheme)
    view.connect()
    view.says("The device responded")
    return view


def read(opened: Opened, scheme: Scheme) -> View:
    """Registers, read once."""
    view = opened(DESK, scheme)
    view.connect()
    view.choose(type="float32", quantity="10")
    view.button("Read").click()
    view.says("Holding registers 0 to 9: read in")
    return view


def write(opened: Opened, scheme: Scheme) -> View:
    """The review of a register before a write, on a phone."""
    view = opened(PHONE, scheme)
    view.connect()
    view.choose(type="uint16", address="4", quantity="4")
    view.button("Read").click()
    view.button("Write 4").click()
    view.page.get_by_role("textbox", name="New value").fill("1237")
    view.button("Review").click()
    view.page.get_by_role("row", name="New 1237").wait_for()
    return view


def watch(opened: Opened, scheme: Scheme) -> View:
    """Changing registers, with plots."""
    view = opened(DESK, scheme)
    view.connect()
    view.choose(type="float32", quantity="6", interval="250")
    view.button("Watch").click()
    view.says("Watching holding registers")
    for step in range(40):
        opened.plant.write("holding_registers", 0, floats(21.5 + 1.4 * math.sin(step / 6)))
        opened.plant.write("holding_registers", 2, floats(1.013 + 0.02 * math.cos(step / 4)))
        opened.plant.write("holding_registers", 4, floats(40 + step / 8))
        expect(view.row(4).get_by_role("cell").nth(3)).to_have_text(f"{40 + step / 8:g}")
    return view


TAGS = """\
tags:
  flow: {area: holding_registers, address: 0, type: float32, unit: m³/h}
  pressure: {area: holding_registers, address: 2, type: float32, unit: bar}
  setpoint: {area: holding_registers, address: 4, scale: 0.1, unit: °C, writable: true}
  state: {area: holding_registers, address: 5, states: {0: off, 2: fault}}
"""


def view(opened: Opened, scheme: Scheme) -> View:
    """Coils and a tag list in one view, with a plot."""
    view = opened(DESK, scheme)
    view.connect()
    view.choose(area="1", quantity="20", interval="100")
    view.button("Add range to view").click()
    view.button("Add tag list…").click()
    view.page.get_by_role("textbox", name="YAML or CSV").fill(TAGS)
    view.button("Add").click()
    view.button("Watch").click()
    view.says("Watching 2 parts")
    view.button("Plot flow").click()
    for step in range(40):
        opened.plant.write("holding_registers", 0, floats(21.5 + 1.4 * math.sin(step / 6)))
        opened.plant.write("holding_registers", 4, [200 + step])
        shown = view.page.locator("tr[data-tag='setpoint'] .typed")
        expect(shown).to_have_text(f"{(200 + step) / 10:.1f}")
    return view


def gap(opened: Opened, scheme: Scheme) -> View:
    """A plot with the gap of an outage, and another outage."""
    meter = Meter()
    with FakeDevice(meter) as device:
        view = opened(DESK, scheme)
        view.connect(port=device.port)
        view.choose(type="uint16", quantity="2", interval="100")
        view.button("Watch").click()
        for is_off in (False, True, False, True):
            meter.is_off = is_off
            view.says("Retrying…" if is_off else "Watching holding registers")
            view.page.wait_for_timeout(3000)
        return view


def mapped(opened: Opened, scheme: Scheme) -> View:
    """The ranges of a device."""
    with FakeDevice(like_a_drive) as drive:
        view = opened(DESK, scheme)
        view.connect(port=drive.port)
        view.page.get_by_role("tab", name="Map").click()
        view.button("Map device").click()
        view.says("Done in")
        return view


def dead(opened: Opened, scheme: Scheme) -> View:
    """A device that does not respond."""
    with FakeDevice(lambda _: None) as mute:
        view = opened(LOW, scheme)
        view.page.get_by_role("spinbutton", name="Timeout").fill("200")
        view.connect(port=mute.port)
        view.says("The device did not respond in time.")
        return view


def refused(opened: Opened, scheme: Scheme) -> View:
    """A device that the gateway does not allow."""
    view = opened(LOW, scheme, allow=["10.0.0.0/8"])
    view.connect(host="192.168.7.20", port=502)
    view.says("The gateway does not allow this target.")
    return view


SCENES: dict[str, Scene] = {
    "connect": connect,
    "read": read,
    "write": write,
    "watch": watch,
    "view": view,
    "gap": gap,
    "map": mapped,
    "dead": dead,
    "refused": refused,
}


def main() -> None:
    """Takes the named pictures, or all."""
    with browsing() as browser:
        pages = Pages(browser)
        for name in sys.argv[1:] or SCENES:
            for scheme in SCHEMES:
                with opening(pages, gateway_pages.plant(), model="Feeder 7") as opened:
                    view = SCENES[name](opened, scheme)
                    file = IMAGES / f"gateway-{name}-{scheme}.png"
                    view.page.screenshot(
                        path=file, full_page=name in ("read", "watch", "view", "gap", "map")
                    )
                print(f"{file.name}: {file.stat().st_size} bytes")
                if file.stat().st_size > MAX_BYTES:
                    sys.exit(f"more than {MAX_BYTES}")


if __name__ == "__main__":
    main()
