"""What the examples of a page need: a folder, and servers in place of those of the text."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import threading
from typing import TYPE_CHECKING, Any

from holdfast.appliance import Appliance
from holdfast.config import load
from support.cli import ServingCommand
from support.commands import write_script

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


class Stage(contextlib.ExitStack):
    """The folder of a page, which is the current one, and what was started in it.

    Every port after `127.0.0.1:` or `localhost:` stands for a port that the system picked: the same
    one everywhere on the page.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        self.replaced: dict[str, str] = {}
        """What stands in place of words of the text."""
        self.names: dict[str, Any] = {}
        """The names of the Python examples."""
        self.served: set[str] = set()
        """The addresses at which a command of the page serves."""
        self.output = ""
        """What the commands of the last block printed."""
        self.environment = {**os.environ, "NO_COLOR": "1"}
        self.before: Callable[[str], None] = lambda _: None
        """Is called with the text of each block before it is run."""

    def port(self, shown: str) -> int:
        """The port that stands for one of the text.

        A socket that does not listen holds it, so that no outgoing connection gets it meanwhile.
        """
        if shown not in self.replaced:
            held = self.enter_context(socket.socket())
            held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            held.bind(("127.0.0.1", 0))
            self.replaced[shown] = str(held.getsockname()[1])
        return int(self.replaced[shown])

    def keep(self, port: int) -> int:
        """Leaves a port of this machine as it is."""
        self.replaced[str(port)] = str(port)
        return port

    def here(self, text: str) -> str:
        """The text, with addresses of this machine."""
        for shown in re.findall(r"\b(?:127\.0\.0\.1|localhost):(\d{3,5})\b", text):
            if shown not in self.replaced.values():
                self.port(shown)
        return _exchanged(text, self.replaced)

    def there(self, text: str) -> str:
        """The text, with the addresses of the page."""
        return _exchanged(text, {own: shown for shown, own in self.replaced.items()})

    def file(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.write_text(text)
        return path

    def appliance(self, text: str) -> Appliance:
        """Runs an appliance until the page ends."""
        return self.enter_context(Appliance(load(self.file("stage.yaml", self.here(text)))))

    def serve(self, *arguments: str) -> ServingCommand:
        """Starts a command that serves until the page ends."""
        command = ServingCommand(*arguments)
        self.callback(command.process.communicate)
        self.callback(command.process.kill)
        command.wait_for_greeting()
        return command

    def repeat(self, work: Callable[[], None]) -> None:
        """Does something again and again until the page ends."""
        stop = threading.Event()

        def repeated() -> None:
            while not stop.wait(0.02):
                work()

        thread = threading.Thread(target=repeated)
        thread.start()
        self.callback(thread.join)
        self.callback(stop.set)

    def program(self) -> None:
        """Puts `holdfast` into the `PATH` of the commands, and into `.venv/bin`."""
        programs = self.folder / ".venv" / "bin"
        programs.mkdir(parents=True)
        write_script(programs / "holdfast")
        self.environment["PATH"] = f"{programs}{os.pathsep}{os.environ['PATH']}"


def _exchanged(text: str, words: dict[str, str]) -> str:
    if not words:
        return text
    longest_first = sorted(words, key=len, reverse=True)
    either = "|".join(map(re.escape, longest_first))
    return re.sub(rf"(?<![\w.])(?:{either})(?!\w)", lambda match: words[match[0]], text)
