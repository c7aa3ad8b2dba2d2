"""`--json`: every command prints objects of one shape, with the keys that docs/cli.md lists."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import click
import pytest

import holdfast
from holdfast._core import MemoryFile
from holdfast.cli import COMMANDS, CommandWithSubcommands, main
from support import cli
from support.brokers import NatsServer, free_port
from support.cli import RunCommand, done, invoke
from support.fleet_nodes import Nodes, prepare
from support.paths import DATA, DOCS

if TYPE_CHECKING:
    from collections.abc import Iterator
NONE = "tcp://127.0.0.1:1"
"""A URL that nobody answers."""

CASES = {
    "read": ("{url} hr 0 2", f"{NONE} hr 0"),
    "write": ("{url} hr 0 7 --verify", f"{NONE} hr 0 7"),
    "watch": ("{url} hr:0 --times 1", f"{NONE} hr:0"),
    "find": ("{url} --units 1", f"{NONE} --units 1"),
    "describe": ("{url} --units 1 --areas hr --range 0-9 --times 1", f"{NONE} --units 1"),
    "describe map": ("{url} --areas hr --range 0-9", f"{NONE} --range 0-9"),
    "describe guess": ("{url} hr 0 --times 1", f"{NONE} hr 0"),
    "describe identify": ("{url}", NONE),
    "describe status": ("{url}", NONE),
    "bench": ("{url} hr:0 --duration 0.05", f"{NONE} hr:0"),
    "raw-send": ("127.0.0.1:1 ir 0 1 --unit 1 --dry-run", "127.0.0.1:1 ir 0 1 --unit 1"),
    "check": ("{file}", "{absent}"),
    "check plan": ("{url} hr:0-9", "{absent}"),
    "health": ("{file}", "--url http://127.0.0.1:1"),
    "sessions": ("{file}", "{absent}"),
    "log status": ("{file}", "{absent}"),
    "log replay": ("{file} --values", "{file} --to 99999999"),
    "fleet status": ("plant --nats {nats}", "none --nats {nats}"),
    "audit verify": ("{audit}", "{absent}"),
    "memory verify": ("{folder}/plant.redb", "{mma}"),
    "import home-assistant": ("{home_assistant}", "{absent}"),
    "import mma": ("{mma}", "{absent}"),
    "import modbus-proxy": ("{modbus_proxy}", "{absent}"),
    "import modpoll": ("{modpoll} --url tcp://10.5.1.29", "{absent} --url tcp://10.5.1.29"),
    "import replicator": ("{replicator}", "{absent}"),
    "import telegraf": ("{telegraf}", "{absent}"),
    "cert show": ("{folder}/ca.pem", "{mma}"),
    "token": ("", "--name ?"),
}
"""For each command, arguments with which it succeeds, and with which it fails."""

REPLICATOR = """\
replicator:
  units:
    - id: pump
      source: {endpoint: "10.5.1.29:502", unit_id: 7, timeout_ms: 1500}
      reads: [{fc: 3, address: 0, quantity: 10}]
      targets: [{id: 2, endpoint: "10.5.1.20:501", memories: [{memory_id: 1, offsets: {3: 0}}]}]
      poll: {interval_ms: 1000}
"""

HOME_ASSISTANT = """\
modbus:
  - {name: plc, type: tcp, host: 10.5.1.29, port: 502, sensors: [{name: level, address: 1}]}
"""

TELEGRAF = """\
[[inputs.modbus]]
  name = "plc"
  slave_id = 1
  controller = "tcp://10.5.1.29:502"
  coils = [{name = "pump", address = [0]}]
"""

MODBUS_PROXY = "devices: [{modbus: {url: '10.5.1.29:502'}, listen: {bind: '127.0.0.1:9000'}}]\n"

MODPOLL = "device,plc,1\npoll,coil,0,8,BE_BE\nref,pump,0,bool,r\n"

NO_TARGET = {"token"}


def commands() -> Iterator[tuple[str, click.Command]]:
    """All commands, and those below them."""
    context = click.Context(main)
    for name in COMMANDS:
        command = main.get_command(context, name)
        assert command is not None
        yield name, command
        if isinstance(command, click.Group):
            yield from ((f"{name} {each}", of) for each, of in command.commands.items())
        if isinstance(command, CommandWithSubcommands):
            yield from (
                (f"{name} {each}", command.subcommand(each)) for each in command.subcommands
            )


def tables() -> tuple[set[str], dict[str, set[str]], set[str]]:
    """The keys of all commands, those of single ones, and the reasons, in docs/cli.md."""
    section = (DOCS / "cli.md").read_text().partition("\n### JSON\n")[2].partition("\n## ")[0]
    shared, own, reasons = re.split(r"\n\| (?:command|`reason`) \|", section)
    rows = re.findall(r"^\| (`.*?) \| (.*) \|$", own, re.MULTILINE)
    named = {
        command: set(re.findall(r"`(\w+)`", keys))
        for names, keys in rows
        for command in re.findall(r"`([^`]+)`", names)
    }
    keys = re.findall(r"^\| (`.*?) \|", shared, re.MULTILINE)
    words = re.findall(r"^\| (`.*?) \|", reasons, re.MULTILINE)
    found = [set(re.findall(r"`(\w+)`", " ".join(each))) for each in (keys, words)]
    return found[0], named, found[1]


def objects(text: str) -> list[dict[str, Any]]:
    """The objects that a command prints: one, or one a line."""
    try:
        return [json.loads(text)]
    except ValueError:
        return [json.loads(line) for line in text.splitlines()]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """An appliance with a log, a fleet, and files."""
    folder = tmp_path_factory.mktemp("world")
    (folder / "server").mkdir()
    nats = NatsServer(folder / "server")
    prepare(nats.url, 4)
    nodes = Nodes([nats.url], folder, 4)
    file = folder / "plant.yaml"
    file.write_text(
        "memories:\n"
        "  plant: {holding_registers: 100, replicate: {log: site}}\n"
        f"logs: {{site: {{servers: ['{nats.url}'], node: a}}}}\n"
        f"metrics: {{bind: '127.0.0.1:{free_port()}'}}\n"
        "audit: {file: audit.log}\n"
        "listeners: {scada: {type: modbus-tcp, bind: '127.0.0.1:0', rules: [{sources: "
        "[127.0.0.0/8], units: {1: plant}, access: read-write}]}}\n"
    )
    appliance = RunCommand(file)
    appliance.wait_until_it_serves()
    nodes.start("a")
    done("cert", "ca", "Plant", "--folder", str(folder))
    kept = MemoryFile(folder / "plant.redb", [("plant", holdfast.Memory(coils=8))], 0)
    kept.start()
    kept.stop()
    nodes.settle()
    (folder / "replicator.yaml").write_text(REPLICATOR)
    (folder / "home_assistant.yaml").write_text(HOME_ASSISTANT)
    (folder / "telegraf.conf").write_text(TELEGRAF)
    (folder / "modbus_proxy.yaml").write_text(MODBUS_PROXY)
    (folder / "modpoll.csv").write_text(MODPOLL)
    yield {
        "mma": str(DATA / "mma" / "plant.yaml"),
        "folder": str(folder),
        "file": str(file),
        "absent": str(folder / "absent.yaml"),
        "replicator": str(folder / "replicator.yaml"),
        "home_assistant": str(folder / "home_assistant.yaml"),
        "telegraf": str(folder / "telegraf.conf"),
        "modbus_proxy": str(folder / "modbus_proxy.yaml"),
        "modpoll": str(folder / "modpoll.csv"),
        "audit": str(folder / "audit.log"),
        "nats": nats.url,
    }
    nodes.stop()
    appliance.process.kill()
    appliance.process.communicate()
    nats.kill()


@pytest.mark.parametrize("name", CASES)
def test_a_command_prints_its_keys(
    name: str, world: dict[str, str], server: holdfast.Server
) -> None:
    names = {**world, "url": cli.url(server)}
    shared, own, reasons = tables()
    for words, is_good in zip(CASES[name], (True, False), strict=True):
        result = invoke(*name.split(), *words.format(**names).split(), "--json")
        assert (result.exit_code == 0) == is_good, result.output
        printed = objects(result.stdout)
        assert printed
        for found in printed:
            assert found["ok"] is is_good
            for each in (found, *found.get("found", ())):
                assert set(each) <= shared | own.get(name, set())
            assert ("target" in found) == (name not in NO_TARGET)
            if name.startswith("import "):
                assert found["target"] == words.split()[0].format(**names)
            if is_good:
                assert "reason" not in found
            else:
                assert found["reason"] in reasons
                assert isinstance(found["detail"], str)


def test_a_row_of_a_network_has_the_keys_of_find(server: holdfast.Server) -> None:
    shared, own, _ = tables()
    port = cli.url(server).rpartition(":")[2]
    [row] = cli.answer("find", "127.0.0.1/32", "--port", port)["found"]
    assert {"host", "url", "modbus"} <= set(row) <= shared | own["find"]


def test_every_command_with_json_is_tried_and_listed() -> None:
    found = {name for name, each in commands() if any(p.name == "as_json" for p in each.params)}
    assert found == set(CASES)
    assert set(tables()[1]) <= found


@pytest.mark.parametrize("name", CASES)
def test_wrong_usage_is_an_object_too(name: str) -> None:
    result = invoke(*name.split(), "--json", "--no-such-option")
    [found] = objects(result.stdout)
    assert (result.exit_code, result.stderr) == (2, "")
    assert (found["ok"], found["reason"]) == (False, "usage")
    assert found["detail"].endswith((".", "?"))


@pytest.mark.parametrize("words", ["hr:0 hr:5000", "hr 0 2 --type bcd16"])
def test_an_answer_without_some_values_has_the_error_of_the_first(
    words: str, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 1, [0xABCD])
    found = cli.answer("read", cli.url(server), *words.split(), code=1)
    [(name, error)] = found["errors"].items()
    assert (found["ok"], found["reason"]) == (False, error["reason"])
    assert found["detail"] == f"{name}: {error['detail']}"
