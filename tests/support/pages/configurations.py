"""Loads the YAML of the pages: whole configurations, parts of them, and the files beside them.

A part is completed with what it refers to: memories, devices with tags, the listener or the device
that it belongs to. Files in `/run/secrets` are in the folder of the stage.
"""

from __future__ import annotations

import io
import shutil
from typing import TYPE_CHECKING, Any

from ruamel.yaml import YAML

import holdfast
from holdfast.config import Config, ConfigError, load
from holdfast.types import AREAS
from support.paths import EXAMPLES

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from support.pages.blocks import Block
    from support.pages.stage import Stage

SPANS: dict[str, Any] = dict.fromkeys(AREAS, 65536)
MEMORIES: dict[str, Any] = {
    "plant": SPANS | {"id": 7},
    **dict.fromkeys(("plant_a", "plant-1", "plant-2", "line", "status"), SPANS),
}
RULE = {"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-only"}
LISTENER = {"type": "modbus-tcp", "bind": "127.0.0.1:5020", "rules": [RULE]}
READ = {
    "area": "holding_registers",
    "address": 0,
    "count": 1,
    "into": {"memory": "plant", "area": "holding_registers", "address": 0},
}
DEVICE = {"url": "tcp://10.0.0.5", "interval": 1}
METER = {
    "profiles": {"meter": {"tags": {"power": {"area": "input_registers", "address": 52}}}},
    "devices": {"meter_1": {**DEVICE, "profile": "meter"}},
}
CERTIFICATES = {
    "ca.pem": ("ca.pem", "plant.pem", "plants.pem"),
    "server.pem": ("server.pem", "holdfast.pem", "panel.pem", "scanner.pem"),
    "server.key": ("server.key", "holdfast.key", "panel.key", "scanner.key"),
}
"""The names of the pages for the certificates of the examples."""


def put_certificates(folder: Path) -> None:
    for own, names in CERTIFICATES.items():
        for name in names:
            shutil.copy(EXAMPLES / "certificates" / own, folder / name)


def loaded(block: Block, stage: Stage) -> None:
    """Loads YAML of a page. Raises `AssertionError` if it is wrong, or of no known kind."""
    for name in ("token.txt", "mqtt", "nats"):
        stage.file(name, "secret")
    text = stage.here(block.text).replace("/run/secrets/", f"{stage.folder}/")
    text = text.replace('sha256: "…"', f'sha256: "{"0" * 64}"')
    data = YAML(typ="safe").load(text)
    assert isinstance(data, dict), "no configuration: a list"
    if set(data) <= set(AREAS):
        stage.file("initial.yaml", text)
        check({"memories": {"plant": {**SPANS, "initial": "initial.yaml"}}}, stage)
    elif "tags" in data:
        holdfast.load_tags(stage.file("list.yaml", text))
    elif set(data) == {"devices"} and not any(map(USED.intersection, data["devices"].values())):
        device = {name: {"reads": [READ], **each} for name, each in data["devices"].items()}
        check({"devices": device}, stage)
    elif set(data) == {"forward"}:
        check({"devices": {"meter": {**DEVICE, "reads": [READ], **data}}}, stage)
    elif set(data) == {"raw_ingest"}:
        units = {each for rule in data["raw_ingest"]["rules"] for each in rule["units"].items()}
        rule = {**RULE, "units": dict(units)}
        check({"listeners": {"scada": {**LISTENER, "rules": [rule], **data}}}, stage)
    else:
        unknown = sorted(set(data) - set(Config.model_fields))
        assert not unknown, f"no configuration: it has {', '.join(unknown)}"
        check(data, stage, text)


USED = {"reads", "profile", "tags"}
SERVICES = {"listeners", "rest", "mqtt", "nats", "gateway", "devices"}


def check(data: dict[str, Any], stage: Stage, text: str | None = None) -> None:
    """Loads a configuration, completed with what it refers to. It must have no warnings."""
    text = _yaml(data) if text is None else text
    if "memories" not in data:
        text += _yaml({"memories": MEMORIES})
    if "devices" not in data and "outputs" in data:
        text += _yaml(METER)
    elif not SERVICES & set(data):
        rule = {**RULE, "units": {1: next(iter(data.get("memories", MEMORIES)))}}
        text += _yaml({"listeners": {"scada": {**LISTENER, "rules": [rule]}}})
    try:
        warnings = load(stage.file("page.yaml", text)).warnings
    except ConfigError as error:
        raise AssertionError(_shown(error.problems, stage)) from None
    assert not warnings, _shown(warnings, stage)


def _shown(problems: Sequence[object], stage: Stage) -> str:
    return "\n".join(map(str, problems)).replace(f"{stage.folder}/", "")


def _yaml(data: Any) -> str:
    stream = io.StringIO()
    writer = YAML(typ="safe")
    writer.default_flow_style = False
    writer.representer.ignore_aliases = lambda _: True
    writer.dump(data, stream)
    return stream.getvalue()
