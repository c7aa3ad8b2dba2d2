"""The Debian package: its unit, its configuration, and the programs that build it."""

from __future__ import annotations

import ipaddress
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from holdfast.config import load
from support.machine import tool
from support.packaging_programs import program
from support.paths import ROOT

DEB = ROOT / "packaging" / "deb"
UNIT = (DEB / "debian" / "holdfast-modbus.holdfast.service").read_text()

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="packages of Debian")


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit, with a program that is there."""
    made = tmp_path / "holdfast.service"
    made.write_text(UNIT.replace("/usr/bin/holdfast", tool("true")))
    return made


def test_systemd_has_nothing_to_object_to_the_unit(unit: Path) -> None:
    command = [tool("systemd-analyze"), "verify", "--man=no", "--recursive-errors=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_exposure_of_the_unit_is_below_two_of_ten(unit: Path) -> None:
    command = [tool("systemd-analyze"), "security", "--offline=true", "--threshold=19", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_process_sees_its_own_figures() -> None:
    """The metrics `process_*`, by which an alarm judges open files, require `/proc/stat`."""
    assert "\nProtectProc=invisible\n" in UNIT
    assert "ProcSubset" not in UNIT


def test_a_stop_leaves_the_server_of_an_embedded_log_to_the_appliance() -> None:
    assert "\nKillMode=mixed\n" in UNIT


def test_the_unit_runs_the_files_that_the_package_installs() -> None:
    listed = (DEB / "debian" / "holdfast-modbus.install").read_text()
    installed = dict(line.split() for line in listed.splitlines())
    assert installed["holdfast"] == "usr/bin"
    assert installed["holdfast.yaml"] == "etc/holdfast"
    for key, verb in (("ExecStart", "run"), ("ExecReload", "reload")):
        assert f"\n{key}=/usr/bin/holdfast {verb} /etc/holdfast/holdfast.yaml\n" in UNIT
    for source in installed:
        assert source == "lib/*" or (DEB / source).exists()


def test_the_configuration_of_the_package_serves_this_machine_only() -> None:
    config = load(DEB / "holdfast.yaml")
    binds = re.findall(r"bind: (\S+):\d+$", (DEB / "holdfast.yaml").read_text(), re.MULTILINE)
    assert len(binds) == len(config.listeners) + 1
    assert all(ipaddress.ip_address(bind).is_loopback for bind in binds)


@pytest.mark.parametrize("has_file", [True, False])
@pytest.mark.parametrize("former", ["", "0.0.9"])
@pytest.mark.parametrize("reason", ["", "group", "override"])
def test_only_the_service_can_read_a_folder_that_the_package_has_made(
    tmp_path: Path, has_file: bool, former: str, reason: str
) -> None:
    """Also after its removal, and without the file. What an administrator has set stays."""
    folder, calls = tmp_path / "holdfast", tmp_path / "calls"
    paths = [folder, folder / "holdfast.yaml"] if has_file else [folder]
    folder.mkdir(mode=0o755)
    folder.chmod(0o755)
    if has_file:
        paths[1].touch()
        paths[1].chmod(0o644)
    group = "another" if reason == "group" else folder.group()
    script = (DEB / "debian" / "holdfast-modbus.postinst").read_text()
    script = script.replace("/etc/holdfast", str(folder)).replace("= root ]", f"= {group} ]")
    file = tmp_path / "postinst"
    file.write_text(script)
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, does in {
        "systemd-sysusers": ":",
        "py3compile": ":",
        "chgrp": f'echo "$@" >> {calls}',
        "dpkg-statoverride": "true" if reason == "override" else "false",
    }.items():
        (programs / name).write_text(f"#!/bin/sh\n{does}\n")
        (programs / name).chmod(0o755)
    environment = {"PATH": f"{programs}:{os.environ['PATH']}"}
    command = [tool("sh"), str(file), "configure", former]
    subprocess.run(command, check=True, env=environment)
    modes = [path.stat().st_mode & 0o777 for path in paths]
    if reason:
        assert (modes, calls.exists()) == ([0o755, 0o644][: len(paths)], False)
    else:
        assert modes == [0o750, 0o640][: len(paths)]
        assert calls.read_text() == "".join(f"holdfast {path}\n" for path in paths)


def test_the_folder_of_the_configuration_is_never_packed_for_everybody() -> None:
    rules = (DEB / "debian" / "rules").read_text()
    assert "\tchmod 0750 debian/holdfast-modbus/etc/holdfast\n" in rules
    assert "\tchmod 0640 debian/holdfast-modbus/etc/holdfast/holdfast.yaml\n" in rules


@pytest.mark.parametrize(
    ("wheel", "expected"),
    [
        (
            "holdfast_modbus-1.2.3-cp311-abi3-manylinux_2_17_x86_64.manylinux2014_x86_64.whl",
            ("1.2.3", "amd64", (2, 28)),
        ),
        ("holdfast_modbus-1.2.3-cp311-abi3-manylinux2014_aarch64.whl", ("1.2.3", "arm64", (2, 28))),
        ("holdfast_modbus-0.1.0-cp311-abi3-manylinux_2_34_x86_64.whl", ("0.1.0", "amd64", (2, 34))),
    ],
)
def test_a_package_is_for_the_machine_and_c_library_of_its_wheel(
    wheel: str, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert program("deb/build", monkeypatch).described(wheel) == expected


@pytest.mark.parametrize(
    "wheel",
    [
        "holdfast_modbus-1.2.3-cp311-abi3-musllinux_1_2_x86_64.whl",
        "holdfast_modbus-1.2.3-cp311-abi3-win_amd64.whl",
        "holdfast_modbus-1.2.3-cp311-abi3-manylinux_2_17_armv7l.whl",
    ],
)
def test_a_wheel_for_another_system_is_refused(wheel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="is not a wheel of Holdfast for Linux with glibc"):
        program("deb/build", monkeypatch).described(wheel)


def test_packages_are_built_of_wheels_for_amd64_and_arm64_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for tags in (
        "manylinux2014_aarch64.manylinux_2_17_aarch64",
        "manylinux2014_armv7l.manylinux_2_17_armv7l",
        "manylinux2014_x86_64.manylinux_2_17_x86_64",
        "musllinux_1_2_x86_64",
        "win_amd64",
    ):
        (tmp_path / f"holdfast_modbus-1.2.3-cp311-abi3-{tags}.whl").touch()
    (tmp_path / "holdfast_modbus-1.2.2-cp311-abi3-manylinux2014_x86_64.whl").touch()
    found = program("deb/build", monkeypatch).packable(tmp_path, "1.2.3")
    assert [wheel.stem.rpartition("manylinux_2_17_")[2] for wheel in found] == ["aarch64", "x86_64"]


def test_libraries_of_several_versions_of_python_share_a_folder_only_if_they_agree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    libraries = program("deb/libraries", monkeypatch)
    for python in ("311", "313"):
        folder = tmp_path / python
        (folder / "one-1.dist-info").mkdir(parents=True)
        (folder / "bin").mkdir()
        (folder / "bin" / "tool").write_text(f"#!/python{python}")
        (folder / "one-1.dist-info" / "RECORD").write_text(python)
        (folder / "one-1.dist-info" / "METADATA").write_text("Name: one")
        (folder / f"one.cpython-{python}.so").write_text(python)
        (folder / "one.py").write_text("same")
        libraries._merge(folder, tmp_path / "all")
    found = sorted(file.name for file in (tmp_path / "all").rglob("*") if file.is_file())
    assert found == ["METADATA", "one.cpython-311.so", "one.cpython-313.so", "one.py"]
    (tmp_path / "313" / "one.py").write_text("other")
    with pytest.raises(SystemExit, match=r"one\.py is not the same for all versions of Python"):
        libraries._merge(tmp_path / "313", tmp_path / "all")


def test_the_program_of_the_package_takes_its_own_libraries_first(tmp_path: Path) -> None:
    """As in the package, but in another folder: libraries of system and user do not count."""
    (tmp_path / "lib" / "holdfast").mkdir(parents=True)
    (tmp_path / "lib" / "holdfast" / "__init__.py").write_text("")
    (tmp_path / "lib" / "holdfast" / "cli.py").write_text(
        "import sys\ndef main():\n    print(sys.path[0], sys.path[-1], sys.flags.isolated)\n"
    )
    script = (DEB / "holdfast").read_text()
    assert script.startswith("#!/usr/bin/python3 -IS\n")
    file = tmp_path / "holdfast"
    file.write_text(script.replace("/usr/lib/holdfast", str(tmp_path / "lib")))
    command = [sys.executable, "-IS", str(file)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.split() == [str(tmp_path / "lib"), "/usr/local/lib/holdfast", "1"]
