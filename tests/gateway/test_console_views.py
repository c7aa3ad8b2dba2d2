"""Views in the console: several parts, gaps, many tabs, links, and downloads, in a real browser."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
import threading
import time
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import pytest
from playwright.sync_api import Error, expect

from holdfast.gateway.streams import views
from holdfast.tags import Tag, TagList
from support import gateway_pages, wire
from support.fake_device import HANG_UP, FakeDevice, registers
from support.gateway_pages import DESK, Opened, Pages, View, floats, opening

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Download, Page, Route

    import holdfast

NARROW: Any = {"viewport": {"width": 320, "height": 640}, "has_touch": True}
METER = """\
tags:
  room: {area: holding_registers, address: 4, scale: 0.1, unit: °C,
         writable: true, min: 5, max: 300}
  state: {area: holding_registers, address: 5, states: {0: off, 2: fault}, writable: true}
  lamp: {area: coils, address: 2, writable: true}
  absent: {area: input_registers, address: 5}
"""
PLACES = """\
tags:
  flow: {area: holding_registers, address: 10, type: float32, order: CDAB, writable: true}
  alarm: {area: holding_registers, address: 12, type: "bit:4", writable: true}
  lamps: {area: coils, address: 1, type: "bool[2]", writable: true}
"""
LONG = """\
tags:
  energy: {area: holding_registers, address: 20, type: uint64, unit: Wh, writable: true,
           min: 9007199254740993, max: 18446744073709551615}
  key: {area: holding_registers, address: 24, type: "bytes:3", writable: true}
"""
TANK = TagList([Tag("level", "input_registers", 1002, "int16", unit="mm")])
WATCHES = 7
"""More tabs than the connections that a browser opens to one host."""


@pytest.fixture
def plant() -> holdfast.Memory:
    return gateway_pages.plant()


@pytest.fixture
def opened(pages: Pages, plant: holdfast.Memory) -> Iterator[Opened]:
    with opening(pages, plant, model="Feeder 7") as opened:
        yield opened


def add_tags(view: View, text: str) -> None:
    view.button("Add tag list…").click()
    view.page.get_by_role("textbox", name="YAML or CSV").fill(text)
    view.button("Add").click()
    expect(view.page.get_by_role("dialog")).to_be_hidden()


def connected(opened: Opened, size: Any = DESK, **settings: Any) -> View:
    view = opened(size, **settings)
    view.connect()
    view.says("The device responded")
    return view


def tag(view: View, name: str) -> Any:
    """Returns the value of a tag in the table."""
    return view.page.locator(f"tr[data-tag='{name}'] .typed")


def saved(download: Download) -> list[dict[str, str]]:
    text = Path(download.path()).read_text(encoding="utf-8-sig")
    return list(csv.DictReader(io.StringIO(text)))


# Several parts.


@pytest.mark.parametrize("size", [DESK, NARROW], ids=["desk", "narrow"])
def test_ranges_and_tags_are_watched_in_one_stream(
    opened: Opened, plant: holdfast.Memory, size: Any
) -> None:
    view = connected(opened, size, profiles={"tank": TANK})
    view.choose(area="1", quantity="4", interval="50")
    view.button("Add range to view").click()
    add_tags(view, METER)
    view.button("Add tag list…").click()
    view.page.get_by_role("combobox", name="Profile of the configuration").select_option("tank")
    view.button("Add").click()
    plant.write("holding_registers", 4, [215, 2])
    view.button("Watch").click()
    view.says("Watching 3 parts, every 50 ms.")
    expect(tag(view, "room")).to_have_text("21.5")
    expect(tag(view, "state")).to_have_text("fault")
    expect(tag(view, "absent")).to_contain_text("Illegal Data Address")
    expect(tag(view, "level")).to_have_text("0")
    expect(view.button("Coil 2: 1, on")).to_be_visible()
    plant.write("holding_registers", 4, [220])
    expect(tag(view, "room")).to_have_text("22.0")
    plot = view.page.get_by_role("article").filter(
        has=view.page.get_by_role("heading", name="room")
    )
    expect(plot.get_by_role("status")).to_have_text("22.0 °C")
    assert len([url for url in view.requests if url.endswith("/watch/view")]) == 1
    view.check()


def test_a_view_is_read_and_watched_without_the_range_of_the_form(opened: Opened) -> None:
    view = connected(opened)
    add_tags(view, METER)
    view.choose(quantity="")
    view.button("Read").click()
    view.says("4 tags: read in")
    view.button("Watch").click()
    view.says("Watching 4 tags")


def test_a_part_is_removed_from_the_view(opened: Opened) -> None:
    view = connected(opened)
    view.choose(quantity="4", interval="50")
    view.button("Add range to view").click()
    add_tags(view, METER)
    view.button("Watch").click()
    view.says("Watching 2 parts")
    view.button("Remove Holding registers 0 to 3 from the view").click()
    view.says("Watching 4 tags, every 50 ms.")
    expect(view.row(0)).to_have_count(0)


LATE = """() => {
  const wait = window.setTimeout;
  const passed = (time) => time >= 60_000 && time < 300_000;
  window.setTimeout = (work, time, ...more) => wait(work, passed(time) ? 0 : time, ...more);
}"""
"""As if minutes had passed."""


def test_a_list_that_takes_minutes_is_read(opened: Opened) -> None:
    def slow(pdu: bytes) -> bytes:
        if pdu[2] == 1:
            asked.set()
            assert go_on.wait(wire.DEADLINE)
        return registers(pdu, 7)

    asked, go_on = threading.Event(), threading.Event()
    with FakeDevice(slow) as device:
        view = opened()
        view.connect(port=device.port)
        view.says("The device responded")
        add_tags(view, "name,area,address\nlevel,hr,1")
        view.page.evaluate(LATE)
        view.button("Read").click()
        assert asked.wait(wire.DEADLINE)
        go_on.set()
        expect(tag(view, "level")).to_have_text("7")


def test_a_list_with_errors_is_not_added(opened: Opened) -> None:
    view = connected(opened)
    view.button("Add tag list…").click()
    box = view.page.get_by_role("textbox", name="YAML or CSV")
    box.fill("name,area,address,type\na,hr,0,uint99\n")
    view.button("Add").click()
    alert = view.page.get_by_role("alert").filter(has_text="tags:2: tags.a.type")
    expect(alert).to_be_visible()
    box.fill("name,area,address,type\na,hr,0,uint16\n")
    view.button("Add").click()
    expect(view.button("Remove 1 tag from the view")).to_be_visible()


def test_lists_that_are_too_large_together_are_not_added(opened: Opened) -> None:
    view = connected(opened)
    rows = "".join(f"tag_{at},hr,{at % 200},uint16,{'x' * 25}\n" for at in range(1000))
    text = f"name,area,address,type,description\n{rows}"
    add_tags(view, text)
    view.button("Add tag list…").click()
    view.page.get_by_role("textbox", name="YAML or CSV").fill(text)
    view.button("Add").click()
    told = "The parts of a view have at most 64512 bytes together."
    expect(view.page.get_by_role("alert").filter(has_text=told)).to_be_visible()
    view.button("Cancel").click()
    view.button("Read").click()
    view.says("1000 tags: read in")


@pytest.mark.parametrize("leave", ["Cancel", "Escape"])
def test_a_list_is_not_added_after_its_dialog_was_closed(opened: Opened, leave: str) -> None:
    view = connected(opened)
    held: list[Route] = []
    view.page.route("**/api/gateway/tags", lambda route: held.append(route))
    view.button("Add tag list…").click()
    box = view.page.get_by_role("textbox", name="YAML or CSV")
    box.fill(METER)
    with view.page.expect_request("**/api/gateway/tags"):
        view.button("Add").click()
    if leave == "Cancel":
        view.button("Cancel").click()
    else:
        view.page.keyboard.press("Escape")
    expect(view.page.get_by_role("dialog")).to_be_hidden()
    with contextlib.suppress(Error):  # The page does not wait for the answer any more.
        held[0].continue_()
    view.page.unroute("**/api/gateway/tags")
    view.button("Add tag list…").click()
    expect(view.page.locator("#tags-error")).to_be_empty()
    box.fill("name,area,address,type\na,hr,0,uint16\n")
    view.button("Add").click()
    expect(view.button("Remove 1 tag from the view")).to_be_visible()
    expect(view.page.locator("#parts li")).to_have_count(1)


def test_profiles_that_can_not_be_listed_are_told(opened: Opened) -> None:
    def busy(route: Route) -> None:
        body = json.dumps({"success": False, "error": "too many requests"})
        route.fulfill(status=503, headers={"Holdfast-Reason": "busy"}, body=body)

    view = connected(opened)
    view.page.route("**/api/gateway/profiles", busy)
    view.button("Add tag list…").click()
    told = "The profiles of the configuration can't be listed: too many requests"
    expect(view.page.get_by_role("alert").filter(has_text=told)).to_be_visible()


SEPARATED = """\
tags:
  label: {area: holding_registers, address: 20, type: "string:6", encoding: utf-8}
  level: {area: holding_registers, address: 30, description: "Level\\u2028of the tank"}
"""


def with_raw_separators(route: Route) -> None:
    """As a gateway that sends these characters as they are."""
    answer = route.fetch()
    body = answer.text().replace("\\u2028", "\u2028").replace("\\u2029", "\u2029")
    route.fulfill(response=answer, body=body)


@pytest.mark.parametrize("is_raw", [False, True], ids=["escaped", "raw"])
def test_line_separators_of_unicode_stop_no_values(
    opened: Opened, plant: holdfast.Memory, is_raw: bool
) -> None:
    plant.write("holding_registers", 20, [0x41E2, 0x80A9, 0x4200])
    view = connected(opened)
    add_tags(view, SEPARATED)
    if is_raw:
        view.page.route("**/api/modbus/watch/view", with_raw_separators)
        view.button("Read").click()
        view.says("2 tags: read in")
    else:
        view.choose(interval="50")
        view.button("Watch").click()
        view.says("Watching 2 tags")
        plant.write("holding_registers", 30, [7])
    expect(tag(view, "label")).to_contain_text("A\u2029B")
    expect(tag(view, "level")).to_have_text("7" if not is_raw else "0")


def test_an_event_that_can_not_be_read_is_an_error(opened: Opened) -> None:
    def cut(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, body=answer.text().replace("data: ", "data "))

    view = connected(opened)
    view.page.route("**/api/modbus/watch/view", cut)
    view.button("Read").click()
    view.says("the gateway sent an event that can't be read")


def test_changes_without_the_view_before_them_are_not_applied(opened: Opened) -> None:
    def late(route: Route) -> None:
        values = {"part": 0, "values": [[0, 4711]]}
        data = json.dumps({"time": 1, "rtt": 1, "parts": [values]})
        kind = {"Content-Type": "text/event-stream"}
        route.fulfill(headers=kind, body=f"event: change\ndata: {data}\n\n")

    view = connected(opened)
    view.choose(address="4", quantity="1")
    view.button("Read").click()
    expect(view.row(4).get_by_role("cell").first).to_have_text("1234")
    view.page.route("**/api/modbus/watch/view", late)
    view.button("Watch").click()
    view.says("The gateway ended the watch or does not answer.")
    expect(view.row(4).get_by_role("cell").first).to_have_text("1234")


def test_a_file_is_added(opened: Opened, tmp_path: Path) -> None:
    view = connected(opened)
    view.button("Add tag list…").click()
    file = tmp_path / "meter.yaml"
    file.write_text(METER, encoding="utf-8")
    view.page.locator("#tags-file").set_input_files(file)
    expect(view.page.get_by_role("textbox", name="YAML or CSV")).to_have_value(METER)
    view.button("Add").click()
    view.button("Read").click()
    view.says("meter.yaml: read in")
    expect(tag(view, "room")).to_have_text("123.4")


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("latin.csv", "name,area,address,unit\na,hr,0,°C\n".encode("latin-1"), "not UTF-8"),
        ("wide.csv", "name,area,address\na,hr,0\n".encode("utf-16"), "not UTF-8"),
        ("binary.csv", b"a,hr,0,\0", "tags:1: the character U+0000 is not allowed in CSV"),
        ("typo.yaml", b"tagss:\n  a: {area: holding_registers, address: 0}\n", "tags:1: tagss: "),
    ],
)
def test_a_file_that_is_no_list_is_told(
    opened: Opened, tmp_path: Path, name: str, content: bytes, told: str
) -> None:
    view = connected(opened)
    view.button("Add tag list…").click()
    file = tmp_path / name
    file.write_bytes(content)
    view.page.locator("#tags-file").set_input_files(file)
    if not told.startswith("not"):
        expect(view.page.get_by_role("textbox", name="YAML or CSV")).not_to_be_empty()
        view.button("Add").click()
    expect(view.page.get_by_role("alert").filter(has_text=told)).to_be_visible()


# Writing.


def test_the_sign_of_zero_is_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = connected(opened)
    view.read_four(8, type="float32")
    review = view.page.get_by_role("textbox", name="New value")
    view.button("Write 8").click()
    review.fill("-0")
    view.button("Review").click()
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 8, 2) == [0x8000, 0]


def test_a_tag_is_written_in_its_unit(opened: Opened, plant: holdfast.Memory) -> None:
    view = connected(opened)
    add_tags(view, METER)
    view.button("Read").click()
    for text, says in (("21,5", "decimal comma"), ("301", "is outside 5.0 to 300.0")):
        view.button("Write room").click()
        view.page.get_by_role("textbox", name="New value").fill(text)
        view.button("Review").click()
        expect(view.page.get_by_role("alert").filter(has_text=says)).to_be_visible()
        expect(view.button("Write it")).to_be_hidden()
        view.button("Cancel").click()
    view.button("Write room").click()
    view.says("In °C. Allowed: from 5 to 300.")
    view.page.get_by_role("textbox", name="New value").fill("21.5")
    view.button("Review").click()
    expect(view.page.get_by_role("row", name="room 123.4 21.5")).to_be_visible()
    assert plant.read("holding_registers", 4, 1) == [1234]
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 4, 1) == [215]
    expect(tag(view, "room")).to_have_text("21.5")


def test_what_a_tag_allows_has_all_digits(opened: Opened) -> None:
    view = connected(opened)
    add_tags(view, LONG)
    view.button("Read").click()
    view.button("Write energy").click()
    view.says("In Wh. Allowed: from 9007199254740993 to 18446744073709551615.")
    view.button("Cancel").click()
    view.button("Write key").click()
    view.says("3 bytes in base64")


def test_a_tag_with_its_scale_in_a_register_offers_no_writing(opened: Opened) -> None:
    view = connected(opened)
    add_tags(view, "name,area,address,type,scale,writable\npower,hr,0,int16,factor hr 1 uint16,yes")
    view.button("Read").click()
    only = view.page.locator("tr[data-tag='power']").get_by_text("read only")
    expect(only).to_have_attribute("title", "its scale is in a register")
    expect(view.button("Plot power")).to_be_visible()
    expect(view.button("Write power")).to_have_count(0)


def test_a_review_of_a_tag_lists_its_registers(opened: Opened, plant: holdfast.Memory) -> None:
    plant.write("holding_registers", 10, [0, 0x41AC, 0x0800])
    view = connected(opened)
    add_tags(view, PLACES)
    view.button("Read").click()
    for name, text, says, rows in (
        ("flow", "222", "Writes 2 registers: 10-11.", ("flow 21.5 222", "11 16812 0x41AC 17246")),
        ("alarm", "on", "Only bit 4 is written.", ("alarm false true", "12 2048 0x0800 2064")),
        ("lamps", "[true,false]", "Writes 2 coils: 1-2.", ("1 off on", "2 on off")),
    ):
        view.button(f"Write {name}").click()
        view.page.locator("#write-value").fill(text)
        view.button("Review").click()
        dialog = view.page.get_by_role("dialog")
        expect(dialog.get_by_text(says)).to_be_visible()
        for row in rows:
            expect(dialog.get_by_role("row", name=row)).to_be_visible()
        view.button("Back").click()
        view.button("Cancel").click()
    assert plant.read("holding_registers", 10, 3) == [0, 0x41AC, 0x0800]


def test_states_and_bits_of_tags_are_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = connected(opened)
    add_tags(view, METER)
    view.button("Read").click()
    for name, text in (("state", "fault"), ("lamp", "off")):
        view.button(f"Write {name}").click()
        expect(view.page.get_by_text("Written and read back")).to_be_hidden()
        view.page.locator("#write-value").fill(text)
        view.button("Review").click()
        view.button("Write it").click()
        view.says("Written and read back")
    assert plant.read("holding_registers", 5, 1) == [2]
    assert plant.read("coils", 2, 1) == [0]


def test_a_tag_whose_definition_has_changed_is_not_written(
    opened: Opened, plant: holdfast.Memory
) -> None:
    def moved(route: Route) -> None:
        answer = route.fetch()
        found = answer.json()
        found["tag"]["address"] = 9
        route.fulfill(response=answer, json=found)

    view = connected(opened)
    add_tags(view, METER)
    view.button("Read").click()
    view.page.route("**/api/gateway/tags/value", moved)
    view.button("Write room").click()
    view.page.get_by_role("textbox", name="New value").fill("21.5")
    view.button("Review").click()
    told = view.page.get_by_role("alert").filter(has_text="another definition of room now")
    expect(told).to_be_visible()
    expect(view.button("Write it")).to_be_hidden()
    assert plant.read("holding_registers", 4, 1) == [1234]


def test_a_list_that_has_changed_is_shown_anew(opened: Opened) -> None:
    def before(route: Route) -> None:
        answer = route.fetch(post_data={**(route.request.post_data_json or {}), "once": True})
        event = answer.text().replace('"name":"level"', '"name":"former"')
        route.fulfill(response=answer, body=event.replace('"stream":false', '"stream":true'))

    view = connected(opened, profiles={"tank": TANK})
    view.page.route("**/api/modbus/watch/view", before)
    view.button("Add tag list…").click()
    view.page.get_by_role("combobox", name="Profile of the configuration").select_option("tank")
    view.button("Add").click()
    view.button("Watch").click()
    expect(tag(view, "former")).to_have_text("0")
    view.page.unroute("**/api/modbus/watch/view")
    expect(tag(view, "level")).to_have_text("0")
    expect(tag(view, "former")).to_have_count(0)


def test_a_value_is_checked_before_it_is_reviewed(
    opened: Opened, plant: holdfast.Memory, subtests: pytest.Subtests
) -> None:
    before = plant.read("holding_registers", 8, 40)
    view = connected(opened)
    cases = (
        ("float32", "21,5", "“21,5” has a decimal comma. Write 21.5 for one value"),
        ("uint16", "21,5", "has a decimal comma"),
        ("float32", "1.234,5", "“1.234,5” has a comma between digits. Write a decimal point"),
        ("float32", "1e3,5", "“1e3,5” has a comma between digits"),
        ("float32", "-1,234.5", "“-1,234.5” has a comma between digits"),
        ("float32", "1,234", "“1,234” has a comma between digits"),
        ("float32", "1 234,5", "“234,5” has a decimal comma"),
        ("uint16", "1,2,3", "“1,2,3” has a comma between digits"),
        ("float32", "1e40", "“1e40” does not fit float32"),
        ("float32", "1e-60", "is too small for float32"),
        ("float16", "65520", "does not fit float16"),
        ("float64", "1e400", "does not fit float64"),
        ("int16", "32768", "is not a valid int16"),
    )
    for address, (kind, text, says) in enumerate(cases, 8):
        with subtests.test(f"{kind} {text}"):
            view.read_four(address, type=kind)
            view.button(f"Write {address}").click()
            alert = view.page.get_by_role("alert").filter(has_text=says)
            expect(alert).to_be_hidden()
            view.page.locator("#write-as").select_option("typed")
            view.page.get_by_role("textbox", name="New value").fill(text)
            view.button("Review").click()
            expect(alert).to_be_visible()
            expect(view.button("Write it")).to_be_hidden()
            view.button("Cancel").click()
    assert plant.read("holding_registers", 8, 40) == before


def test_values_are_separated_by_semicolons(opened: Opened, plant: holdfast.Memory) -> None:
    view = connected(opened)
    view.choose(type="float16", address="8", quantity="4")
    view.button("Read").click()
    view.button("Write 8").click()
    view.page.get_by_role("textbox", name="New value").fill("65504; -0.5;1e-7")
    view.button("Review").click()
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 8, 3) == [0x7BFF, 0xB800, 0x0002]


def test_commas_that_are_clear_separate_values(opened: Opened, plant: holdfast.Memory) -> None:
    view = connected(opened)
    view.choose(type="uint16", address="8", quantity="6")
    view.button("Read").click()
    view.button("Write 8").click()
    view.page.get_by_role("textbox", name="New value").fill("0x10,0b11,5, 7, 0xF,0x1")
    view.button("Review").click()
    view.button("Write it").click()
    view.says("Written and read back")
    assert plant.read("holding_registers", 8, 6) == [16, 3, 5, 7, 15, 1]


def test_a_dialog_that_waits_says_so(opened: Opened) -> None:
    view = connected(opened)
    view.choose(type="uint16")
    view.button("Read").click()
    view.says("read in")
    held: list[Route] = []
    view.page.route("**/api/modbus/read", lambda route: held.append(route))
    view.button("Write 4").click()
    value = view.page.get_by_role("textbox", name="New value")
    value.fill("5")
    with view.page.expect_request("**/api/modbus/read"):
        view.button("Review").click()
    view.says("Reading the current value…")
    # What would be typed now is not in the review.
    expect(value).not_to_be_editable()
    expect(view.page.locator("#write-as")).to_be_disabled()
    held[0].continue_()
    view.button("Back").click()
    expect(value).to_be_editable()
    expect(view.page.locator("#write-as")).to_be_enabled()


def test_a_dialog_does_not_wait_for_the_one_before(opened: Opened) -> None:
    view = opened()
    view.page.get_by_role("spinbutton", name="Timeout").fill("60000")
    view.connect()
    view.button("Read").click()
    view.says("read in")
    view.page.route("**/api/modbus/read", lambda _: None)
    view.button("Write 4").click()
    view.page.get_by_role("textbox", name="New value").fill("5")
    view.button("Review").click()
    wait = view.page.get_by_text("Reading the current value…")
    expect(wait).to_be_visible()
    with view.page.expect_event("requestfailed"):
        view.page.keyboard.press("Escape")
    view.page.unroute("**/api/modbus/read")
    view.button("Write 5").click()
    expect(wait).to_be_hidden()
    view.page.get_by_role("textbox", name="New value").fill("6")
    view.button("Review").click()
    expect(view.page.get_by_role("row", name="5 0 0x0000 6 0x0006")).to_be_visible()


# Gaps and old values.


class Meter:
    """A device with one changing register, which can be switched off."""

    def __init__(self) -> None:
        self.value = 0
        self.is_off = False

    def __call__(self, pdu: bytes) -> Any:
        self.value += 1
        return HANG_UP if self.is_off else registers(pdu, self.value)


def watched(opened: Opened, port: int) -> View:
    """Watches the only register of a device."""
    view = opened()
    view.connect(port=port)
    view.says("The device responded")
    view.choose(type="uint16", quantity="1", interval="50")
    view.button("Watch").click()
    view.says("Watching holding registers 0 to 0")
    return view


def test_a_plot_has_a_gap_while_there_is_no_value(opened: Opened) -> None:
    meter = Meter()
    with FakeDevice(meter) as device:
        view = watched(opened, device.port)
        plot = view.page.get_by_role("article")
        expect(view.page.get_by_role("img", name="Plot of 0", exact=True)).to_be_visible()
        meter.is_off = True
        view.says("Retrying…")
        view.says("no value since")
        expect(plot).to_have_class("plot old")
        bold = "(each) => getComputedStyle(each).fontWeight"
        assert plot.get_by_role("status").evaluate(bold) == "400"
        view.says("Stale values of")
        meter.is_off = False
        expect(plot).to_have_class("plot")
        view.says("Watching holding registers 0 to 0")
        expect(view.page.get_by_role("img", name="Plot of 0, 1 gap")).to_be_visible()
        with view.page.expect_download() as found:
            view.button("Download plots as CSV").click()
        rows = saved(found.value)
        assert [row["name"] for row in rows] == ["0"] * len(rows)
        missing = [at for at, row in enumerate(rows) if row["value"] == ""]
        assert len(missing) == 1
        assert 0 < missing[0] < len(rows) - 1
        assert [row["time"] for row in rows] == sorted(row["time"] for row in rows)


def test_plots_tables_and_reviews_have_the_time_of_the_gateway(opened: Opened) -> None:
    view = connected(opened)
    ahead = "() => { const now = Date.now; Date.now = () => now() + 3 * 3_600_000; }"
    view.page.evaluate(ahead)
    view.choose(quantity="8", interval="50")
    view.button("Watch").click()
    view.button("Plot 4").click()
    expect(view.page.get_by_role("article").get_by_role("status")).to_have_text("1234")
    times = []
    for name in ("Download plots as CSV", "Download values as CSV"):
        with view.page.expect_download() as found:
            view.button(name).click()
        times.append(datetime.fromisoformat(saved(found.value)[-1]["time"]))
    assert abs(times[1] - times[0]) < timedelta(hours=1)
    hours = "() => [0, 1].map((each) => new Date(Date.now() - 3_600_000 * (3 - each)).getHours())"
    around = view.page.evaluate(hours)
    for name in ("Write 4", "Write room"):
        if name == "Write room":
            add_tags(view, METER)
        view.button(name).click()
        view.page.get_by_role("textbox", name="New value").fill("21")
        view.button("Review").click()
        told = view.page.get_by_text("The current value was read at").inner_text()
        view.button("Back").click()
        view.button("Cancel").click()
        assert int(told.rpartition(" ")[2][:2]) in around


def test_a_plot_keeps_its_order_when_the_clock_is_set_back(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    meter = Meter()
    with FakeDevice(meter) as device:
        view = watched(opened, device.port)
        status = view.page.get_by_role("article").get_by_role("status")
        expect(status).to_have_text(re.compile(r"\d"))
        set_back = SimpleNamespace(time=lambda: time.time() - 3600, perf_counter=time.perf_counter)
        monkeypatch.setattr(views, "time", set_back)
        meter.value = 1000
        expect(status).to_have_text(re.compile(r"\d{4}"))
        with view.page.expect_download() as found:
            view.button("Download plots as CSV").click()
        rows = saved(found.value)
        values = [int(row["value"]) for row in rows]
        assert values[0] < 1000 < values[-1]
        assert values == sorted(values)


STRANGE_CLOCKS = """() => {
  const [now, began] = [performance.now.bind(performance), Date.now()];
  performance.now = () => 1000 * now();
  Date.now = () => began - 3_600_000;
}"""
"""One goes fast, so that no test has to wait; the other one was set back, and stands still."""


def test_values_are_old_without_news_also_when_the_clock_is_set_back(opened: Opened) -> None:
    def answer(pdu: bytes) -> bytes | None:
        return None if is_silent else registers(pdu)

    is_silent = False
    with FakeDevice(answer) as device:
        view = opened()
        view.page.get_by_role("spinbutton", name="Timeout").fill("60000")
        view.connect(port=device.port)
        view.says("The device responded")
        view.button("Watch").click()
        view.says("Watching holding registers 0 to 9")
        is_silent = True
        view.page.evaluate(STRANGE_CLOCKS)
        view.says("No news from the gateway.")


def test_a_plot_of_an_invalid_value_has_a_gap(opened: Opened, plant: holdfast.Memory) -> None:
    plant.write("holding_registers", 0, [0x1234])
    view = connected(opened)
    view.choose(type="bcd16", quantity="1", interval="50")
    view.button("Watch").click()
    view.says("Watching")
    view.button("Plot 0").click()
    plot = view.page.get_by_role("article")
    expect(plot.get_by_role("status")).to_have_text("1234")
    plant.write("holding_registers", 0, [0x12AB])
    view.says("no value since")
    plant.write("holding_registers", 0, [0x0042])
    expect(plot.get_by_role("status")).to_have_text("42")
    expect(view.page.get_by_role("img", name="Plot of 0, 1 gap")).to_be_visible()


HOUR = """
async () => {
  const { History } = await import("/console/history.js");
  const history = new History();
  for (let at = 0; at < 40000; at += 1) history.take(at / 10, at === 20000 ? 1e6 : at % 100);
  const before = history.times.length;
  history.gap();
  history.take(4100, 7);
  const [times, values] = history.points();
  const most = Math.max(...values);
  return { before, first: times[0], last: times.at(-1), most, gaps: history.gaps() };
}
"""


def test_an_hour_is_kept_with_its_extremes(opened: Opened) -> None:
    found = opened().page.evaluate(HOUR)
    assert found["before"] < 12_000
    assert found["first"] <= 400
    assert (found["last"], found["most"]) == (4100, 1e6)
    assert found["gaps"] == [[pytest.approx(3999.901), 4100]]


# Many tabs.


def test_more_tabs_than_connections_watch_and_write(opened: Opened, plant: holdfast.Memory) -> None:
    view = connected(opened)
    view.choose(type="uint16", address="4", quantity="2", interval="100")
    view.button("Watch").click()
    view.says("Watching")
    link = view.page.url
    pages: list[Page] = [view.page]
    for _ in range(WATCHES - 1):
        page = view.page.context.new_page()
        page.goto(link)
        expect(page.get_by_text("Watching holding registers 4 to 5")).to_be_visible()
        pages.append(page)
    last = pages[-1]
    expect(last.get_by_text("Other tabs use the streams")).to_be_visible()
    last.get_by_role("button", name="Write 4", exact=True).click()
    last.get_by_role("textbox", name="New value").fill("4711")
    last.get_by_role("button", name="Review", exact=True).click()
    last.get_by_role("button", name="Write it", exact=True).click()
    expect(last.get_by_text("Written. The watch continues.")).to_be_visible()
    assert plant.read("holding_registers", 4, 1) == [4711]
    for page in pages:
        cell = page.locator("tr[data-address='4'] td").first
        expect(cell).to_have_text("4711")
        expect(page.get_by_role("button", name="Remove the plot of 4")).to_be_visible()
    for page in pages[1:-1]:
        page.close()
    expect(last.get_by_text("Other tabs use the streams")).to_be_hidden()
    expect(last.get_by_text("Watching holding registers 4 to 5")).to_be_visible()


# The link.


def test_the_whole_view_is_in_the_link(opened: Opened) -> None:
    view = connected(opened)
    view.choose(area="4", address="1000", quantity="4", type="bit", size="3", interval="150")
    view.button("Add range to view").click()
    add_tags(view, METER)
    view.button("Watch").click()
    view.says("Watching 2 parts, every 150 ms.")
    expect(view.page).to_have_url(re.compile("watch=1"))
    view.page.evaluate("delete window.CompressionStream")  # The tags are in the link already.
    view.button("Plot room").click()
    view.page.get_by_role("combobox", name="Time span").select_option("3600")
    expect(view.button("Remove the plot of room")).to_be_visible()
    view.page.reload()
    view.says("Watching 2 parts, every 150 ms.")
    expect(view.button("Remove the plot of room")).to_be_visible()
    expect(view.page.get_by_role("combobox", name="Time span")).to_have_value("3600")
    expect(view.page.get_by_role("combobox", name="Area")).to_have_value("4")
    expect(view.page.locator("#size")).to_have_value("3")
    expect(view.page.locator("tr[data-address='1000'] .typed")).to_have_text("false")
    expect(tag(view, "room")).to_have_text("123.4")
    view.button("Stop").click()
    view.page.reload()
    expect(view.page.get_by_text("The device responded")).to_be_hidden()
    view.button("Connect").click()
    view.says("The device responded")
    expect(view.page.locator("#size")).to_have_value("3")
    expect(view.button("Remove 4 tags from the view")).to_be_visible()
    expect(view.button("Watch")).to_have_attribute("aria-pressed", "false")


def test_a_page_that_was_watching_waits_for_its_device(opened: Opened) -> None:
    meter = Meter()
    with FakeDevice(meter) as device:
        view = watched(opened, device.port)
        meter.is_off = True
        view.page.reload()
        view.says("The device closed the connection.")
        view.says("Retrying…")
        view.page.route("**/watch/view", lambda route: route.abort(), times=1)
        meter.is_off = False
        view.says("The gateway ended the watch or does not answer. The watch resumes")
        view.says("Watching holding registers 0 to 0")


def test_a_damaged_link_is_told(opened: Opened) -> None:
    view = opened()
    view.page.goto(
        f"{view.gateway.url}/?again#part=yaml,x,AAAA&part=3,65530,10,uint16,ABCD&part=3,0,4,wide"
    )
    view.connect()
    view.says("The device responded")
    view.says("A part of the link can't be used: the tag list “x” is damaged")
    view.says("A part of the link can't be used: “3,65530,10,uint16,ABCD” is not a range.")
    view.says("A part of the link can't be used: “3,0,4,wide” is not a range.")
    expect(view.page).to_have_url(re.compile("part=yaml"))
    expect(view.page.locator("#parts li")).to_have_count(0)
    view.button("Read").click()
    view.says("Holding registers 0 to 9: read in")


@pytest.mark.parametrize(
    ("damaged", "says"),
    [
        ("part=yaml,tank,K0lML7bi", "the tag list “tank” is damaged"),
        ("part=4,1000,2,uint16,ABCD&part=9,0,2,uint16&plot=1.0", "“9,0,2,uint16” is not a range"),
        ("area=7", "area is “7”"),
        ("type=int", "type is “int”"),
        ("quantity=-5", "quantity is “-5”"),
        ("address=4OO", "address is “4OO”"),
        ("part=4,1000,2,uint16,ABCD&interval=abc", "interval is “abc”"),
        ("part=4,1000,2,constructor,ABCD", "“4,1000,2,constructor,ABCD” is not a range"),
        ("part=1,0,10,float32,ABCD", "“1,0,10,float32,ABCD” is not a range"),
    ],
)
def test_what_is_left_of_a_damaged_link_is_not_watched(
    opened: Opened, damaged: str, says: str
) -> None:
    view = opened()
    link = f"{view.gateway.url}/?again#host=127.0.0.1&port={view.port}&watch=1&{damaged}"
    view.page.goto(link)
    view.says(f"A part of the link can't be used: {says}")
    view.says("The device responded")
    view.button("Connect").click()
    view.says("The device responded")
    view.says(f"A part of the link can't be used: {says}")
    expect(view.button("Watch")).to_have_attribute("aria-pressed", "false")
    assert not [url for url in view.requests if url.endswith("/watch/view")]
    view.choose(area="4", address="1000", quantity="2", type="uint16", interval="100")
    view.button("Watch").click()
    view.says("Watching ")
    expect(view.page).not_to_have_url(re.compile("plot="))


@pytest.mark.parametrize(
    ("damaged", "says"),
    [
        ("unit=300", "unit is “300”"),
        ("unit=", "unit is “”"),
        ("port=65536", "port is “65536”"),
        ("timeout=0", "timeout is “0”"),
        ("transport=rtu", "transport is “rtu”"),
        ("host=", "host is “”"),
        ("unti=5", "“unti” is unknown"),
        ("unit=5&unit=6", "unit is given more than once"),
    ],
)
def test_a_damaged_device_of_a_link_is_not_connected_to(
    opened: Opened, damaged: str, says: str
) -> None:
    view = opened()
    name = damaged.partition("=")[0]
    whole = {"host": "127.0.0.1", "port": str(view.port), "area": "3", "watch": "1"}
    link = urlencode({key: value for key, value in whole.items() if key != name})
    view.requests.clear()
    view.page.goto(f"{view.gateway.url}/?again#{link}&{damaged}")
    view.says(f"A part of the link can't be used: {says}. Nothing is watched by itself.")
    assert not [url for url in view.requests if url.endswith("/connect")]
    view.page.get_by_role("spinbutton", name="Unit id").fill("1")
    view.page.get_by_role("spinbutton", name="Timeout").fill("2000")
    view.connect()
    view.says("The device responded")
    expect(view.button("Watch")).to_have_attribute("aria-pressed", "false")
    view.choose(quantity="2")
    expect(view.page).to_have_url(re.compile("quantity=2"))
    expect(view.page).not_to_have_url(re.compile("unti"))
    view.page.reload()
    view.button("Connect").click()
    view.says("The device responded")
    expect(view.page.get_by_text("A part of the link can't be used")).to_be_hidden()


def test_the_link_to_the_values_leaves_that_of_the_page(opened: Opened) -> None:
    view = connected(opened)
    link = view.page.url
    view.page.get_by_role("link", name="Skip to values").press("Enter")
    expect(view.page.locator("#work")).to_be_focused()
    expect(view.page).to_have_url(link)


def test_another_link_is_opened_in_the_same_tab(opened: Opened) -> None:
    view = connected(opened)
    device = f"host=127.0.0.1&port={view.port}"
    view.page.goto(f"{view.gateway.url}/#{device}&area=4&address=1000&quantity=2&watch=1")
    view.says("Watching input registers 1000 to 1001")
    expect(view.page).to_have_url(re.compile("area=4&address=1000"))


# Downloads.


def test_what_is_shown_is_downloaded(opened: Opened, plant: holdfast.Memory) -> None:
    plant.write("holding_registers", 0, floats(21.5, float("-inf")))
    plant.write("holding_registers", 8, [0x3D31, 0])  # "=1"
    view = connected(opened)
    view.choose(type="float32", quantity="4")
    view.button("Add range to view").click()
    view.choose(address="8", quantity="1", type="string", size="2")
    view.button("Add range to view").click()
    add_tags(view, f"{METER}  ratio: {{area: holding_registers, address: 4, unit: '-'}}")
    view.button("Read").click()
    view.says("3 of 3 parts: read in")
    with view.page.expect_download() as found:
        view.button("Download values as CSV").click()
    rows = saved(found.value)
    shown = [(row["name"], row["address"], row["value"], row["unit"], row["state"]) for row in rows]
    assert shown[:2] == [("", "0", "21.5", "", "current"), ("", "2", "-inf", "", "current")]
    assert ("", "8", "'=1", "", "current") in shown
    assert ("room", "4", "123.4", "°C", "current") in shown
    assert ("ratio", "4", "1234", "-", "current") in shown
    assert "Illegal Data Address" in rows[-2]["error"]
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:.]+Z", row["time"]) for row in rows)


def test_downloaded_plots_have_all_digits(opened: Opened, plant: holdfast.Memory) -> None:
    plant.write("holding_registers", 20, [0x20, 0, 0, 1])
    view = connected(opened)
    add_tags(view, LONG)
    view.choose(interval="50")
    view.button("Read").click()
    view.button("Plot energy").click()
    plot = view.page.get_by_role("article")
    expect(plot.get_by_role("status")).to_have_text("9007199254740993 Wh")
    expect(plot.get_by_text("9.0072e+15 … 9.0072e+15")).to_be_visible()
    plant.write("holding_registers", 23, [0])  # The same as a float.
    expect(plot.get_by_role("status")).to_have_text("9007199254740992 Wh")
    view.button("Stop").click()
    with view.page.expect_download() as found:
        view.button("Download plots as CSV").click()
    assert {row["value"] for row in saved(found.value)} == {"9007199254740993", "9007199254740992"}


def test_stopped_plots_are_downloaded_later(opened: Opened) -> None:
    meter = Meter()
    with FakeDevice(meter) as device:
        view = watched(opened, device.port)
        expect(view.page.get_by_role("article").get_by_text("…")).to_be_visible()
        view.button("Stop").click()
        view.page.evaluate("() => { const now = Date.now; Date.now = () => now() + 3_600_000; }")
        with view.page.expect_download() as found:
            view.button("Download plots as CSV").click()
        assert len(saved(found.value)) > 1


def test_coils_that_were_never_read_have_no_value_in_a_download(opened: Opened) -> None:
    view = connected(opened)
    view.choose(area="1", address="1000", quantity="2")
    view.button("Add range to view").click()
    view.choose(area="3", address="0")
    view.button("Add range to view").click()
    view.button("Read").click()
    view.says("1 of 2 parts: read in")
    with view.page.expect_download() as found:
        view.button("Download values as CSV").click()
    coils = [row for row in saved(found.value) if row["area"] == "coils"]
    assert [row["value"] for row in coils] == ["", ""]
    assert "Illegal Data Address" in coils[0]["error"]


# Narrow screens.


@pytest.mark.parametrize("area", ["1", "3"])
def test_nothing_is_cut_at_320_pixels(opened: Opened, area: str) -> None:
    view = connected(opened, NARROW)
    view.choose(area=area, quantity="40", interval="50")
    view.button("Watch").click()
    view.says("Watching")
    view.page.get_by_role("tab", name="Map").click()
    view.button("Map device").click()
    view.says("Done in")
    view.check()
    view.page.get_by_role("tab", name="Values").click()
    assert view.page.evaluate(CLIPPED) == []
    assert view.page.evaluate(SMALL) == []


CLIPPED = """
[...document.querySelectorAll("button, input, select, h1, h3, p, label, td, th, output")]
  .filter((each) => each.checkVisibility() && !each.closest(".unseen, .skip"))
  .filter((each) => {
    const box = each.getBoundingClientRect();
    return box.width > 0 && (box.left < -1 || box.right > innerWidth + 1);
  }).map((each) => each.outerHTML.slice(0, 100))
"""
SMALL = """
[...document.querySelectorAll(".bit")].filter((each) => {
  const box = each.getBoundingClientRect();
  return box.width < 24 || box.height < 24;
}).map((each) => each.outerHTML)
"""
"""Bits that are smaller than a target may be."""


# The map.


def test_a_map_tells_absent_from_not_asked_and_zooms(opened: Opened) -> None:
    view = connected(opened)
    view.page.get_by_role("tab", name="Map").click()
    view.button("Map device").click()
    view.says("Done in")
    picture = view.page.get_by_role("article").filter(has_text="Holding registers")
    name = re.compile("300 addresses in 1 ranges, [0-9,]+ asked and absent, [0-9,]+ not asked")
    canvas = picture.get_by_role("img", name=name)
    expect(canvas).to_be_visible()
    expect(picture.get_by_text("64 addresses per cell")).to_be_visible()
    canvas.click(position={"x": 2, "y": 2})
    expect(picture.get_by_text("8 addresses per cell")).to_be_visible()
    expect(picture.locator(".scale")).to_contain_text("8191")
    view.button("Higher addresses: holding registers").click()
    expect(picture.locator(".scale")).to_contain_text("4096")
    view.button("Lower addresses: holding registers").click()
    canvas.click(position={"x": 2, "y": 2})
    expect(picture.get_by_text("1 address per cell")).to_be_visible()
    canvas.hover(position={"x": 2, "y": 2})
    expect(canvas).to_have_attribute("title", "0: 1 valid, 0 absent, 0 not asked")
    for _ in range(2):
        view.button("Zoom out: holding registers").click()
    expect(picture.locator(".scale")).to_contain_text("65535")


def test_a_map_whose_gateway_ends_says_so(opened: Opened) -> None:
    area = {"area": "coils", "addresses": 8, "ranges": [[0, 7]], "notSearchedFrom": 64}
    progress = {"at": 64, "total": 65536, "requests": 1, "areas": [area]}
    body = f"event: progress\ndata: {json.dumps(progress)}\n\n"
    view = connected(opened)
    view.page.get_by_role("tab", name="Map").click()
    for name in ("Discrete inputs", "Holding registers", "Input registers"):
        view.page.get_by_role("checkbox", name=name).uncheck()
    view.page.route(
        "**/api/modbus/map",
        lambda route: route.fulfill(content_type="text/event-stream", body=body),
    )
    view.button("Map device").click()
    view.says("The gateway does not answer.")
    view.says("Not searched: coils from 64.")
    expect(view.button("Read coils 0–7")).to_be_visible()
    expect(view.button("Map device")).to_be_visible()


def test_the_last_address_of_a_map_is_not_below_the_first(opened: Opened) -> None:
    view = connected(opened)
    view.page.get_by_role("tab", name="Map").click()
    view.page.get_by_role("spinbutton", name="First address").fill("2000")
    last = view.page.get_by_role("spinbutton", name="Last address")
    last.fill("100")
    view.button("Map device").click()
    expect(last).to_be_focused()
    told = last.evaluate("(each) => each.validationMessage")
    assert told == "The last address is below the first one, 2000."
    last.fill("2100")
    view.button("Map device").click()
    view.says("Done in")
