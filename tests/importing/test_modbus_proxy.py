"""Importing modbus-proxy: clients of its ports reach the devices that they reached before.

The replies are those of modbus-proxy 0.8.0 to the same requests.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.config import load
from holdfast.config.dump import to_yaml
from holdfast.importing import NotImportable, read_modbus_proxy
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.importing import Imported
    from support.running import Run

TWO = """\
devices:
- modbus:
    url: plc1.acme.org:502
    timeout: 12
    connection_time: 0.1
  listen:
    bind: 0:9000
  unit_id_remapping:
    1: 0
- modbus: {url: "tcp://10.0.0.5:1502"}
  listen: {bind: "localhost:9001"}
logging:
  version: 1
"""
FIRST, MODBUS = "devices[0]", "devices[0].modbus"


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Imported]:
    """Imports text; the result must be a valid configuration."""

    def imported(text: str, name: str = "proxy.yml") -> Imported:
        file = tmp_path / name
        file.write_text(text)
        found = read_modbus_proxy(file)
        (tmp_path / "made.yaml").write_text(found.to_yaml())
        assert load(tmp_path / "made.yaml").warnings == ()
        return found

    return imported


def changed(old: str, new: str) -> str:
    assert TWO.count(old) == 1, old
    return TWO.replace(old, new)


def notes(found: Imported) -> list[str]:
    """The notes, without those that all files cause."""
    told = [f"{each.line}: {each.key}: {each.kind}: {each.message}" for each in found.notes]
    assert len([each for each in told if each.startswith("1: devices: c")]) == 3
    return [each for each in told if not each.startswith("1: devices: c")]


def test_a_device_becomes_a_link_and_a_listener(read: Callable[..., Imported]) -> None:
    found = read(TWO)
    url = "tcp://plc1.acme.org:502"
    other = "10.0.0.5-1502"
    listener = {"type": "modbus-tcp", "idle_timeout": 0}
    others: dict[int | str, Any] = {
        0: {"route": "plc1.acme.org"},
        "2-255": {"route": "plc1.acme.org"},
    }
    assert found.data == {
        "devices": {"plc1.acme.org-unit-0": {"url": url, "timeout": 12, "unit": 0}},
        "links": {
            "plc1.acme.org": {
                "url": url,
                "timeout": 12,
                "tolerance": {"retries": 1, "pause_after_connect": 0.1},
            },
            other: {"url": "tcp://10.0.0.5:1502", "timeout": 10, "tolerance": {"retries": 1}},
        },
        "listeners": {
            "plc1.acme.org": {
                **listener,
                "bind": "0.0.0.0:9000",
                "rules": [
                    {
                        "sources": ["0.0.0.0/0", "::/0"],
                        "units": {1: {"route": "plc1.acme.org-unit-0"}, **others},
                        "access": "read-write",
                    }
                ],
            },
            other: {
                **listener,
                "bind": "127.0.0.1:9001",
                "rules": [
                    {
                        "sources": ["127.0.0.0/8", "::1/128"],
                        "units": {"0-255": {"route": other}},
                        "access": "read-write",
                    }
                ],
            },
        },
    }
    assert notes(found) == [
        f"6: {FIRST}.listen: check: sources are all addresses; list only networks that need it",
        "10: devices[1].modbus: check: no timeout: 10 s; modbus-proxy waited without an end",
        "12: logging: left out: the log is on standard error; see log",
    ]


def test_clients_get_the_replies_that_they_got_before(
    read: Callable[..., Imported], run: Run
) -> None:
    units = {unit: holdfast.Memory(holding_registers=2) for unit in (0, 1, 2, 5, 6)}
    for unit, memory in units.items():
        memory.write("holding_registers", 0, [unit])
    with holdfast.Server(units, bind="127.0.0.1:0", access="read-write") as device:
        host, port = device.address
        text = changed("plc1.acme.org:502", f"{host}:{port}").replace("10.0.0.5:1502", f"0:{port}")
        config = read(text.replace("1: 0\n", "{1: 0, 5: 6, 6: 5, 7: 2, 8: 2, 9: 77}\n")).data
        assert [each["url"] for each in config["links"].values()] == [f"tcp://{host}:{port}"]
        for listener in config["listeners"].values():
            listener["bind"] = "127.0.0.1:0"
        appliance = run(to_yaml(config))
        first, second = (endpoint(appliance, name) for name in config["listeners"])
        with holdfast.SyncClient(f"tcp://{first[0]}:{first[1]}") as client:
            # The reply must have the unit id of the request: the client takes no other.
            for unit, answers in {0: 0, 1: 0, 2: 2, 5: 6, 6: 5, 7: 2, 8: 2}.items():
                assert client.read_holding_registers(0, 1, unit=unit) == [answers], unit
            client.write_register(1, 700, unit=5)
            with pytest.raises(holdfast.ModbusException):
                client.read_holding_registers(5, 1, unit=1)
            with pytest.raises(holdfast.ModbusException):
                client.read_holding_registers(0, 1, unit=9)
        assert units[6].read("holding_registers", 1, 1) == [700]
        with holdfast.SyncClient(f"tcp://{second[0]}:{second[1]}") as client:
            assert client.read_holding_registers(0, 1, unit=1) == [1]


def test_json_and_toml_are_read_but_unit_ids_there_are_text_without_effect(
    read: Callable[..., Imported],
) -> None:
    one = {"modbus": {"url": "plc1:502", "timeout": 3}, "listen": {"bind": "[::1]:9000"}}
    toml = '[[devices]]\nmodbus = {url = "plc1:502", timeout = 3}\nlisten = {bind = "[::1]:9000"}\n'
    ignored = "unit_id_remapping.1: left out: no unit id as an integer; modbus-proxy ignored it"
    as_json = read(json.dumps({"devices": [{**one, "unit_id_remapping": {"1": 0}}]}), "proxy.json")
    as_toml = read(f"{toml}unit_id_remapping = {{1 = 0}}\n", "proxy.toml")
    assert as_json.data == as_toml.data
    assert as_json.data["listeners"]["plc1"]["rules"][0]["units"] == {"0-255": {"route": "plc1"}}
    assert notes(as_json) == [f"1: {FIRST}.{ignored}"]
    assert notes(as_toml) == [f"4: {FIRST}.{ignored}"]


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        ("plc1.acme.org:502", "udp://plc1:502",
         f"3: {MODBUS}.url: check: connects by Modbus TCP, as modbus-proxy did with any scheme"),
        ("connection_time: 0.1", "connection_time: 90",
         f"5: {MODBUS}.connection_time: changed: lowered to 60 s, the longest pause"),
        ("1: 0", "300: 0", f"9: {FIRST}.unit_id_remapping.300: left out: no unit id as an "
         "integer; modbus-proxy ignored it"),
        ("10.0.0.5:1502", "plc1.acme.org:502", "10: devices[1].modbus.url: changed: timeout and "
         "connection_time are those of the first with this url, as both share a connection"),
        ("logging:", "loging:", "12: loging: left out: unknown key"),
    ],
)  # fmt: skip
def test_what_can_not_be_converted_has_a_note(
    read: Callable[..., Imported], old: str, new: str, note: str
) -> None:
    assert note in notes(read(changed(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("plc1.acme.org:502", "plc1",
         f"3: {MODBUS}.url: found 'plc1', allowed: host:port, as in plc1:502"),
        ("plc1.acme.org:502", "/dev/ttyUSB0",
         f"3: {MODBUS}.url: found '/dev/ttyUSB0', allowed: host:port, as in plc1:502"),
        ("0:9000", '"9000"',
         f"7: {FIRST}.listen.bind: found '9000', allowed: an IP address and a port, as in 0:9000"),
        ("timeout: 12", "timeout: 0",
         f"4: {MODBUS}.timeout: found 0, allowed: seconds, 0.001 to 86400"),
        ("1: 0", "1: 300",
         f"9: {FIRST}.unit_id_remapping.1: found 300, allowed: a unit id from 0 to 255"),
        ("listen:\n    bind: 0:9000\n  ", "",
         f"2: {FIRST}.listen: missing, allowed: a mapping"),
    ],
)  # fmt: skip
def test_what_never_worked_is_a_problem(
    read: Callable[..., Imported], old: str, new: str, problem: str
) -> None:
    with pytest.raises(NotImportable) as refused:
        read(changed(old, new))
    assert [f"{each.line}: {each.key}: {each.message}" for each in refused.value.problems] == [
        problem
    ]
