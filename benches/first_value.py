"""Measures what a new user does, waits for and downloads until the first value.

Two ways: `make run` in a fresh clone, and the wheel of `dist` in an empty environment. Each has a
fresh home, so the caches of pip and cargo are empty; Rust, a C compiler and a broker are there.
The commands are typed into shells as README.md and docs/home-assistant.md have them, but for the
ports, which the system picks. Times are those of the commands: nobody reads or types.

Home Assistant is not run: reached is the moment at which a broker has what it reads, a retained
discovery message with a device, and for its entity a value and that it is available.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from common import ROOT, Result, TurnFailed
from mqtt_output import broker, until
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

if TYPE_CHECKING:
    from collections.abc import Callable

SERVES = "Ctrl-C stops it."
"""The last line that a command prints before it serves."""
END = "--- exit code"
DOWNLOADS = ("holdfast/.git", "home/.cargo/registry/cache", "home/.cargo/registry/index")
DOWNLOADING = re.compile(r"Downloading \S+ \(([0-9.]+) (kB|MB)\)")
"""What pip prints."""
UNITS = {"kB": 1e3, "MB": 1e6}
PLANT = """\
profiles: [{tags}]
devices:
  heater: {{url: "tcp://{device}", profile: {profile}, interval: 1}}
outputs:
  home: {{type: mqtt, url: "mqtt://127.0.0.1:{port}", discovery: homeassistant}}
"""


class Newcomer:
    """Types commands into shells, each of which is a terminal."""

    def __init__(self, folder: Path, running: ExitStack) -> None:
        self.folder, self._running = folder, running
        home = folder / "home"
        home.mkdir()
        kept = ("PATH", "LANG", "RUSTUP_HOME", "SSL_CERT_FILE")
        pip = {key: value for key, value in os.environ.items() if key.startswith("PIP_")}
        self._environment = {key: os.environ[key] for key in kept if key in os.environ} | pip
        self._environment |= {"HOME": str(home), "PIP_VERBOSE": "1"}
        self._environment.setdefault("RUSTUP_HOME", str(Path.home() / ".rustup"))
        self.commands, self.downloaded = 0, 0.0
        self.results: dict[str, Result] = {}
        self._began = time.monotonic()
        self.terminal()

    def terminal(self) -> None:
        """Opens another terminal, which is used from now on."""
        self._shell = subprocess.Popen(
            ["bash", "--norc"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=self.folder,
            env=self._environment,
            start_new_session=True,
        )
        self._running.callback(_closed, self._shell)

    def types(self, *commands: str) -> str:
        """Types commands. Returns what the last one prints; of one that serves, until it does."""
        for command in commands:
            self.commands += 1
            assert self._shell.stdin is not None
            self._shell.stdin.write(f"{command}\necho '{END}' $?\n")
            self._shell.stdin.flush()
            printed = self._printed()
        return printed

    def _printed(self) -> str:
        assert self._shell.stdout is not None
        printed = ""
        for line in self._shell.stdout:
            if line.startswith(END):
                if line.split()[-1] != "0":
                    raise TurnFailed(printed)
                return printed
            printed += line
            if found := DOWNLOADING.search(line):
                self.downloaded += float(found[1]) * UNITS[found[2]]
            if line.rstrip() == SERVES:
                return printed
        raise TurnFailed(printed)

    def writes(self, name: str, text: str) -> None:
        """Saves a file, which counts as a command."""
        self.commands += 1
        (self.folder / name).write_text(text)

    def _packages(self) -> list[Path]:
        """What was installed into an environment that had pip only."""
        found = self.folder.glob("*/.venv/lib/python3*/site-packages/*")
        return [each for each in found if not re.match("pip|setuptools|pkg_res|_dist", each.name)]

    def reached(self, what: str, at: float | None = None) -> None:
        """Notes that something is reached, now or at a time."""
        seconds = (at or time.monotonic()) - self._began
        self.results[what] = {
            "seconds": seconds,
            "commands": self.commands,
            "downloaded": self.downloaded + size(*map(self.folder.joinpath, DOWNLOADS)),
            "installed": size(*self._packages()),
        }
        print(f"{what}: {seconds:.1f} s, {self.commands} commands", flush=True)


def size(*folders: Path) -> int:
    """The bytes of all files below folders."""
    files = (file for each in folders for file in (each, *each.rglob("*")))
    return sum(file.lstat().st_size for file in files if file.is_file())


def _closed(shell: subprocess.Popen[str]) -> None:
    """Closes a terminal, and waits for the end of what runs in it."""
    os.killpg(shell.pid, signal.SIGTERM)
    assert shell.stdout is not None
    for _ in shell.stdout:
        pass
    shell.wait()


class Home:
    """A subscription to everything at a broker, which reads it as Home Assistant does."""

    def __init__(self, port: int, running: ExitStack) -> None:
        self._first: dict[str, tuple[float, MQTTMessage]] = {}
        client = Client(CallbackAPIVersion.VERSION2)
        client.on_message = self._received
        client.connect("127.0.0.1", port)
        client.subscribe("#")
        client.loop_start()
        running.callback(client.loop_stop)

    def _received(self, _client: Client, _data: object, message: MQTTMessage) -> None:
        self._first.setdefault(message.topic, (time.monotonic(), message))

    def value(self) -> float | None:
        """When the first value of the heater arrived."""
        times = [at for topic, (at, _) in self._first.copy().items() if VALUE.match(topic)]
        return min(times, default=None)

    def entity(self) -> float | None:
        """When the first entity of a device was complete: described, available, with a value."""
        seen = self._first.copy()
        for topic, (_, message) in seen.items():
            entity = json.loads(message.payload) if topic.endswith("/config") else {}
            if not VALUE.match(entity.get("state_topic", "")) or "name" not in entity["device"]:
                continue
            online = [each["topic"] for each in entity["availability"]]
            needs = [topic, entity["state_topic"], *online]
            if seen.keys() >= set(needs) and all(
                seen[one][1].payload == b"online" for one in online
            ):
                return max(seen[each][0] for each in needs)
        return None


VALUE = re.compile("plant/heater/[^/]+$")


def integrated(newcomer: Newcomer, running: ExitStack, tags: str, device: str, name: str) -> None:
    """From values on the screen to values at a broker, and to an entity."""
    port = running.enter_context(broker())
    home = Home(port, running)
    profile = Path(tags).stem
    newcomer.terminal()
    newcomer.types(f"cd {name}")
    newcomer.writes(
        f"{name}/home.yaml", PLANT.format(tags=tags, device=device, profile=profile, port=port)
    )
    newcomer.types(".venv/bin/holdfast run home.yaml")
    until(lambda: home.value() is not None)
    newcomer.reached("MQTT", home.value())
    until(lambda: home.entity() is not None)
    newcomer.reached("Home Assistant", home.entity())
    later = Home(port, running)  # Home Assistant may start after Holdfast: all is retained.
    until(lambda: later.entity() is not None)


def clone(newcomer: Newcomer, running: ExitStack) -> None:
    """`make run` in a clone."""
    newcomer.types(f"git clone --quiet file://{ROOT} holdfast", "cd holdfast")
    example = newcomer.folder / "holdfast" / "examples" / "plant.yaml"
    example.write_text(re.sub(r"127\.0\.0\.1:\d+", own_port, example.read_text()))
    [device] = re.findall(r"url: tcp://(\S+)", example.read_text())
    greeting = newcomer.types("make run")
    newcomer.reached("served")
    [watch] = re.findall(r"^    (\S.* watch .*)$", greeting, re.MULTILINE)
    newcomer.terminal()
    newcomer.types("cd holdfast")
    expect("voltage", newcomer.types(f"{watch} --times 1 --csv"))
    newcomer.reached("first value")
    integrated(newcomer, running, "examples/tags/heater.yaml", device, "holdfast")


def wheel(file: Path, newcomer: Newcomer, running: ExitStack) -> None:
    """The wheel in an empty environment."""
    (newcomer.folder / "try").mkdir()
    shutil.copy(file, newcomer.folder / "try")
    newcomer.downloaded += file.stat().st_size
    newcomer.types("cd try", "python3 -m venv .venv", f".venv/bin/pip install {file.name}")
    newcomer.reached("installed")
    greeting = newcomer.types(f".venv/bin/holdfast simulate --bind {own_port()}")
    newcomer.reached("served")
    [device] = re.findall(r"tcp://(\S+), unit", greeting)
    first, second = re.findall(r"^  (holdfast .*)$", greeting, re.MULTILINE)
    newcomer.terminal()
    newcomer.types("cd try")
    expect("input_registers", newcomer.types(f".venv/bin/{first}"))
    newcomer.reached("first value")
    expect("ir_0", newcomer.types(f".venv/bin/{second} --times 1 --csv"))
    newcomer.types(f".venv/bin/pip install '{file.name}[mqtt]'")
    integrated(newcomer, running, "heater.yaml", device, "try")


def own_port(_: object = None) -> str:
    """An address of this machine that is free."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def expect(text: str, printed: str) -> None:
    if text not in printed:
        raise TurnFailed(printed)


def main() -> None:
    """Prints a table, and writes all results to the file of `--json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--way", choices=["clone", "wheel"], help="default: both")
    parser.add_argument("--wheel", type=Path, help="default: that of dist for this machine")
    parser.add_argument("--json", type=Path, help="file for all results")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
    results = {}
    if options.way != "clone":
        found = options.wheel or next((ROOT / "dist").glob("*manylinux*_x86_64.whl"), None)
        if found is None:
            sys.exit("dist has no wheel for this machine: make dist SYSTEMS=linux-x86_64")
        results["wheel"] = tried(partial(wheel, found))
    if options.way != "wheel":
        results["clone"] = tried(clone)
    print("| way | until | seconds | commands | downloaded, MB | packages, MB |")
    print("| --- | --- | --- | --- | --- | --- |")
    for way, reached in results.items():
        for what, each in reached.items():
            megabytes = " | ".join(f"{each[key] / 1e6:.1f}" for key in ("downloaded", "installed"))
            print(f"| {way} | {what} | {each['seconds']:.1f} | {each['commands']} | {megabytes} |")
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def tried(way: Callable[[Newcomer, ExitStack], None]) -> dict[str, Result]:
    """Goes one way in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as running:
        newcomer = Newcomer(Path(folder), running)
        way(newcomer, running)
        return newcomer.results


if __name__ == "__main__":
    main()
