"""Containers: what runs has few rights, and every file that is mounted is there and valid."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from holdfast.config import load
from support.paths import ROOT

PACKAGING = ROOT / "packaging"
COMPOSE = sorted(PACKAGING.glob("compose/*/compose.yaml"))
MANIFEST = list(YAML(typ="safe").load_all(PACKAGING / "kubernetes" / "holdfast.yaml"))
FROM_ELSEWHERE = "monitoring"
CONFIGURATION = "/etc/holdfast/holdfast.yaml"


def services(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = YAML(typ="safe").load(file)["services"]
    return found


def mounts(file: Path, service: dict[str, Any]) -> dict[str, Path]:
    """The files that a service mounts, by their place in the container."""
    found = [each.split(":") for each in service.get("volumes", ()) if each.startswith(".")]
    assert all(mode == "ro" for *_, mode in found)
    return {target: (file.parent / source).resolve() for source, target, _ in found}


def named(file: Path) -> str:
    return file.parent.name


@pytest.mark.parametrize("file", COMPOSE, ids=named)
def test_every_mounted_file_exists(file: Path) -> None:
    for service in services(file).values():
        for source in mounts(file, service).values():
            assert source.is_file(), source


@pytest.mark.parametrize("file", COMPOSE, ids=named)
def test_every_configuration_is_valid(file: Path, tmp_path: Path) -> None:
    found = 0
    for name, service in services(file).items():
        mounted = mounts(file, service)
        folder = tmp_path / name
        folder.mkdir()
        for target, source in mounted.items():
            if target.startswith("/etc/holdfast/"):
                shutil.copy(source, folder / Path(target).name)
        if CONFIGURATION in mounted:
            config = load(folder / "holdfast.yaml")
            assert config.warnings == ()
            assert config.metrics is not None, "health checks need it"
            found += 1
    assert found


@pytest.mark.parametrize("file", COMPOSE, ids=named)
def test_appliances_have_no_rights_and_are_published_to_this_machine_only(file: Path) -> None:
    for service in services(file).values():
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ()))
        if service["image"] == "localhost/holdfast-modbus:latest":
            assert service["read_only"] is True
            assert service["cap_drop"] == ["ALL"]
            assert service["security_opt"] == ["no-new-privileges:true"]


def test_nodes_of_the_replicated_example_differ_in_their_name_only() -> None:
    files = sorted(PACKAGING.glob("compose/replicated/scada-*.yaml"))
    texts = {file.read_text().replace(f"node: {file.stem}\n", "node: NAME\n") for file in files}
    assert (len(files), len(texts)) == (3, 1)
    assert "node: NAME\n" in texts.pop()


def test_the_image_runs_as_a_user_with_a_health_check() -> None:
    text = (PACKAGING / "container" / "Containerfile").read_text()
    assert "\nUSER 10001:10001\n" in text
    assert f'CMD ["holdfast", "health", "{CONFIGURATION}"]' in text
    assert f'CMD ["run", "{CONFIGURATION}"]' in text
    assert load(PACKAGING / "container" / "holdfast.yaml").metrics is not None


def test_the_image_is_built_from_files_that_are_not_ignored() -> None:
    text = (PACKAGING / "container" / "Containerfile").read_text()
    copied = [line.split()[1] for line in text.splitlines() if line.startswith("COPY ")]
    kept = (ROOT / ".dockerignore").read_text().splitlines()
    assert all(f"!{source}" in kept for source in copied if not source.startswith("--"))


def test_the_manifest_has_a_valid_configuration(tmp_path: Path) -> None:
    [settings] = [part for part in MANIFEST if part["kind"] == "ConfigMap"]
    file = tmp_path / "holdfast.yaml"
    text = settings["data"]["holdfast.yaml"]
    file.write_text(text.replace("/var/lib/holdfast", str(tmp_path)))
    config = load(file)
    assert config.warnings == ()
    assert config.metrics is not None


def test_the_pod_is_restricted_and_probed() -> None:
    [found] = [part for part in MANIFEST if part["kind"] == "StatefulSet"]
    pod = found["spec"]["template"]["spec"]
    [container] = pod["containers"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    ports = {port["name"] for port in container["ports"]}
    probes = {name: container[f"{name}Probe"]["httpGet"] for name in ("liveness", "readiness")}
    assert {probe["port"] for probe in probes.values()} <= ports
    assert [probe["path"] for probe in probes.values()] == ["/health/live", "/health/ready"]
    [service] = [part for part in MANIFEST if part["kind"] == "Service"]
    assert {port["targetPort"] for port in service["spec"]["ports"]} == ports
