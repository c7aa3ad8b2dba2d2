"""The gateway's console as people use it, in a real browser, on a desk and on a phone."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, Literal

import pytest
from playwright.sync_api import expect

import gateway_pages
from fake_device import FakeDevice
from gateway_pages import DESK, PHONE, Opened, browsing, floats, opening

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser

    import holdfast

HARMFUL = "<img src=x onerror=alert(1)>"
SECRET = "correct-horse-battery-staple"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing() as launched:
        yield launched


@pytest.fixture
def plant() -> holdfast.Memory:
    return gateway_pages.plant()


@pytest.fixture
def opened(browser: Browser, plant: holdfast.Memory) -> Iterator[Opened]:
    with opening(browser, plant, model=HARMFUL) as pages:
        yield pages


both = pytest.mark.parametrize(
    ("size", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk-light", "phone-dark"]
)


@both
def test_a_device_is_connected_to_and_read(
    opened: Opened, size: Any, scheme: Literal["light", "dark"]
) -> None:
    view = opened(size, scheme)
    view.connect()
    view.says("The device answers")
    view.says("Acme")
    view.says(HARMFUL)
    view.choose(quantity="8")
    view.button("Read").click()
    view.says("Holding registers 0 to 7: read in")
    cells = [
        [text.strip() for text in view.row(address).get_by_role("cell").all_inner_texts()[:4]]
        for address in (0, 1, 4)
    ]
    assert cells[0] == ["16812", "41AC", "0100 0001 1010 1100", "21.5"]
    assert cells[1][:3] == ["0", "0000", "0000 0000 0000 0000"]
    assert cells[2][:2] == ["1234", "04D2"]


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
    assert plant.read("holding_registers", 4, 1) == [1234], "not before it is confirmed"
    view.button("Write it").click()
    view.says("Written, and read back")
    assert plant.read("holding_registers", 4, 1) == [1237]
    expect(view.row(4).get_by_role("cell").first).to_have_text("1237")


def test_typed_values_are_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(order="CDAB")
    view.button("Read").click()
    view.button("Write 8").click()
    view.page.get_by_role("textbox", name="New value").fill("21.5, -1")
    view.button("Review").click()
    expect(view.page.get_by_role("row", name="10 0 -1")).to_be_visible()
    view.button("Write it").click()
    view.says("Written, and read back")
    assert plant.read("holding_registers", 8, 4) == [0, 0x41AC, 0, 0xBF80]


def test_a_coil_is_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(area="1", quantity="20")
    view.button("Read").click()
    view.button("1 is off").click()
    view.page.get_by_role("textbox", name="New value").fill("on")
    view.button("Review").click()
    expect(view.page.get_by_role("row", name="1 off on")).to_be_visible()
    view.button("Write it").click()
    expect(view.button("1 is on")).to_be_visible()
    assert plant.read("coils", 0, 3) == [1, 1, 1]


def test_a_value_that_is_none_is_not_written(opened: Opened, plant: holdfast.Memory) -> None:
    view = opened()
    view.connect()
    view.choose(type="uint16")
    view.button("Read").click()
    view.button("Write 4").click()
    for text, says in (("70000", "is no register"), ("1, x", "is no register")):
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
    view.choose(quantity="4", interval="50")
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
    view = opened()
    with FakeDevice(lambda _: None) as mute:
        view.page.get_by_role("spinbutton", name="Timeout").fill("50")
        view.connect(port=mute.port)
        view.says("No answer in time.")
        view.says("Is the unit id right?")
        port = mute.port
    view.connect(port=port)
    view.says("it takes no connection")
    view.connect(host="no-such-name.invalid")
    view.says("Nobody knows this name.")


def test_a_refused_target_is_told_in_plain_words(opened: Opened) -> None:
    view = opened(allow=["10.0.0.0/8"])
    view.connect()
    view.says("This gateway may not connect there.")
    view.says("--allow")


def test_an_address_that_is_not_there_is_told_in_plain_words(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.choose(address="5000")
    view.button("Read").click()
    view.says("The device has no such address.")
    view.says("this page counts from 0")


def test_a_gateway_that_only_reads_offers_no_writing(opened: Opened) -> None:
    view = opened(writes=False)
    view.says("reads only")
    view.connect()
    view.button("Read").click()
    view.says("This gateway only reads")
    expect(view.button("Plot 0")).to_be_visible()
    expect(view.button("Write 0")).to_have_count(0)


def test_a_token_is_asked_for_and_kept_in_the_tab_only(opened: Opened) -> None:
    view = opened(tokens=(("edge", hashlib.sha256(SECRET.encode()).digest()),))
    box = view.page.get_by_label("Token", exact=True)
    box.fill("wrong")
    view.page.keyboard.press("Enter")
    view.says("The gateway does not know this token.")
    box.fill(SECRET)
    view.page.keyboard.press("Enter")
    view.says("reads and writes")
    view.connect()
    view.says("The device answers")
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


def test_a_device_is_part_of_the_address_of_the_page(opened: Opened) -> None:
    view = opened()
    view.connect()
    view.says("The device answers")
    view.page.reload()
    expect(view.page.get_by_role("spinbutton", name="Port")).to_have_value(str(view.port))
    assert view.page.get_by_role("textbox", name="Device").input_value() == "127.0.0.1"


def test_the_keyboard_is_enough(opened: Opened) -> None:
    view = opened()
    keyboard = view.page.keyboard
    view.page.get_by_role("textbox", name="Device").focus()
    keyboard.type("127.0.0.1")
    keyboard.press("Tab")
    keyboard.press("Control+a")
    keyboard.type(str(view.port))
    keyboard.press("Enter")
    view.says("The device answers")
    view.page.get_by_role("tab", name="Values").focus()
    keyboard.press("ArrowRight")
    expect(view.page.get_by_role("tab", name="Map")).to_be_focused()
    expect(view.button("Map device")).to_be_visible()
    keyboard.press("ArrowRight")
    view.page.get_by_role("spinbutton", name="How many").focus()
    keyboard.press("Enter")
    view.says("read in")
    view.button("Write 0").focus()
    keyboard.press("Enter")
    expect(view.page.get_by_role("textbox", name="New value")).to_be_focused()
    keyboard.press("Escape")
    expect(view.button("Write 0")).to_be_focused()


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
