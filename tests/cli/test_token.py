"""`holdfast token`: a secret, its hash, and the entry to paste."""

from __future__ import annotations

import base64
import hashlib
import json
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from holdfast.cli import main
from holdfast.config import load
from holdfast.config.text.yaml_document import parse

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

REST = """\
memories: {plant: {coils: 8}}
rest:
  bind: 127.0.0.1:8080
  sources: [127.0.0.0/8]
  tokens:
"""


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["token", *arguments])


def entry(result: Result) -> dict[str, Any]:
    document, problems = parse(result.stdout.partition(":\n\n")[2], "entry.yaml")
    assert problems == []
    found: dict[str, Any] = document.data[0]
    return found


def digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def test_a_secret_is_printed_once_with_its_hash() -> None:
    result = run()
    secret = result.stdout.splitlines()[0].rpartition(" ")[2]
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.count(secret) == 1
    assert entry(result)["name"] == "edge-gateway"
    assert entry(result)["sha256"] == digest(secret)


def test_a_secret_is_32_random_bytes() -> None:
    secrets = [json.loads(run("--json").stdout)["token"] for _ in range(2)]
    assert secrets[0] != secrets[1]
    assert [len(base64.urlsafe_b64decode(secret + "=")) for secret in secrets] == [32, 32]


def test_programs_get_json() -> None:
    answer = json.loads(run("--name", "node-red", "--json").stdout)
    assert list(answer) == ["ok", "name", "token", "sha256"]
    assert answer["name"] == "node-red"
    assert answer["sha256"] == digest(answer["token"])


@pytest.mark.parametrize("name", ["node-red", "true", "7", "-x", "1e5"])
def test_the_name_is_text_in_the_entry(name: str) -> None:
    assert entry(run(f"--name={name}"))["name"] == name


@pytest.mark.parametrize("name", ["", "a b", "x" * 65])
def test_a_name_that_no_configuration_takes_is_refused(name: str) -> None:
    result = run("--name", name)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "allowed: 1 to 64 letters" in result.stderr


def test_a_secret_is_no_input() -> None:
    assert "set its sha256: printf %s SECRET | sha256sum" in run("--stdin").stderr


def test_a_secret_is_no_argument() -> None:
    assert run("correct-horse-battery-staple").exit_code == 2


def test_the_entry_fits_into_a_configuration(tmp_path: Path) -> None:
    lines = run().stdout.partition("    - name")[1:]
    text = "".join(lines).replace("memories: []", "memories: [plant]")
    text = text.replace("areas: []", "areas: [coils]").replace("access:", "access: read-only")
    path = tmp_path / "plant.yaml"
    path.write_text(REST + text)
    assert load(path).rest is not None


def test_the_entry_of_the_gateway_fits_into_a_configuration(tmp_path: Path) -> None:
    head = (
        "gateway:\n  bind: 127.0.0.1:8090\n  sources: [10.0.0.0/8]\n  allow: [10.0.0.0/8]\n"
        "  access: read-only\n  tokens:\n"
    )
    told, _, text = run("--gateway", "--name", "panel").stdout.partition(":\n\n")
    secret = told.splitlines()[0].rpartition(" ")[2]
    path = tmp_path / "plant.yaml"
    path.write_text(head + text)
    gateway = load(path).gateway
    assert told.splitlines()[-1] == "Add under gateway.tokens in the configuration"
    assert gateway is not None
    assert gateway.model_dump()["tokens"] == ({"name": "panel", "sha256": digest(secret)},)


@pytest.mark.parametrize("options", [("--gateway", "--line"), ("--line", "--json")])
def test_there_is_one_form_at_a_time(options: tuple[str, ...]) -> None:
    result = run(*options)
    assert result.exit_code == 2
    assert "can't be used together" in result.output
