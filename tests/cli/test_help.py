"""The help, and the errors that say what was probably meant."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

import holdfast
from holdfast.cli import COMMANDS, GROUPS
from holdfast.cli.old_spellings import OLD_NAMES
from support import cli
from support.cli import done, usage_error


def test_commands_are_in_groups_and_those_for_beginners_are_first() -> None:
    shown = "\n".join(done("--help"))
    order = re.findall(r"^  ([a-z-]+) {2,}\S", shown, re.M)
    assert [name for name in order if name in COMMANDS] == list(COMMANDS)
    assert list(COMMANDS)[:5] == ["read", "write", "watch", "find", "describe"]
    assert len(COMMANDS) <= 24, "the help must stay short: put a command under another one"
    assert list(GROUPS)[:2] == ["Devices", "Services"]
    assert list(COMMANDS)[-1] == "bench"
    assert re.search(r"scan +Run the NATS service", shown)
    assert all(len(line) <= 80 for line in shown.splitlines())


def test_the_help_imports_no_command() -> None:
    code = (
        "import sys; from holdfast.cli import main; main(['--help'], standalone_mode=False); "
        "sys.exit('holdfast.cli.services.run' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("raed",), "No such command 'raed'. Did you mean 'read'"),
        (("Describe",), "Did you mean 'describe'?"),
        (("mpa",), "Did you mean 'describe map'?"),
        (
            ("describe", "mapp", "tcp://plc"),
            "No such command 'describe mapp'. Did you mean 'describe map'?",
        ),
        (("describe", "plc"), "'plc' is not the URL of a device"),
        (("replicsa",), "Did you mean 'log status' or 'log replay'?"),
        (("import", "mmaa"), "No such command 'mmaa'. Did you mean 'mma'?"),
        (
            ("import", "evcc"),
            "No such command 'evcc'. See docs/replacing.md, which has tables for other programs.",
        ),
        (("xyzzy",), "No such command 'xyzzy'."),
        (("tcp://plc",), "Did you mean 'holdfast read tcp://plc'?"),
        (("read", "tcp://plc", "hr", "0", "--jsn"), "'--json'?)"),
        (("read", "plc", "hr", "0"), "for a host of that name, type tcp://plc."),
        (("read", "/dev/ttyUSB0", "hr", "0"), "type rtu:///dev/ttyUSB0?baud=19200&parity=even"),
        (("read", "COM3", "hr", "0"), "'holdfast find COM3' finds them."),
        (("read", "/tmp/line", "hr", "0"), "'holdfast find /tmp/line' finds them."),
        (("read", "/etc/plant.yaml", "hr", "0"), "'/etc/plant.yaml' is not the URL of a device"),
        (("read", "plant.yaml", "hr", "0"), "'plant.yaml' is not the URL of a device"),
    ],
)
def test_an_error_says_what_to_type(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error(*arguments)


@pytest.mark.parametrize("old", OLD_NAMES)
def test_an_old_name_works_and_hints_at_the_new_one(old: str) -> None:
    new = OLD_NAMES[old]
    options = ["bash"] if old == "completion" else [] if old == "schema" else ["--help"]
    result = cli.invoke(old, *options)
    assert result.exit_code == 0
    assert result.stderr == f"hint: 'holdfast {old}' is now 'holdfast {new}'\n"
    assert result.stdout == cli.invoke(*new.split(), *options).stdout != ""


def test_a_command_with_subcommands_lists_them() -> None:
    for command, listed in (("describe", "map +Find the"), ("check", "plan +Print the requests")):
        assert re.search(f"^Commands:\n  {listed}", cli.invoke(command, "--help").stdout, re.M)


def test_a_host_without_a_scheme_is_one_over_tcp(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [7])
    host, port = server.address
    for url in (f"{host}:{port}", f"localhost:{port}"):
        assert cli.answer("read", url, "hr", "0")["registers"] == [7]
    for words in (("hr", "0"), ("hr:0",)):
        assert cli.invoke("watch", f"{host}:{port}", *words, "--times", "1").exit_code == 0


@pytest.mark.parametrize("host", ["::1", "[::1]:1", "127.0.0.1:1"])
def test_addresses_of_every_form_are_hosts(host: str) -> None:
    [told] = cli.failure("read", host, "hr", "0", "--timeout", "1")
    assert told.startswith("holdfast: tcp://")


def test_orders_are_accepted_in_any_case(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, holdfast.values.encode(21.5, "float32", "CDAB"))
    url = cli.url(server)
    found = cli.answer("read", url, "hr", "0", "--type", "float32", "--order", "cdab")
    assert (found["order"], found["values"]) == ("CDAB", [21.5])
