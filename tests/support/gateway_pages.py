"""Pages of the gateway's console in a browser, at desktop and phone sizes."""

from __future__ import annotations

import contextlib
import re
import shutil
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from playwright.sync_api import expect, sync_playwright

import holdfast
from holdfast.server import Identity
from support import gateways, wire
from support.machine import tool

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, ConsoleMessage, Error, Locator, Page, Request

PHONE: Any = {"viewport": {"width": 360, "height": 740}, "has_touch": True}
NO_NETWORK = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
"""Chromium asks its maker's servers for updates and accounts; now it finds none of them."""

DESK: Any = {"viewport": {"width": 1100, "height": 820}}


@dataclass
class View:
    """A page of the console. Records errors and requests to other hosts."""

    page: Page
    gateway: gateways.Running
    port: int
    memory: holdfast.Memory
    requests: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.on("request", self._requested)
        self.page.on("pageerror", self._failed)
        self.page.on("console", self._said)

    def close(self) -> None:
        """Ends the recording, so that the page can be used again."""
        self.page.remove_listener("request", self._requested)
        self.page.remove_listener("pageerror", self._failed)
        self.page.remove_listener("console", self._said)

    def _requested(self, request: Request) -> None:
        self.requests.append(request.url)

    def _failed(self, error: Error) -> None:
        self.errors.append(str(error))

    def _said(self, message: ConsoleMessage) -> None:
        # The browser logs every refusal of the gateway as such an error.
        is_refusal = message.text.startswith("Failed to load resource")
        if message.type in ("error", "warning") and not is_refusal:
            self.errors.append(message.text)

    def check(self) -> None:
        """Checks for errors, requests to other hosts, and horizontal overflow."""
        assert self.errors == []
        assert [url for url in self.requests if not url.startswith(f"{self.gateway.url}/")] == []
        width = self.page.evaluate("document.documentElement.scrollWidth")
        assert width <= self.page.viewport_size["width"]  # type: ignore[index]

    def open(self, fragment: str = "") -> View:
        self.page.goto(f"{self.gateway.url}/{fragment}")
        return self

    def button(self, name: str) -> Locator:
        return self.page.get_by_role("button", name=name, exact=True)

    def says(self, text: str | re.Pattern[str]) -> None:
        self.page.get_by_text(text).wait_for()  # It looks more often than `expect`.

    def connect(self, host: str = "127.0.0.1", port: int | None = None) -> None:
        self.page.get_by_role("textbox", name="Device").fill(host)
        self.page.get_by_role("spinbutton", name="Port").fill(str(port or self.port))
        self.button("Connect").click()

    def choose(self, **fields: str) -> None:
        """Fills in the form of a read."""
        for name, value in fields.items():
            place = self.page.locator(f"#{name}")
            if name in ("area", "type", "order"):
                place.select_option(value)
            else:
                place.fill(value)

    def read_four(self, address: int, **fields: str) -> None:
        """Reads holding registers from another address than the one that is shown."""
        self.choose(address=str(address), quantity="4", **fields)
        self.button("Read").click()
        # A multiple of the size of the type: not always four.
        self.says(re.compile(rf"Holding registers {address} to \d+: read in"))

    def row(self, address: int) -> Locator:
        """Returns the row of a register."""
        return self.page.locator(f"tr[data-address='{address}']")


def floats(*values: float) -> list[int]:
    data = struct.pack(f">{len(values)}f", *values)
    return list(struct.unpack(f">{2 * len(values)}H", data))


def plant() -> holdfast.Memory:
    """Creates a memory with values in all areas."""
    memory = holdfast.Memory(
        coils=48,
        discrete_inputs=(100, 20),
        holding_registers=(0, 300),
        input_registers=(1000, 64),
    )
    memory.write("holding_registers", 0, [*floats(21.5, 1.013), 1234, 0, 65535, 42])
    memory.write("coils", 0, [1, 0, 1])
    return memory


class Pages:
    """Pages for one test after the other: a new window takes half a second of processor time."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._free: dict[str, list[Page]] = {}

    def take(self, size: Any) -> Page:
        """Returns an empty page."""
        if free := self._free.get(repr(size)):
            return free.pop()
        context = self._browser.new_context(**size)
        context.set_default_timeout(1000 * wire.DEADLINE)
        return context.new_page()

    def give_back(self, size: Any, page: Page) -> None:
        """Empties a page that `take` has returned, and closes those that it has opened."""
        for other in page.context.pages:
            if other != page:
                other.close()
        page.unroute_all()
        page.evaluate("sessionStorage.clear()")
        page.goto("about:blank")
        self._free.setdefault(repr(size), []).append(page)


@dataclass
class Opened:
    """Opens the console of a gateway with some settings."""

    pages: Pages
    plant: holdfast.Memory
    port: int
    views: list[tuple[View, Any, Any]] = field(default_factory=list)

    def __call__(
        self, size: Any = DESK, scheme: Literal["light", "dark"] = "light", **settings: Any
    ) -> View:
        running = gateways.running(**{"limits": {"interval": 0.05}, **settings})
        gateway = running.__enter__()
        page = self.pages.take(size)
        page.emulate_media(color_scheme=scheme, reduced_motion="no-preference")
        view = View(page, gateway, self.port, self.plant)
        self.views.append((view, size, running))
        return view.open()

    def close(self) -> None:
        for view, size, running in self.views:
            try:
                view.check()
            finally:
                view.close()
                self.pages.give_back(size, view.page)
                running.__exit__(None, None, None)


@contextlib.contextmanager
def browsing() -> Iterator[Browser]:
    """A browser."""
    # Before Playwright, which requires libraries that come with it.
    chromium = shutil.which("chromium-headless-shell") or tool("chromium")
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", NO_NETWORK]
        )
        yield launched
        launched.close()


@contextlib.contextmanager
def opening(pages: Pages, memory: holdfast.Memory, model: str) -> Iterator[Opened]:
    """Opens pages, with a device that has this memory and this model name."""
    expect.set_options(timeout=1000 * wire.DEADLINE)
    identity = Identity(vendor_name="Acme", product_code="F7", revision="2.1", model_name=model)
    with holdfast.Server(
        {1: memory}, bind="127.0.0.1:0", access="read-write", identity=identity
    ) as server:
        opened = Opened(pages, memory, server.address[1])
        try:
            yield opened
        finally:
            opened.close()
