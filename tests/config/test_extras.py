"""What an installation says that lacks an extra."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import pytest

from holdfast.client import SyncClient
from holdfast.config import ConfigError, load
from holdfast.runtime import extras
from support.cli import invoke

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.runtime.extras import Extra

MODULES: dict[Extra, str] = {"mqtt": "paho.mqtt", "nats": "nats", "sparkplug": "google.protobuf"}

BROKER = """\
outputs:
  one: {type: mqtt, url: 'mqtt://h'}
  two: {type: sparkplug, url: 'mqtt://h', group: g, edge_node: e}
  three: {type: nats, servers: ['nats://h']}
mqtt: {url: 'mqtt://h', client_id: c}
nats: {servers: ['nats://h']}
logs: {main: {servers: ['nats://h']}}
"""


@pytest.mark.parametrize(
    ("extra", "lines"), [("mqtt", {2, 3, 5}), ("nats", {4, 6, 7}), ("sparkplug", {3})]
)
def test_a_configuration_names_each_line_that_requires_a_missing_extra(
    extra: Extra, lines: set[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(BROKER)
    monkeypatch.setitem(sys.modules, MODULES[extra], None)
    with pytest.raises(ConfigError) as caught:
        load(file)
    found = {each.line for each in caught.value.problems if "not installed: pip" in str(each)}
    assert found == lines


def test_a_command_whose_extra_is_missing_prints_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [each for each in sys.modules if each.startswith("holdfast.cli.services.scan")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("holdfast.cli._imported", lambda _: __import__("nats.missing"))
    result = invoke("scan")
    assert result.exit_code == 2
    assert result.stderr == (
        "holdfast: this command requires nats-py, not installed: "
        "pip install 'holdfast-modbus[nats]'\n"
    )


def test_other_missing_modules_are_not_explained() -> None:
    assert extras.missing_for(ModuleNotFoundError("x", name="elsewhere.part")) is None


def test_a_passphrase_requires_certs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("cert", "key", "secret"):
        (tmp_path / name).write_text("secret")
    monkeypatch.setitem(sys.modules, "cryptography", None)
    files = "&".join(
        f"{key}={tmp_path / name}"
        for key, name in (("cert", "cert"), ("key", "key"), ("key_passphrase_file", "secret"))
    )
    with pytest.raises(ValueError, match=r"'holdfast-modbus\[certs\]'"):
        SyncClient(f"tls://plc?{files}")
