"""The gateway's console as people use it, in a real browser, on a desk and on a phone."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import threading
from typing import TYPE_CHECKING, Any, Literal

import pytest
from playwright.sync_api import expect

from holdfast.client.url import Tls
from holdfast.tags import Tag, TagList
from support import gateway_pages, wire
from support.fake_device import HANG_UP, FakeDevice, exception, registers
from support.gateway_pages import DESK, PHONE, Opened, Pages, View, floats, opening
from support.gateways import Dialed, Names
from support.secured import Authority, Relay, context
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from playwright.sync_api import Locator, Route

    import holdfast

HARMFUL = "<img src=x onerror=alert(1)>"
SECRET = "correct-horse-battery-staple"


@pytest.fixture
def plant() -> holdfast.Memory:
    return gateway_pages.plant()


@pytest.fixture
def opened(pages: Pages, plant: holdfast.Memory) -> Iterator[Opened]:
    with opening(pages, plant, model=HARMFUL) as opened:
        yield opened


both = pytest.mark.parametrize(
    ("size", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk-light", "phone-dark"]
)


@both
def test_a_device_is_connected_to_and_read(
    opened: Opened, size: Any, scheme: Literal["light", "dark"]
) -> None:
    view = opened(size, scheme)
    view.connect()
    view.says("The device responded")
    view.says("Acme")
    view.says(HARMFUL)
    view.choose(type="float32", quantity="8")
    view.button("Read").click()
    view.says("Holding registers 0 to 7: read in")
    cells = [
        [text.strip() for text in view.row(address).get_by_role("cell").all_inner_texts()[:4]]
        for address in (0, 1, 4)
    ]
    assert cells[0] == ["16812", "41AC", "0100 0001 1010 1100", "21.5"]
    assert cells[1][:3] == ["0", "0000", "0000 0000 0000 0000"]
    assert cells[2][:2] == ["1234", "04D2"]


@pytest.mark.parametrize("host", ["::1", "[::1]"])
def test_an_ipv6_address_has_brackets_before_the_port(opened: Opened, host: str) -> None:
    dialed = Dialed({("::1", 502): ("127.0.0.1", opened.port)})
    view = opened(allow=["[::1]/128:502"], dialed=dialed)
    view.connect(host, 502)
    view.read_four(0)
    view.says("Values of [::1]:502, unit 1")
    view.button("Write 0").click()
    view.says("40001 of unit 1 at [::1]:502")


def test_every_type_of_a_register_is_shown(opened: Opened) -> None:
    view = opened(PHONE)
    view.connect()
    view.button("Read").click()
    view.button("All types from 0").click()
    dialog = view.page.get_by_role("dialog")
    expect(dialog.get_by_role("row", name="float32 21.5")).to_be_visible()
    expect(dialog.get_by_role("row", name="uint16 16812 16812")).to_be_visible()
    view.button("Close").click()
    expect(dialog).to_be_hidden()


def review(view: View, button: str | None, text: str) -> Locator:
    """Types a value into the write dialog, which the button opens, and reviews it."""
    if button is not None:
        view.button(button).click()
    view.page.locator("#write-value").fill(text)
    view.button("Review").click()
    expect(view.button("Write it")).to_be_visible()
    return view.page.get_by_role("dialog")


@both
def test_a_register_is_written_after_old_and_new_were_seen(
    opened: Opened, plant: holdfast.Memory, size: Any, scheme: Literal["light", "dark"]
) -> None:
    view = opened(size, scheme)
    view.connect()
    view.choose(type="uint16")
    view.button("Read").click()
    view.button("Write 4").click()
    dialog = view.page.get_by_role("dialog")
    view.page.get_by_role("textbox", name="New value").fill("0x04D5")
    view.page.keyboard.press("Enter")
    expect(dialog.get_by_role("row", name="Now 1234 04D2 0000 0100 1101 0010")).to_be_visible()
    expect(dialog.get_by_role("row", name="New 1237 04D5 0000 0100 1101 0101")).to_be_visible()
    assert dialog.evaluate("(each) => each.scrollWidth <= each.clientWidth")
    assert "" not in dialog.get_by_role("columnheader").all_text_contents()
    assert plant.read("holding_registers", 4, 1) == [1234], "not before it is confirmed"
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 4, 1) == [1237]
    expect(view.row(4).get_by_role("cell").first).to_have_text("1237")


def test_typed_values_are_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(type="float32", order="CDAB")
    view.button("Read").click()
    view.button("Write 8").click()
    view.page.get_by_role("textbox", name="New value").fill("21.5, -1")
    view.button("Review").click()
    expect(view.page.get_by_role("row", name="10 0 -1")).to_be_visible()
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 8, 4) == [0, 0x41AC, 0, 0xBF80]


def test_a_coil_is_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(area="1", quantity="20")
    view.button("Read").click()
    view.button("Coil 1: 0, off").click()
    view.page.get_by_role("textbox", name="New value").fill("on")
    view.button("Review").click()
    expect(view.page.get_by_role("row", name="1 off on")).to_be_visible()
    view.button("Write it").click()
    expect(view.button("Coil 1: 1, on")).to_be_visible()
    assert plant.read("coils", 0, 3) == [1, 1, 1]


def test_a_newcomer_writes_one_register(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    expect(view.page.get_by_role("combobox", name="Type")).to_have_value("uint16")
    view.button("Read").click()
    view.says("Holding registers 0 to 9: read in")
    dialog = review(view, "Write 4", "222")
    expect(dialog.get_by_text("Writes 1 register: 4.")).to_be_visible()
    expect(dialog.get_by_role("row", name="4 1234 0x04D2 222 0x00DE")).to_be_visible()
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 4, 2) == [222, 0]


def test_a_chosen_type_stays_chosen(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(type="float32")
    view.page.reload()
    expect(view.page.locator("#type")).to_have_value("float32")
    view.connect()
    view.button("Read").click()
    view.says("Holding registers 0 to 9: read in")
    view.button("Write 0").click()
    expect(view.page.get_by_role("combobox", name="Written as")).to_have_value("typed")
    expect(view.page.locator("#write-as option").last).to_have_text("float32")


def test_a_review_lists_each_register_of_typed_values(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(type="float32")
    view.button("Read").click()
    dialog = review(view, "Write 0", "222; 0.1")
    expect(dialog.get_by_text("Writes 4 registers: 0-3.")).to_be_visible()
    values = dialog.get_by_role("table", name="float32, byte order ABCD")
    expect(values.get_by_role("row")).to_have_count(3)
    expect(values.get_by_role("row", name="0 21.5 222")).to_be_visible()
    expect(values.get_by_role("row", name="2 1.013 0.1")).to_be_visible()
    words = dialog.get_by_role("table", name="Registers").get_by_role("row")
    assert [" ".join(text.split()) for text in words.all_inner_texts()] == [
        "Register Now New",
        "0 16812 0x41AC 17246 0x435E",
        "1 0 0x0000 0 0x0000",
        "2 16257 0x3F81 15820 0x3DCC",
        "3 43516 0xA9FC 52429 0xCCCD",
    ]
    # The value as the device then has it, which differs from what was typed.
    view.button("Back").click()
    review(view, None, "16777217")
    expect(values.get_by_role("row", name="0 21.5 16777216")).to_be_visible()


def test_a_review_lists_each_coil(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(area="1", quantity="20")
    view.button("Read").click()
    dialog = review(view, "Coil 1: 0, off", "1; 0; 0")
    expect(dialog.get_by_text("Writes 3 coils: 1-3.")).to_be_visible()
    rows = dialog.get_by_role("table", name="Coils").get_by_role("row")
    texts = [text.split() for text in rows.all_inner_texts()[1:]]
    assert texts == [["1", "off", "on"], ["2", "on", "off"], ["3", "off", "off"]]
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("coils", 0, 4) == [1, 1, 0, 0]


def test_a_review_of_a_bit_lists_its_register(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(type="bit", size="3")
    view.button("Read").click()
    dialog = review(view, "Write 4", "on")
    expect(dialog.get_by_text("Writes 1 register: 4. Only bit 3 is written.")).to_be_visible()
    expect(dialog.get_by_role("row", name="4 false true")).to_be_visible()
    expect(dialog.get_by_role("row", name="4 1234 0x04D2 1242 0x04DA")).to_be_visible()
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 4, 1) == [1242]


def test_a_review_of_many_registers_lists_them_all(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened(PHONE)
    view.connect()
    view.button("Read").click()
    values = list(range(500, 623))
    view.button("Write 0").click()
    box = view.page.get_by_role("textbox", name="New value")
    box.fill(";".join(map(str, [*values, 1])))
    view.button("Review").click()
    view.says("too many values: 124 registers, at most 123 in one write")
    dialog = review(view, None, ";".join(map(str, values)))
    expect(dialog.get_by_text("Writes 123 registers: 0-122.")).to_be_visible()
    expect(dialog.get_by_role("row")).to_have_count(124)
    expect(view.button("Write it")).to_be_in_viewport(ratio=1)
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 0, 123) == values


def test_a_review_can_be_read_at_320_pixels_and_by_screen_readers(opened: Opened) -> None:
    view = opened({"viewport": {"width": 320, "height": 640}, "has_touch": True})
    view.connect()
    view.choose(type="float32")
    view.button("Read").click()
    dialog = review(view, "Write 0", "222")
    expect(view.button("Write it")).to_be_focused()
    expect(view.button("Write it")).to_be_in_viewport(ratio=1)
    expect(view.button("Write it")).to_have_accessible_description(
        re.compile("Writes 2 registers: 0-1. The current values were read at")
    )
    assert dialog.evaluate("(each) => each.scrollWidth <= each.clientWidth")
    tables = dialog.get_by_role("region", name="What is written")
    assert tables.evaluate("(each) => each.scrollWidth <= each.clientWidth")
    assert view.page.evaluate(UNNAMED) == []
    view.page.keyboard.press("Shift+Tab")
    expect(view.button("Back")).to_be_focused()
    view.page.keyboard.press("Shift+Tab")
    expect(tables).to_be_focused()


@pytest.mark.parametrize(
    ("kind", "text", "allowed"),
    [
        ("uint16", "65536", "0 to 65535"),
        ("uint16", "-5", "0 to 65535"),
        ("int16", "40000", "−32768 to 32767"),
        ("uint32", "-1", "0 to 4294967295"),
        ("bcd16", "10000", "0 to 9999"),
        ("float32", "4e38", "−3.40282e+38 to 3.40282e+38"),
    ],
)
def test_a_value_outside_the_chosen_type_is_refused_with_its_range(
    opened: Opened, plant: holdfast.Memory, kind: str, text: str, allowed: str
) -> None:
    view = opened()
    view.connect()
    view.choose(type=kind)
    view.button("Read").click()
    view.button("Write 4").click()
    view.page.get_by_role("textbox", name="New value").fill(text)
    view.button("Review").click()
    expect(view.page.get_by_role("alert").filter(has_text=f": {allowed}")).to_be_visible()
    expect(view.button("Write it")).to_be_hidden()
    assert plant.read("holding_registers", 4, 2) == [1234, 0]


def test_a_value_that_is_none_is_not_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(type="uint16")
    view.button("Read").click()
    view.button("Write 4").click()
    for text, says in (("70000", "is not a register value"), ("1, x", "is not a register value")):
        view.page.get_by_role("textbox", name="New value").fill(text)
        view.button("Review").click()
        expect(view.page.get_by_role("alert").filter(has_text=says)).to_be_visible()
    view.page.get_by_role("textbox", name="New value").fill("5")
    view.button("Review").click()
    view.button("Back").click()
    view.page.keyboard.press("Escape")
    expect(view.page.get_by_role("dialog")).to_be_hidden()
    assert plant.read("holding_registers", 4, 1) == [1234]


@both
def test_what_changes_is_marked_and_plotted(
    opened: Opened, plant: holdfast.Memory, size: Any, scheme: Literal["light", "dark"]
) -> None:
    view = opened(size, scheme)
    view.connect()
    view.choose(type="float32", quantity="4", interval="50")
    view.button("Watch").click()
    view.says("Watching holding registers 0 to 3")
    plot = view.page.get_by_role("article").filter(has=view.page.get_by_role("heading", name="0"))
    for value in (22.25, 23.0, 22.75):
        plant.write("holding_registers", 0, floats(value))
        cell = view.row(0).get_by_role("cell").nth(3)
        expect(cell).to_have_text(f"{value:g}")
        expect(plot.get_by_role("status")).to_have_text(f"{value:g}")
    expect(view.row(0).locator(".changed").first).to_be_visible()
    expect(plot.locator("canvas")).to_be_visible()
    view.button("Stop").click()
    view.says("Stopped.")
    expect(view.button("Watch")).to_have_attribute("aria-pressed", "false")


def test_a_plot_is_chosen_and_removed(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(quantity="8", interval="50")
    view.button("Read").click()
    view.button("Plot 4").click()
    expect(view.button("Remove the plot of 4")).to_be_visible()
    view.page.get_by_role("spinbutton", name="Plot address").fill("6")
    view.button("Add plot").click()
    view.button("Remove the plot of 6").click()
    expect(view.button("Remove the plot of 6")).to_be_hidden()
    expect(view.button("Remove the plot of 4")).to_be_visible()
    view.button("Stop").click()
    view.read_four(100)
    view.button("Plot 102").click()
    expect(view.button("Remove the plot of 102")).to_be_visible()


def test_a_chosen_plot_replaces_those_of_values_that_have_changed_since_they_were_read(
    opened: Opened, plant: holdfast.Memory
) -> None:
    view = opened()
    view.connect()
    view.choose(type="uint16", quantity="8", interval="50")
    view.button("Read").click()
    view.says("Holding registers 0 to 7: read in")
    plant.write("holding_registers", 4, [4711, 4712])
    for _ in "read", "watched before":
        view.button("Plot 4").click()
        view.says("Watching holding registers 0 to 7")
        plots = view.page.get_by_role("article").get_by_role("heading")
        expect(plots).to_have_text(["4"])
        view.button("Stop").click()
        view.says("Stopped.")
        plant.write("holding_registers", 4, [4713, 4714])


@both
def test_a_map_is_a_picture_whose_ranges_can_be_read(
    opened: Opened, size: Any, scheme: Literal["light", "dark"]
) -> None:
    view = opened(size, scheme)
    view.connect()
    view.page.get_by_role("tab", name="Map").click()
    view.button("Map device").click()
    view.says("Done in")
    for name in (
        "Coils: 48 addresses in 1 ranges",
        "Discrete inputs: 20 addresses in 1 ranges",
        "Holding registers: 300 addresses in 1 ranges",
        "Input registers: 64 addresses in 1 ranges",
    ):
        expect(view.page.get_by_role("img", name=name)).to_be_visible()
    view.button("Read input registers 1000–1063").click()
    view.says("Input registers 1000 to 1063: read in")
    expect(view.page.get_by_role("tab", name="Values")).to_have_attribute("aria-selected", "true")


def test_a_dead_device_is_told_in_plain_words(opened: Opened) -> None:
    view = opened(resolve=Names())
    timeout = view.page.get_by_role("spinbutton", name="Timeout")
    with FakeDevice(lambda _: None) as mute:
        timeout.fill("50")
        view.connect(port=mute.port)
        view.says("The device did not respond in time.")
        view.says("Is the unit id right?")
        port = mute.port
    timeout.fill("5000")
    view.connect(port=port)
    view.says("The connection was refused or failed.")
    view.connect(host="no-such-name.invalid")
    view.says("The name can't be resolved.")


@both
def test_a_device_with_tls_is_connected_to_and_read(
    opened: Opened, tmp_path: Path, size: Any, scheme: Literal["light", "dark"]
) -> None:
    authority = Authority(tmp_path)
    owner = authority.issue("drive", "DNS:drive-7")
    with Relay(("127.0.0.1", opened.port), context(owner)) as relay:
        view = opened(size, scheme, tls=Tls(ca=str(authority.ca)))
        transport = view.page.get_by_role("combobox", name="Transport")
        port = view.page.get_by_role("spinbutton", name="Port")
        name = view.page.get_by_role("textbox", name="Name in certificate")
        expect(name).to_be_hidden()
        transport.select_option("tls")
        expect(port).to_have_value("802")
        transport.select_option("udp")
        expect(port).to_have_value("502")
        port.fill("1502")
        transport.select_option("tls")
        expect(port).to_have_value("1502")
        view.connect(port=relay.address[1])
        view.says("The TLS handshake failed.")
        view.says("the certificate is for 'drive-7', not for '127.0.0.1'")
        view.check()
        name.fill("drive-7")
        view.button("Connect").click()
        view.says("The device responded")
        view.choose(quantity="4", interval="50")
        view.button("Watch").click()
        view.says("Watching holding registers")
        view.page.reload()
        expect(name).to_have_value("drive-7")
        view.button("Connect").click()
        view.says("The device responded")
        transport.select_option("tcp")
        expect(name).to_be_hidden()
        view.connect(port=opened.port)
        view.says("The device responded")
        assert "drive-7" not in view.page.url


def test_a_refused_target_is_told_in_plain_words(opened: Opened) -> None:
    view = opened(allow=["10.0.0.0/8"])
    view.connect()
    view.says("The gateway does not allow this target.")
    view.says("--allow")


def test_an_address_that_is_not_there_is_told_in_plain_words(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(address="5000")
    view.button("Read").click()
    view.says("The device does not have this address.")
    view.says("this page counts from 0")


def test_a_gateway_that_only_reads_offers_no_writing(opened: Opened) -> None:
    view = opened(writes=False)
    view.says("reads only")
    view.connect()
    view.button("Read").click()
    view.says("Writes are disabled")
    expect(view.button("Plot 0")).to_be_visible()
    expect(view.button("Write 0")).to_have_count(0)


@pytest.mark.parametrize("noticed", ["by a write", "by a watch", "by a connect"])
def test_the_right_to_write_is_that_after_a_reload(opened: Opened, noticed: str) -> None:
    def status(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "writes": False})

    def refuse(route: Route) -> None:
        said = {"success": False, "error": "writes are disabled"}
        route.fulfill(status=403, headers={"Holdfast-Reason": "writes_off"}, json=said)

    view = opened()
    view.connect()
    view.says("The device responded")
    view.button("Read").click()
    expect(view.button("Write 0")).to_be_visible()
    view.page.route("**/api/gateway", status)
    view.page.route("**/write/register", refuse)
    if noticed == "by a write":
        view.button("Write 0").click()
        view.page.get_by_role("textbox", name="New value").fill("7")
        view.button("Review").click()
        view.button("Write it").click()
        view.says("Not written.")
        view.button("Cancel").click()
    elif noticed == "by a watch":
        part = {"kind": "range", "values": [0] * 10, "texts": ["0"] * 10, "errors": {}}
        body = json.dumps({"time": 0, "rtt": 0, "stream": True, "parts": [part]})
        ended = {"content_type": "text/event-stream", "body": f"event: view\ndata: {body}\n\n"}
        view.page.route("**/watch/view", lambda route: route.fulfill(**ended), times=1)
        view.button("Watch").click()
        view.says("Watching holding registers 0 to 9")
    else:
        view.button("Connect").click()
        view.says("The device responded")
        view.button("Read").click()
    view.says("reads only")
    expect(view.button("Plot 0")).to_be_visible()
    expect(view.button("Write 0")).to_have_count(0)


@pytest.mark.parametrize("noticed", ["by a write", "by a watch"])
def test_a_change_of_rights_keeps_plots_and_values(
    opened: Opened, plant: holdfast.Memory, noticed: str
) -> None:
    def status(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "writes": False})

    plant.write("holding_registers", 4, [4711])
    view = opened()
    view.connect()
    view.says("The device responded")
    view.choose(address="4", quantity="1", type="uint16", interval="50")
    view.button("Add range to view").click()
    view.choose(area="1", address="0", quantity="1")
    view.button("Add range to view").click()
    view.button("Read").click()
    expect(view.page.get_by_title("Write coils 0")).to_be_visible()
    if noticed == "by a watch":
        register = {"kind": "range", "values": [4711], "texts": ["4711"], "errors": {}}
        coil = {"kind": "range", "values": [True], "texts": ["true"], "errors": {}}
        body = json.dumps({"time": 0, "rtt": 0, "stream": True, "parts": [register, coil]})
        ended = {"content_type": "text/event-stream", "body": f"event: view\ndata: {body}\n\n"}
        view.page.route("**/api/gateway", status)
        view.page.route("**/watch/view", lambda route: route.fulfill(**ended), times=1)
    view.button("Plot 4").click()
    expect(view.button("Remove the plot of hr 4")).to_be_visible()
    if noticed == "by a write":
        said = {"success": False, "error": "writes are disabled"}
        refused = {"status": 403, "headers": {"Holdfast-Reason": "writes_off"}, "json": said}
        view.page.route("**/api/gateway", status)
        view.page.route("**/write/register", lambda route: route.fulfill(**refused))
        review(view, "Write 4", "7")
        view.button("Write it").click()
        view.says("Not written.")
        view.button("Cancel").click()
    view.says("reads only")
    expect(view.button("Write 4")).to_have_count(0)
    view.says("Writes are disabled. Enable")
    plant.write("holding_registers", 4, [1234])
    plot = view.page.get_by_role("article").filter(has_text="hr 4")
    expect(plot.get_by_role("status")).to_have_text("1234")
    with view.page.expect_download() as found:
        view.button("Download plots as CSV").click()
    text = found.value.path().read_text()
    assert "hr 4,4711" in text
    assert "hr 4,1234" in text
    expect(view.page.get_by_title("Plot coils 0")).to_be_visible()
    view.button("Coil 0: 1, on").click()
    expect(view.page.get_by_role("dialog")).to_be_hidden()


def test_a_token_is_asked_for_and_kept_in_the_tab_only(opened: Opened) -> None:
    view = opened(tokens=(("edge", hashlib.sha256(SECRET.encode()).digest()),))
    box = view.page.get_by_label("Token", exact=True)
    box.fill("wrong")
    view.page.keyboard.press("Enter")
    view.says("Unknown token.")
    box.fill(SECRET)
    view.page.keyboard.press("Enter")
    view.says("reads and writes")
    view.connect()
    view.says("The device responded")
    view.choose(interval="50")
    view.button("Watch").click()
    view.says("Watching holding registers")
    kept = "Object.values({0}).includes('{1}')"
    assert view.page.evaluate(kept.format("sessionStorage", SECRET))
    assert view.page.evaluate("localStorage.length + document.cookie.length") == 0
    assert [url for url in view.requests if SECRET in url] == []
    view.button("Forget token").click()
    expect(box).to_be_visible()
    assert not view.page.evaluate(kept.format("sessionStorage", SECRET))


def test_a_token_that_can_not_be_sent_is_refused(opened: Opened) -> None:
    view = opened(tokens=(("edge", hashlib.sha256(SECRET.encode()).digest()),))
    box = view.page.get_by_label("Token", exact=True)
    for text in ("correct-horse\u200b-battery-staple", "sch\u00f6n"):
        expect(box).to_have_value("")
        box.fill(text)
        view.page.keyboard.press("Enter")
        view.says("A token has only visible ASCII characters.")
    box.fill(SECRET)
    view.page.keyboard.press("Enter")
    view.says("reads and writes")


def test_a_token_that_is_given_late_allows_writing(opened: Opened) -> None:
    view = opened(tokens=(("edge", hashlib.sha256(SECRET.encode()).digest()),))
    box = view.page.get_by_label("Token", exact=True)
    expect(box).to_be_focused()
    view.page.keyboard.press("Escape")
    expect(box).to_be_hidden()
    view.connect()
    box.fill(SECRET)
    view.page.keyboard.press("Enter")
    view.says("The device responded")
    view.says("reads and writes")
    view.button("Read").click()
    expect(view.button("Write 0")).to_be_visible()
    expect(view.page.get_by_text("Writes are disabled")).to_be_hidden()


def test_a_device_is_part_of_the_address_of_the_page(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.says("The device responded")
    view.page.reload()
    expect(view.page.get_by_role("spinbutton", name="Port")).to_have_value(str(view.port))
    assert view.page.get_by_role("textbox", name="Device").input_value() == "127.0.0.1"


def test_the_keyboard_is_enough(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    page, keyboard = view.page, view.page.keyboard
    page.get_by_role("textbox", name="Device").focus()
    keyboard.type("127.0.0.1")
    keyboard.press("Tab")
    keyboard.press("Control+a")
    keyboard.type(str(view.port))
    page.get_by_role("button", name="Connect").focus()
    keyboard.press("Enter")
    view.says("The device responded")
    expect(view.button("Connect")).to_be_focused()
    keyboard.press("Tab")
    expect(page.get_by_role("tab", name="Values")).to_be_focused()
    keyboard.press("ArrowRight")
    expect(page.get_by_role("tab", name="Map")).to_be_focused()
    expect(view.button("Map device")).to_be_visible()
    keyboard.press("ArrowRight")
    page.get_by_role("combobox", name="Type").select_option("uint16")
    view.button("Read").focus()
    keyboard.press("Enter")
    view.says("read in")
    expect(view.button("Read")).to_be_focused()
    for name in ("Watch", "Add range to view", "Add tag list…", "All types from 0", "Plot 0"):
        keyboard.press("Tab")
        expect(view.button(name)).to_be_focused()
    for name in ("Write 0",):
        keyboard.press("Tab")
        expect(view.button(name)).to_be_focused()
    keyboard.press("Enter")
    expect(page.get_by_role("textbox", name="New value")).to_be_focused()
    keyboard.type("4711")
    keyboard.press("Enter")
    expect(view.button("Write it")).to_be_focused()
    assert plant.read("holding_registers", 0, 1) != [4711]
    expect(view.button("Write it")).to_be_enabled()
    keyboard.press("Enter")
    view.says("Written and read back")
    assert plant.read("holding_registers", 0, 1) == [4711]
    expect(view.button("Write 0")).to_be_focused()
    keyboard.press("Shift+Tab")
    keyboard.press("Enter")
    view.says("Watching")
    expect(view.button("Plot 0")).to_be_focused()
    expect(view.button("Remove the plot of 0")).to_be_visible()
    view.button("Stop").focus()
    keyboard.press("Space")
    view.says("Stopped.")
    expect(view.button("Watch")).to_be_focused()
    page.get_by_role("tab", name="Values").focus()
    keyboard.press("ArrowRight")
    view.button("Map device").focus()
    keyboard.press("Enter")
    view.says("Done in")
    expect(view.button("Map device")).to_be_focused()
    view.button("Read input registers 1000–1063").focus()
    keyboard.press("Enter")
    view.says("Input registers 1000 to 1063: read in")
    expect(view.button("Read")).to_be_focused()


def test_a_key_that_is_held_down_confirms_nothing(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(type="uint16")
    view.button("Read").click()
    view.button("Write 4").click()
    view.page.get_by_role("textbox", name="New value").fill("1")
    view.page.keyboard.down("Enter")
    expect(view.button("Write it")).to_be_focused()
    for _ in range(3):
        view.page.keyboard.down("Enter")
    view.page.keyboard.up("Enter")
    expect(view.button("Write it")).to_be_visible()
    assert plant.read("holding_registers", 4, 1) == [1234]


UNNAMED = """
[...document.querySelectorAll("input, select, button, canvas, [role=img]")]
  .filter((each) => each.checkVisibility())
  .filter((each) => !each.labels?.length && !each.textContent.trim()
    && !each.getAttribute("aria-label") && !each.closest("[role=img]"))
  .map((each) => each.outerHTML)
"""

CONTRAST = """
(pairs) => pairs.map(([front, back]) => {
  const shine = (name) => {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const short = text.length === 4 ? text.replace(/[^#]/g, "$&$&") : text;
    const [r, g, b] = [1, 3, 5].map((at) => parseInt(short.slice(at, at + 2), 16) / 255)
      .map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const [low, high] = [shine(front), shine(back)].sort((a, b) => a - b);
  return (high + 0.05) / (low + 0.05);
})
"""


@both
def test_everything_has_a_name_and_enough_contrast(
    opened: Opened, size: Any, scheme: Literal["light", "dark"]
) -> None:
    view = opened(size, scheme)
    view.connect()
    view.choose(interval="50")
    view.button("Watch").click()
    view.says("Watching")
    assert view.page.evaluate(UNNAMED) == []
    pairs = [
        ("--ink", "--paper"),
        ("--ink", "--card"),
        ("--dim", "--card"),
        ("--dim", "--paper"),
        ("--dim", "--soft"),
        ("--accent", "--card"),
        ("--accent", "--paper"),
        ("--on-accent", "--accent"),
        ("--accent", "--accent-soft"),
        ("--warm-ink", "--warm"),
        ("--bad", "--card"),
        ("--ink", "--bad-soft"),
    ]
    ratios = view.page.evaluate(CONTRAST, pairs)
    poor = {pair: ratio for pair, ratio in zip(pairs, ratios, strict=True) if ratio < 4.5}
    assert poor == {}


def test_the_theme_follows_the_system(opened: Opened) -> None:
    view = opened()
    paper = "getComputedStyle(document.body).backgroundColor"
    light = view.page.evaluate(paper)
    view.page.emulate_media(color_scheme="dark")
    assert view.page.evaluate(paper) != light


class Registers:
    """A device with ten holding registers; `fault` answers writes, `heard` has what was asked."""

    def __init__(self, fault: Callable[[bytes], bytes | None] | None = None) -> None:
        self.values = [1234] * 10
        self.fault = fault
        self.hides = False
        """Whether the registers can only be written."""
        self.heard: list[bytes] = []

    def __call__(self, pdu: bytes) -> bytes | None:
        self.heard.append(pdu)
        first = int.from_bytes(pdu[1:3])
        if pdu[0] == 3:
            count = int.from_bytes(pdu[3:5])
            if self.hides:
                return exception(pdu, 4)
            if first + count > len(self.values):
                return exception(pdu, 2)
            found = self.values[first : first + count]
            return bytes([3, 2 * count]) + b"".join(each.to_bytes(2) for each in found)
        if pdu[0] == 6 and self.fault is not None:
            return self.fault(pdu)
        if pdu[0] == 6:
            self.values[first] = int.from_bytes(pdu[3:5])
            return pdu
        return exception(pdu, 1)

    @property
    def writes(self) -> list[bytes]:
        return [pdu for pdu in self.heard if pdu[0] == 6]


def read_registers(view: View, port: int) -> None:
    """Connects and reads the ten registers."""
    view.connect(port=port)
    view.says("The device responded")
    view.choose(type="uint16", quantity="10")
    view.button("Read").click()
    view.says("Holding registers 0 to 9: read in")


def write_4711(view: View) -> Locator:
    """Asks to write 4711 to register 1, and confirms it; the dialog."""
    view.button("Write 1").click()
    view.page.get_by_role("textbox", name="New value").fill("4711")
    view.button("Review").click()
    view.button("Write it").click()
    return view.page.get_by_role("dialog")


@pytest.mark.parametrize("leave", ["escape", "cancel"])
def test_a_write_that_is_refused_is_not_told_as_written(opened: Opened, leave: str) -> None:
    device = Registers(lambda pdu: exception(pdu, 4))
    with FakeDevice(device) as refusing:
        view = opened()
        read_registers(view, refusing.port)
        alert = write_4711(view).get_by_role("alert")
        expect(alert).to_contain_text("Unknown whether it was written.")
        expect(alert).to_contain_text("The device failed to carry out the request.")
        expect(alert).to_contain_text("check the device")
        expect(alert).to_contain_text("Read back: unchanged.")
        if leave == "escape":
            view.page.keyboard.press("Escape")
        else:
            view.button("Cancel").click()
        view.says("Unknown whether it was written. The table shows")
        expect(view.page.get_by_text("Changes are marked")).to_be_hidden()
        expect(view.row(1).get_by_role("cell").first).to_have_text("1234")
        assert len(device.writes) == 1


@pytest.mark.parametrize("carried_out", [True, False])
def test_a_write_without_a_reply_is_told_as_unknown_and_read_back(
    opened: Opened, carried_out: bool
) -> None:
    def silent(pdu: bytes) -> None:
        if carried_out:
            device.values[1] = int.from_bytes(pdu[3:5])

    device = Registers(silent)
    with FakeDevice(device) as mute:
        view = opened()
        view.page.get_by_role("spinbutton", name="Timeout").fill("1000")
        read_registers(view, mute.port)
        alert = write_4711(view).get_by_role("alert")
        expect(alert).to_contain_text("Unknown whether it was written.")
        expect(alert).to_contain_text("The device did not respond in time.")
        told = "the new values are there" if carried_out else "unchanged"
        expect(alert).to_contain_text(f"Read back: {told}.")
        view.page.keyboard.press("Escape")
        view.says("Unknown whether it was written. The table shows")
        expect(view.row(1).get_by_role("cell").first).to_have_text(
            "4711" if carried_out else "1234"
        )


def test_a_write_that_the_browser_sends_again_is_carried_out_once(opened: Opened) -> None:
    def lost(pdu: bytes) -> None:
        device.values[1] = int.from_bytes(pdu[3:5])
        proxy.cut()

    device = Registers(lost)
    with FakeDevice(device) as plc:
        view = opened()
        with contextlib.closing(Proxy(view.gateway.address[1], "http")) as proxy:
            view.gateway.url = proxy.url
            view.requests.clear()
            read_registers(view.open(), plc.port)
            alert = write_4711(view).get_by_role("alert")
            expect(alert).to_contain_text("Unknown whether it was written.")
            expect(alert).to_contain_text("The browser or a proxy sent the write again.")
            expect(alert).to_contain_text("Read back: the new values are there.")
            assert len(device.writes) == 1


def test_a_write_that_can_not_be_read_back_says_so(opened: Opened) -> None:
    device = Registers(lambda _: HANG_UP)
    with FakeDevice(device) as leaving:
        view = opened()
        read_registers(view, leaving.port)
        view.button("Write 1").click()
        view.page.get_by_role("textbox", name="New value").fill("4711")
        view.button("Review").click()
        expect(view.button("Write it")).to_be_visible()
        device.values = []
        view.button("Write it").click()
        view.says("Reading back failed: read the values before you continue.")
        view.page.keyboard.press("Escape")
        view.says("Unknown whether it was written. Reading back failed.")
        view.says("Stale values of 127.0.0.1")


def test_a_write_that_is_left_alone_is_told_when_it_ends(opened: Opened) -> None:
    device = Registers(lambda _: None)
    with FakeDevice(device) as mute:
        view = opened()
        view.page.get_by_role("spinbutton", name="Timeout").fill("1000")
        read_registers(view, mute.port)
        dialog = write_4711(view)
        expect(dialog.get_by_text("Writing…")).to_be_visible()
        view.page.keyboard.press("Escape")
        expect(dialog).to_be_hidden()
        view.says("Unknown whether it was written. The table shows")


@pytest.mark.parametrize("answered", [True, False])
def test_a_write_is_told_if_another_range_is_read_meanwhile(opened: Opened, answered: bool) -> None:
    held: list[Route] = []

    def hold(route: Route) -> None:
        if held:
            route.continue_()
        else:
            held.append(route)

    with FakeDevice(Registers()) as device:
        view = opened()
        read_registers(view, device.port)
        view.page.route("**/api/modbus/watch/view", hold)
        with view.page.expect_request("**/api/modbus/watch/view"):
            write_4711(view)
        view.read_four(2)
        if answered:
            held[0].continue_()
        else:
            held[0].abort()
        view.says(f"Written: 1 of 127.0.0.1:{device.port}.")


@pytest.mark.parametrize("then", ["goes on", "is stopped"])
def test_values_read_back_do_not_replace_newer_ones_of_a_watch(opened: Opened, then: str) -> None:
    held: list[tuple[Route, Any]] = []

    def hold(route: Route) -> None:
        if held:
            route.continue_()
        else:
            held.append((route, route.fetch()))

    device = Registers()
    with FakeDevice(device) as there:
        view = opened()
        read_registers(view, there.port)
        view.button("Add range to view").click()
        view.button("Read").click()
        view.says("Holding registers 0 to 9: read in")
        view.page.route("**/api/modbus/watch/view", hold)
        with view.page.expect_request("**/api/modbus/watch/view"):
            write_4711(view)
        cell = view.row(5).get_by_role("cell").first
        view.page.wait_for_function("() => !document.getElementById('write-dialog').open")
        device.values[5] = 2222
        view.button("Watch").click()
        expect(cell).to_have_text("2222")
        if then == "is stopped":
            view.button("Stop").click()
        route, old = held[0]
        route.fulfill(response=old)
        there_still = f": 1 of 127.0.0.1:{there.port}."
        view.says("Written" + (there_still if then == "is stopped" else ". The watch continues."))
        expect(cell).to_have_text("2222")


def test_a_read_that_a_write_has_overtaken_is_read_again(opened: Opened) -> None:
    held: list[tuple[Route, Any]] = []

    def hold(route: Route) -> None:
        if held:
            route.continue_()
        else:
            held.append((route, route.fetch()))

    with FakeDevice(Registers()) as device:
        view = opened()
        read_registers(view, device.port)
        view.page.route("**/api/modbus/watch/view", hold)
        with view.page.expect_request("**/api/modbus/watch/view"):
            view.button("Read").click()
        write_4711(view)
        view.says("Holding registers 0 to 9: read in")
        view.says(f"Written: 1 of 127.0.0.1:{device.port}.")
        route, old = held[0]
        route.fulfill(response=old)
        expect(view.row(1).get_by_role("cell").first).to_have_text("4711")


@pytest.mark.parametrize("streams", [16, 0])
def test_a_watch_reads_at_once_after_a_write(opened: Opened, streams: int) -> None:
    with FakeDevice(Registers()) as device:
        view = opened(limits={"interval": 0.05, "streams": streams})
        read_registers(view, device.port)
        view.choose(interval="3600000")
        view.button("Watch").click()
        view.says("Watching holding registers 0 to 9")
        write_4711(view)
        view.says("Written. The watch continues.")
        expect(view.row(1).get_by_role("cell").first).to_have_text("4711")


def test_a_table_that_was_read_during_a_write_is_read_again(opened: Opened) -> None:
    def slow(pdu: bytes) -> bytes:
        device.values[1] = 4711
        assert go_on.wait(wire.DEADLINE)
        return pdu

    go_on = threading.Event()
    device = Registers(slow)
    with FakeDevice(device) as plc:
        view = opened()
        read_registers(view, plc.port)
        old = {"kind": "range", "functionCode": 3, "address": 1, "quantity": 1}
        part = {**old, "format": "registers", "values": [1234], "texts": [], "errors": {}}
        data = json.dumps({"time": 0, "rtt": 0, "stream": False, "parts": [part]})
        event = {"content_type": "text/event-stream", "body": f"event: view\ndata: {data}\n\n"}
        view.page.route("**/watch/view", lambda route: route.fulfill(**event), times=1)
        dialog = write_4711(view)
        expect(dialog.get_by_text("Writing…")).to_be_visible()
        view.page.keyboard.press("Escape")
        view.choose(address="1", quantity="1")
        view.button("Read").click()
        view.says("Holding registers 1 to 1: read in")
        expect(view.row(1).get_by_role("cell").first).to_have_text("1234")
        go_on.set()
        view.says(f"Written: 1 of 127.0.0.1:{plc.port}.")
        expect(view.row(1).get_by_role("cell").first).to_have_text("4711")


def test_errors_before_a_write_are_told_in_plain_words(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as vanishing:
        view = opened()
        read_registers(view, vanishing.port)
        device.values = []
        view.button("Write 1").click()
        view.page.get_by_role("textbox", name="New value").fill("4711")
        view.button("Review").click()
        view.says("The device does not have this address.")
        view.says("this page counts from 0")
        assert device.writes == []


def test_registers_that_can_not_be_read_are_written(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as hiding:
        view = opened()
        read_registers(view, hiding.port)
        device.hides = True
        dialog = review(view, "Write 1", "4711")
        expect(dialog.get_by_text("The current value can't be read.")).to_be_visible()
        expect(dialog.get_by_text("The device failed to carry out the request.")).to_be_visible()
        expect(dialog.get_by_role("row", name="1 not read 4711 0x1267")).to_be_visible()
        view.button("Write it").click()
        view.says("Written. Reading back failed.")
        assert device.values[1] == 4711


PAUSES = """([usual, ms]) => {
  const wait = window.setTimeout;
  window.setTimeout = (work, time, ...more) => wait(work, time === usual ? ms : time, ...more);
}"""
"""Changes a time of the page."""
REFRESHED_AFTER = 3000
"""The time after which a review reads again."""
SEEN_AFTER = 700
"""The time after which what is new in a review can be confirmed."""
NEVER = 10**9
LATER = "() => { const now = Date.now; Date.now = () => now() + 60_000; }"


def test_a_review_is_refreshed_before_a_write_if_a_register_has_changed(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as changing:
        view = opened()
        view.page.evaluate(PAUSES, [REFRESHED_AFTER, NEVER])
        read_registers(view, changing.port)
        dialog = review(view, "Write 1", "4711")
        expect(dialog.get_by_role("row", name="1 1234 0x04D2 4711 0x1267")).to_be_visible()
        device.values[1] = 7
        view.button("Write it").click()
        view.says("The current values have changed.")
        expect(dialog.get_by_role("row", name="1 7 0x0007 4711 0x1267")).to_be_visible()
        assert device.writes == []
        device.values[1] = 8  # A value that changes all the time can be written.
        view.button("Write it").click()
        view.says("Written and read back")
        assert device.values[1] == 4711


@pytest.mark.parametrize("new", ["the review", "what has changed", "what has changed while open"])
def test_a_second_click_or_key_confirms_nothing_unseen(opened: Opened, new: str) -> None:
    device = Registers()
    with FakeDevice(device) as plc:
        view = opened()
        refreshed = 20 if new == "what has changed while open" else NEVER
        view.page.evaluate(PAUSES, [REFRESHED_AFTER, refreshed])
        read_registers(view, plc.port)
        if new != "the review":
            review(view, "Write 1", "4711")
            expect(view.button("Write it")).to_be_enabled()
        view.page.evaluate(PAUSES, [SEEN_AFTER, NEVER])
        if new == "the review":
            review(view, "Write 1", "4711")
        else:
            device.values[1] = 7
            if new == "what has changed":
                view.button("Write it").click()
            view.says("The current values have changed.")
        expect(view.button("Write it")).to_be_focused()
        expect(view.button("Write it")).to_be_disabled()
        told = view.page.locator("#write-wait").text_content()
        sent = len(view.requests)
        view.page.keyboard.press("Enter")
        view.button("Write it").click(force=True)
        # A confirmed write tells at once that it reads.
        assert view.page.locator("#write-wait").text_content() == told
        view.button("Back").click()
        view.button("Cancel").click()
        later = view.requests[sent:]
        # An open review is read again and again.
        assert later == [] or (refreshed != NEVER and not any("/write/" in url for url in later))
        assert device.writes == []


def test_the_second_click_of_a_slow_double_click_confirms_nothing(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as plc:
        view = opened()
        read_registers(view, plc.port)
        review(view, "Write 1", "4711")
        expect(view.button("Write it")).to_be_enabled()
        view.button("Write it").dispatch_event("click", {"detail": 2})
        view.button("Back").click()
        view.button("Cancel").click()
        assert device.writes == []


def test_an_open_review_is_refreshed(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as changing:
        view = opened()
        view.page.evaluate(PAUSES, [REFRESHED_AFTER, 20])
        read_registers(view, changing.port)
        dialog = review(view, "Write 1", "4711")
        device.values[1] = 7
        expect(dialog.get_by_role("row", name="1 7 0x0007 4711 0x1267")).to_be_visible()
        view.says("The current values have changed.")
        device.hides = True
        view.page.evaluate(LATER)
        expect(dialog.get_by_role("row", name="1 not read 4711 0x1267")).to_be_visible()
        assert device.writes == []


def test_an_old_review_is_refreshed_before_a_write(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as hiding:
        view = opened()
        view.page.evaluate(PAUSES, [REFRESHED_AFTER, NEVER])
        read_registers(view, hiding.port)
        dialog = review(view, "Write 1", "4711")
        device.hides = True
        view.page.evaluate(LATER)
        view.button("Write it").click()
        view.says("The current values have changed.")
        expect(dialog.get_by_role("row", name="1 not read 4711 0x1267")).to_be_visible()
        assert device.writes == []
        view.button("Write it").click()
        view.says("Written. Reading back failed.")
        assert device.values[1] == 4711


def level(scale: float) -> TagList:
    return TagList([Tag("level", "holding_registers", 1, "uint16", scale=scale, writable=True)])


@pytest.mark.parametrize("noticed", ["while it is open", "before the write", "without a read"])
def test_a_review_ends_if_the_tag_has_another_definition(opened: Opened, noticed: str) -> None:
    profiles = {"tank": level(0.1)}
    device = Registers()
    with FakeDevice(device) as tank:
        view = opened(profiles=profiles)
        refreshed = 20 if noticed == "while it is open" else NEVER
        view.page.evaluate(PAUSES, [REFRESHED_AFTER, refreshed])
        view.connect(port=tank.port)
        view.says("The device responded")
        view.button("Add tag list…").click()
        view.page.get_by_role("combobox", name="Profile of the configuration").select_option("tank")
        view.button("Add").click()
        view.button("Read").click()
        view.says("tank: read in")
        device.hides = noticed == "without a read"
        dialog = review(view, "Write level", "50")
        now = "not read" if device.hides else "123.4"
        expect(dialog.get_by_role("row", name=f"level {now} 50.0")).to_be_visible()
        profiles["tank"] = level(0.01)
        if noticed != "while it is open":
            view.button("Write it").click()
        view.says("The gateway has another definition of level now.")
        expect(view.button("Write it")).to_be_hidden()
        assert device.writes == []


def test_a_change_of_the_device_makes_what_is_shown_old(opened: Opened) -> None:
    first, second = Registers(), Registers()
    second.values = [7] * 10
    with FakeDevice(first) as a, FakeDevice(second) as b:
        view = opened()
        read_registers(view, a.port)
        expect(view.page.get_by_text(f"Values of 127.0.0.1:{a.port}, unit 1")).to_be_visible()
        port = view.page.get_by_role("spinbutton", name="Port")
        port.fill(str(b.port))
        view.says("Not connected: connect to continue.")
        view.says(f"Stale values of 127.0.0.1:{a.port}, unit 1")
        for name in ("Write 1", "Read", "Watch", "Plot 1"):
            expect(view.button(name)).to_be_disabled()
        expect(view.page.get_by_text("The device responded")).to_be_hidden()
        port.fill("1")
        view.button("Connect").click()
        view.says("The connection was refused or failed.")
        expect(view.button("Write 1")).to_be_disabled()
        view.says(f"Stale values of 127.0.0.1:{a.port}, unit 1")
        view.connect(port=b.port)
        view.says("The device responded")
        expect(view.button("Write 1")).to_have_count(0)
        view.button("Read").click()
        expect(view.row(1).get_by_role("cell").first).to_have_text("7")


def test_a_write_goes_to_the_device_of_the_table(opened: Opened) -> None:
    first, second = Registers(), Registers()
    with FakeDevice(first) as a, FakeDevice(second) as b:
        view = opened()
        read_registers(view, a.port)
        # A value that is set by something other than a hand tells nobody.
        view.page.evaluate(f"document.getElementById('port').value = {b.port}")
        view.button("Write 1").click()
        expect(view.page.get_by_text(f"of unit 1 at 127.0.0.1:{a.port}")).to_be_visible()
        view.page.get_by_role("textbox", name="New value").fill("4711")
        view.button("Review").click()
        view.button("Write it").click()
        view.says("Written and read back")
        assert (first.values[1], second.heard) == (4711, [])


def test_a_change_of_the_device_gives_up_what_is_under_way(opened: Opened) -> None:
    with FakeDevice(lambda _: None) as mute:
        view = opened()
        view.connect(port=mute.port)
        view.says("Connecting…")
        view.page.get_by_role("textbox", name="Device").fill("127.0.0.2")
        view.says("Not connected")
        expect(view.button("Read")).to_be_hidden()
        view.connect()
        view.says("The device responded")
        view.choose(interval="50")
        view.button("Watch").click()
        view.says("Watching holding registers")
        view.page.get_by_role("spinbutton", name="Unit id").fill("2")
        view.says("Stopped.")
        view.says("Stale values of")


def only(*there: range) -> Callable[[bytes], bytes]:
    """A device that has these holding registers."""

    def answer(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        fits = any(first in each and first + count - 1 in each for each in there)
        return registers(pdu, 5) if pdu[0] == 3 and fits else exception(pdu, 2)

    return answer


def survey(view: View, first: int, last: int) -> None:
    """Maps the holding registers of a device in a stretch."""
    view.page.get_by_role("tab", name="Map").click()
    for name in ("Coils", "Discrete inputs", "Input registers"):
        view.page.get_by_role("checkbox", name=name).uncheck()
    view.page.get_by_role("spinbutton", name="First address").fill(str(first))
    view.page.get_by_role("spinbutton", name="Last address").fill(str(last))
    view.button("Map device").click()
    view.says("Done in")


@pytest.mark.parametrize(
    ("there", "asked", "kind"),
    [
        (range(1000, 1001), 1, "uint16"),
        (range(1000, 1003), 3, "uint16"),
        (range(1000, 1004), 4, "float32"),
        (range(1000, 1300), 124, "float32"),
    ],
    ids=["one", "three", "four", "many"],
)
def test_a_click_on_a_range_reads_no_more_than_that(
    opened: Opened, there: range, asked: int, kind: str
) -> None:
    with FakeDevice(only(there)) as device:
        view = opened()
        view.connect(port=device.port)
        view.choose(type="float32")
        survey(view, 900, 1400)
        last = f"–{there[-1]}" if len(there) > 1 else ""
        view.button(f"Read holding registers 1000{last}").click()
        view.says(f"Holding registers 1000 to {999 + asked}: read in")
        assert device.asked[-1] == bytes([3]) + (1000).to_bytes(2) + asked.to_bytes(2)
        expect(view.page.get_by_role("combobox", name="Type")).to_have_value(kind)
        expect(view.page.get_by_text("one read covers only a part of it")).to_be_visible(
            visible=len(there) > asked
        )


def test_a_map_of_samples_says_so_and_offers_all(opened: Opened) -> None:
    with FakeDevice(only(range(1000, 1004), range(1123, 1125))) as device:
        view = opened()
        view.connect(port=device.port)
        survey(view, 980, 1149)
        view.says("short ranges may be among them")
        expect(view.page.get_by_role("button", name="Read holding registers")).to_have_count(1)
        view.button("Read every address (slow)").click()
        expect(view.button("Read holding registers 1123–1124")).to_be_visible()
        expect(view.page.get_by_text("short ranges may be among them")).to_be_hidden()
        asked = {int.from_bytes(pdu[1:3]) for pdu in device.asked}
        assert set(range(980, 1000)) <= asked


@pytest.mark.parametrize("answer", ["exception", "nothing"])
def test_a_device_without_function_3_can_be_read(opened: Opened, answer: str) -> None:
    def inputs(pdu: bytes) -> bytes | None:
        if pdu[0] == 4:
            return registers(pdu, 77)
        return exception(pdu, 1) if answer == "exception" else None

    with FakeDevice(inputs) as device:
        view = opened()
        timeout = view.page.get_by_role("spinbutton", name="Timeout")
        timeout.fill("50" if answer == "nothing" else "1000")
        view.connect(port=device.port)
        if answer == "nothing":
            view.says("The device did not respond in time.")
            timeout.fill("1000")
            expect(view.button("Continue anyway")).to_be_hidden()
            view.button("Connect").click()
            view.button("Continue anyway").click()
            expect(view.page.get_by_role("tab", name="Values")).to_be_focused()
            view.says("Holding register 0 was not read, but other areas may work")
        else:
            view.says("ms, but can't read holding register 0: ")
        view.choose(area="4", type="uint16", quantity="2")
        view.button("Read").click()
        view.says("Input registers 0 to 1: read in")
        expect(view.row(0).get_by_role("cell").first).to_have_text("77")


TYPES: list[tuple[dict[str, str], list[int], str]] = [
    ({"type": "float64", "order": "letters", "letters": "efghabcd"}, [0, 0, 0x3FF8, 0], "1.5"),
    ({"type": "bit", "size": "3"}, [8], "true"),
    ({"type": "bool"}, [0], "false"),
    ({"type": "bytes", "size": "3"}, [0x0A0B, 0x0C00], "0a 0b 0c"),
    ({"type": "string", "size": "4"}, [0x5031, 0x2D37], "P1-7"),
    ({"type": "float16"}, [0x3E00], "1.5"),
    ({"type": "bcd32"}, [0x1234, 0x5678], "12345678"),
]


def test_any_type_is_read(
    opened: Opened, plant: holdfast.Memory, subtests: pytest.Subtests
) -> None:
    view = opened(PHONE)
    view.connect()
    for fields, held, text in TYPES:
        with subtests.test(fields["type"]):
            plant.write("holding_registers", 8, held)
            view.choose(address="8", quantity=str(len(held)), **{"order": "ABCD", **fields})
            view.button("Read").click()
            view.says(f"Holding registers 8 to {7 + len(held)}: read in")
            expect(view.row(8).locator(".typed")).to_have_text(text)


WRITES: list[tuple[dict[str, str], str, list[int]]] = [
    ({"type": "string", "size": "6"}, "a, b", [0x612C, 0x2062, 0]),
    ({"type": "string", "size": "4"}, "", [0, 0]),
    ({"type": "bytes", "size": "4"}, "0a0B 0c0d", [0x0A0B, 0x0C0D]),
    ({"type": "bit", "size": "3"}, "on", [0x0008]),
    ({"type": "bit", "size": "3", "order": "BADC"}, "on", [0x0800]),
    ({"type": "bool"}, "true", [1]),
    ({"type": "bcd16"}, "1234", [0x1234]),
    ({"type": "int64", "order": "letters"}, "1", [0, 1, 0, 0]),
]


def test_any_type_is_written(
    opened: Opened, plant: holdfast.Memory, subtests: pytest.Subtests
) -> None:
    view = opened()
    view.connect()
    for address, (fields, given, held) in zip(range(8, 256, 8), WRITES, strict=False):
        with subtests.test(f"{fields} {given}"):
            before = [0x4142 if fields["type"] == "string" else 0] * len(held)
            plant.write("holding_registers", address, before)
            view.read_four(address, **{"order": "ABCD", **fields})
            view.button(f"Write {address}").click()
            expect(view.page.get_by_text("Written and read back")).to_be_hidden()
            view.page.get_by_role("textbox", name="New value").fill(given)
            view.button("Review").click()
            view.button("Write it").click()
            view.says("Written and read back")
            assert plant.read("holding_registers", address, len(held)) == held


def test_a_value_that_is_none_of_a_type_is_told(opened: Opened, subtests: pytest.Subtests) -> None:
    view = opened()
    view.connect()
    cases = (
        ({"type": "string", "size": "4"}, "abcde", "up to 4 ASCII characters"),
        ({"type": "string", "size": "4"}, "5 °C", "up to 4 ASCII characters"),
        ({"type": "bytes", "size": "4"}, "0a0b", "4 pairs of hexadecimal digits"),
        ({"type": "bit", "size": "3"}, "2", "is not a bit"),
        ({"type": "bit", "size": "3"}, "1, 0", "Write one bit at a time"),
    )
    for address, (fields, given, says) in enumerate(cases, 8):
        with subtests.test(f"{fields} {given}"):
            view.read_four(address, **fields)
            view.button(f"Write {address}").click()
            alert = view.page.get_by_role("alert").filter(has_text=says)
            expect(alert).to_be_hidden()
            view.page.get_by_role("textbox", name="New value").fill(given)
            view.button("Review").click()
            expect(alert).to_be_visible()
            view.button("Cancel").click()


def test_letters_that_are_no_order_are_told(opened: Opened, subtests: pytest.Subtests) -> None:
    view = opened()
    view.connect()
    view.says("The device responded")
    cases = (
        ("int64", "ABCDEFGG", "contains each of A to H once"),
        ("int64", "ACBDEFGH", "The bytes of a register stay together"),
        ("int64", "CDEFGHAB", "applied twice"),
        ("int32", "EFGHABCD", "int32 has 4"),
    )
    for first, (kind, letters, says) in enumerate(cases):
        with subtests.test(f"{kind} {letters}"):
            view.choose(address=str(first), type=kind, order="letters", letters=letters)
            told = view.page.locator("#letters").evaluate("(each) => each.validationMessage")
            assert says in told
            view.button("Read").click()
            expect(view.page.locator("#letters")).to_be_focused()
            view.choose(letters="GHEFCDAB", type="int64")
            view.button("Read").click()
            view.says(f"Holding registers {first} to {first + 7}: read in")


def test_all_orders_of_eight_bytes_are_shown(opened: Opened, plant: holdfast.Memory) -> None:
    plant.write("holding_registers", 8, [0, 0, 0x3FF8, 0])
    view = opened(PHONE)
    view.connect()
    view.choose(address="8", quantity="4")
    view.button("Read").click()
    view.button("All types from 8").click()
    dialog = view.page.get_by_role("dialog")
    expect(dialog.get_by_role("columnheader", name="EFGHABCD")).to_be_visible()
    cells = dialog.get_by_role("row").filter(has_text="float64").nth(1).get_by_role("cell")
    assert cells.nth(1).inner_text() == "1.5"
    for name in ("float16 0 0 0 0", "bcd16 0 0 0 0", "bits on none none none none"):
        expect(dialog.get_by_role("row", name=name)).to_be_visible()


def test_a_field_that_the_gateway_refuses_is_marked(opened: Opened) -> None:
    view = opened()
    view.connect(host="no name")
    view.says("The request is malformed.")
    view.says("Check the marked value.")
    host = view.page.get_by_role("textbox", name="Device")
    expect(host).to_have_attribute("aria-invalid", "true")
    assert host.evaluate("(each) => getComputedStyle(each).borderColor") == "rgb(164, 39, 27)"
    view.connect()
    view.says("The device responded")
    expect(host).not_to_have_attribute("aria-invalid", "true")


def test_a_range_is_checked_before_it_is_watched_or_read(opened: Opened) -> None:
    view = opened(limits={"interval": 0.1})
    view.connect()
    view.says("The device responded")
    for fields, wrong in (
        ({"interval": "5"}, "interval"),
        ({"interval": "100", "address": ""}, "address"),
        ({"address": "65530", "quantity": "10"}, "quantity"),
    ):
        view.choose(**fields)
        view.button("Watch").click()
        expect(view.page.locator(f"#{wrong}")).to_be_focused()
        expect(view.button("Watch")).to_have_attribute("aria-pressed", "false")
        if wrong != "interval":
            view.page.locator("#area").focus()
            view.button("Read").click()
            expect(view.page.locator(f"#{wrong}")).to_be_focused()
    assert [url for url in view.requests if "/watch" in url] == []


def test_whole_values_are_read_and_that_is_told(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(type="float32", quantity="125")
    view.button("Read").click()
    view.says("Each float32 has 2 registers: 124 instead of 125.")
    view.choose(quantity="1")
    view.button("Watch").click()
    view.says("Each float32 has 2 registers: 2 instead of 1.")


def test_a_plot_that_can_not_be_is_told(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(quantity="20", type="uint16", interval="50")
    view.button("Watch").click()
    view.says("Watching")
    box = view.page.get_by_role("spinbutton", name="Plot address")
    box.fill("5000")
    view.button("Add plot").click()
    view.says("5000 is not watched, only 0 to 19.")
    for address in range(9):
        box.fill(str(address))
        view.button("Add plot").click()
    view.says("There can be at most 8 plots.")
    box.fill("3")
    view.button("Add plot").click()
    view.says("3 is already plotted.")
    expect(view.button("Remove the plot of 3")).to_be_visible()


@pytest.mark.parametrize(
    ("kind", "held", "text"),
    [
        ("uint64", [0x20, 0, 0, 1], "9007199254740993"),
        ("float64", [0x413C, 0x9C45, 0x3333, 0x3333], "1875013.2"),
    ],
)
def test_a_plot_has_the_digits_of_the_table(
    opened: Opened, plant: holdfast.Memory, kind: str, held: list[int], text: str
) -> None:
    plant.write("holding_registers", 8, held)
    view = opened()
    view.connect()
    view.choose(type=kind, address="8", quantity="4", interval="50")
    view.button("Read").click()
    expect(view.row(8).locator(".typed")).to_have_text(text)
    view.button("Plot 8").click()
    expect(view.page.get_by_role("article").get_by_role("status")).to_have_text(text)


def test_a_watch_goes_on_when_the_gateway_is_back(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.says("The device responded")
    view.choose(type="float32", quantity="2", interval="50")
    part = {"kind": "range", "functionCode": 3, "address": 0, "quantity": 2, "format": "registers"}
    part |= {"values": [0, 0], "texts": ["0"], "errors": {}}
    body = json.dumps({"time": 0, "rtt": 0, "stream": True, "parts": [part]})
    answers = iter([f"event: view\ndata: {body}\n\n"])

    def gone(route: Route) -> None:
        once = next(answers, None)
        if once is None:
            route.abort()
        else:
            route.fulfill(content_type="text/event-stream", body=once)

    view.page.route("**/api/modbus/watch/view", gone)
    view.button("Watch").click()
    view.says("The gateway ended the watch or does not answer. The watch resumes")
    view.says("Stale values of")
    view.page.unroute("**/api/modbus/watch/view")
    view.says("Watching holding registers 0 to 1")
    expect(view.row(0).locator(".typed")).to_have_text("21.5")
    view.button("Stop").click()
    view.says("Stopped.")


SILENT_AFTER = 20_000
"""The time after which a stream without a byte is given up."""


def test_a_watch_goes_on_when_its_connection_is_dead(opened: Opened) -> None:
    device = Registers()
    with FakeDevice(device) as plc:
        view = opened()
        with contextlib.closing(Proxy(view.gateway.address[1], "http")) as proxy:
            view.gateway.url = proxy.url
            view.requests.clear()
            view.open().page.evaluate(PAUSES, [SILENT_AFTER, 2000])
            read_registers(view, plc.port)
            view.choose(interval="50")
            view.button("Watch").click()
            view.says("Watching holding registers 0 to 9")
            proxy.hold()
            view.says("The gateway ended the watch or does not answer. The watch resumes")
            device.values[5] = 2222
            proxy.go_on()
            view.says("Watching holding registers 0 to 9")
            expect(view.row(5).get_by_role("cell").first).to_have_text("2222")


LABELS = """
() => {
  const fill = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
    document.body.dataset.labels = `${document.body.dataset.labels ?? ""} ${text}`;
    return fill.call(this, text, ...rest);
  };
}
"""


def test_a_plot_of_tiny_values_has_labels(opened: Opened, plant: holdfast.Memory) -> None:
    plant.write("holding_registers", 0, floats(1e-30))
    view = opened()
    view.page.evaluate(LABELS)
    view.connect()
    view.choose(type="float32", quantity="2", interval="50")
    view.button("Watch").click()
    view.says("Watching")
    plant.write("holding_registers", 0, floats(2e-30))
    expect(view.page.locator("body")).to_have_attribute("data-labels", re.compile(r"[1-9]e-30 "))


def test_old_values_can_be_read(opened: Opened) -> None:
    schemes: tuple[Literal["light", "dark"], ...] = ("light", "dark")
    for scheme in schemes:
        view = opened(DESK, scheme)
        view.page.emulate_media(reduced_motion="reduce")
        view.connect()
        for area, selector in (("3", ".values td, .values tbody th, .age"), ("1", ".bit")):
            view.choose(area=area)
            view.button("Read").click()
            view.says("read in")
            view.page.get_by_role("spinbutton", name="Unit id").fill("2")
            view.says("Stale values")
            assert view.page.evaluate(MIN_CONTRAST, f"#table :is({selector})") >= 4.5
            view.page.get_by_role("spinbutton", name="Unit id").fill("1")
            view.button("Connect").click()
            view.says("The device responded")


@both
def test_no_choice_is_cut(opened: Opened, size: Any, scheme: Literal["light", "dark"]) -> None:
    view = opened(size, scheme)
    view.connect()
    view.says("The device responded")
    assert view.page.evaluate(CUT) == []


CUT = """
[...document.querySelectorAll("select")].filter((each) => each.checkVisibility()).filter((each) => {
  const alone = each.cloneNode(true);
  alone.style.cssText = "position: absolute; width: max-content";
  document.body.append(alone);
  const cut = each.offsetWidth < alone.offsetWidth;
  alone.remove();
  return cut;
}).map((each) => each.id)
"""
"""Selects that are narrower than their widest choice."""

MIN_CONTRAST = """
(selector) => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const shine = ([r, g, b]) => [r, g, b].map((each) => each / 255)
    .map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4))
    .reduce((sum, part, at) => sum + part * [0.2126, 0.7152, 0.0722][at], 0);
  const behind = (each) => {
    const [r, g, b, a = 1] = parts(getComputedStyle(each).backgroundColor);
    return a === 1 || !each.parentElement ? [r, g, b] : behind(each.parentElement);
  };
  const opaque = (each) =>
    each === null ? 1 : Number(getComputedStyle(each).opacity) * opaque(each.parentElement);
  const found = [...document.querySelectorAll(selector)];
  return Math.min(...found.map((each) => {
    const [front, back] = [parts(getComputedStyle(each).color), behind(each)];
    const part = opaque(each);
    const seen = front.slice(0, 3).map((own, at) => own * part + back[at] * (1 - part));
    const [low, high] = [shine(seen), shine(back)].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  }));
}
"""
"""The least contrast of the texts of some elements, with their opacity."""
