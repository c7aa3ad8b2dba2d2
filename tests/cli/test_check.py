"""`holdfast check` and `holdfast check --schema`, as people and programs use them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from functools import partial
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

import holdfast
from holdfast.cli import COMMANDS, configuration, main
from holdfast.cli.configuration import load_or_exit
from holdfast.config import json_schema, load
from holdfast.runtime import bounded_files
from support.silent_files import Silent

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

GOOD = """\
memories: {plant: {coils: 8}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules: [{sources: [127.0.0.1], units: {1: plant}, access: read-only}]
"""
BAD = GOOD.replace("read-only", "rw").replace("{1: plant}", "{1: plan}")
PROBLEMS = [
    "listeners.scada.rules[0].units.1: found 'plan', allowed: plant; did you mean 'plant'?",
    "listeners.scada.rules[0].access: found 'rw', allowed: read-only or read-write",
]


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.yaml"
    path.write_text(GOOD, encoding="utf-8")
    return path


@pytest.fixture
def bad(tmp_path: Path) -> Path:
    path = tmp_path / "bad.yaml"
    path.write_text(BAD, encoding="utf-8")
    return path


def test_check_prints_the_effective_configuration(good: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(good)])
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == load(good).dump()


@pytest.mark.parametrize("command", ["check", "run"])
def test_what_is_in_the_certificates_of_a_device_is_checked(tmp_path: Path, command: str) -> None:
    path = tmp_path / "p.yaml"
    (tmp_path / "ca.pem").write_text("nothing")
    path.write_text(
        f"{GOOD}devices:\n  meter:\n    url: tls://127.0.0.1?ca=ca.pem\n    unit: 1\n"
        "    interval: 1\n    reads: [{area: coils, address: 0, count: 1,"
        " into: {memory: plant, area: coils, address: 0}}]\n"
    )
    result = CliRunner().invoke(main, [command, str(path)])
    assert (result.exit_code, result.stdout) == (2, "")
    found, number = result.stderr.splitlines()
    assert found.startswith(f"{path}:9: devices.meter.url: {tmp_path / 'ca.pem'}: found ")
    assert number == "1 problem"


@pytest.mark.parametrize("command", ["check", "run"])
def test_what_is_in_the_certificates_of_subscribed_devices_is_checked(
    tmp_path: Path, command: str
) -> None:
    path = tmp_path / "p.yaml"
    (tmp_path / "ca.pem").write_text("nothing")
    path.write_text(
        "nats:\n  servers: [nats://127.0.0.1]\n  devices: [127.0.0.1]\n"
        "  device_tls: {ca_file: ca.pem}\n"
    )
    result = CliRunner().invoke(main, [command, str(path)])
    assert (result.exit_code, result.stdout) == (2, "")
    found, number = result.stderr.splitlines()
    assert found.startswith(f"{path}:4: nats.device_tls: ")
    assert f"{tmp_path / 'ca.pem'}: found " in found
    assert number == "1 problem"


def test_check_prints_every_problem_and_their_number(bad: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(bad)])
    assert (result.exit_code, result.stdout) == (2, "")
    lines = [f"{bad}:6: {problem}" for problem in PROBLEMS]
    assert result.stderr.splitlines() == [*lines, "2 problems"]


def test_check_counts_a_single_problem(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(tmp_path / "none.yaml")])
    assert result.exit_code == 2
    assert result.stderr.splitlines() == [
        f"{tmp_path}/none.yaml: can't be read: No such file or directory",
        "1 problem",
    ]


def test_check_gives_programs_the_configuration(good: Path) -> None:
    result = CliRunner().invoke(main, ["check", "--json", str(good)])
    answer = json.loads(result.stdout)
    assert result.exit_code == 0
    assert (answer["ok"], answer["problems"]) == (True, [])
    assert answer["config"]["listeners"]["scada"]["max_connections"] == 256


def test_check_gives_programs_the_problems(bad: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(bad), "--json"])
    answer = json.loads(result.stdout)
    assert (result.exit_code, result.stderr, answer["ok"]) == (2, "", False)
    assert answer["problems"][1] == {
        "file": str(bad),
        "line": 6,
        "column": BAD.splitlines()[5].index("rw") + 1,
        "key": "listeners.scada.rules[0].access",
        "message": "found 'rw', allowed: read-only or read-write",
    }


def test_check_needs_a_file() -> None:
    result = CliRunner().invoke(main, ["check"])
    assert result.exit_code == 2
    assert "Missing argument 'FILE'" in result.stderr


def test_a_command_gets_its_configuration(good: Path) -> None:
    assert load_or_exit(good) == load(good)


def test_a_command_ends_with_2_on_a_wrong_configuration(
    bad: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        load_or_exit(bad)
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith("2 problems\n")


def test_a_command_ends_with_1_if_the_configuration_does_not_answer(
    good: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answered = partial(bounded_files.answered, timeout_ms=50)
    monkeypatch.setattr(configuration, "answered", answered)
    with Silent(monkeypatch, "open", good), pytest.raises(SystemExit) as ended:
        load_or_exit(good)
    assert ended.value.code == 1
    reason = "can't be read: no answer within 0.05 s, the limit"
    assert capsys.readouterr().err == f"{good}: {reason}\n1 problem\n"


def test_a_command_ends_with_1_if_no_thread_can_start(
    good: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def start(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(SystemExit, match="1"):
        load_or_exit(good)
    reason = "no thread to read files with: can't start new thread"
    assert capsys.readouterr().err == f"holdfast: {reason}\n"


def test_schema_prints_the_schema() -> None:
    result = CliRunner().invoke(main, ["check", "--schema"])
    assert result.exit_code == 0
    assert json.loads(result.stdout) == json_schema()


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_help_has_an_example(command: list[str]) -> None:
    result = CliRunner().invoke(main, [*command, "--help"])
    assert result.exit_code == 0
    assert "Example: holdfast " in result.stdout


def test_the_version_is_that_of_the_package() -> None:
    result = CliRunner().invoke(main, ["--version"])
    assert result.stdout == f"holdfast {holdfast.__version__}\n"


def test_an_unknown_command_is_wrong_usage() -> None:
    assert CliRunner().invoke(main, ["fly"]).exit_code == 2


def test_check_works_as_a_process(bad: Path) -> None:
    command = [sys.executable, "-m", "holdfast", "check", str(bad)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.splitlines()[-1] == "2 problems"
    assert "Traceback" not in result.stderr


def test_what_never_ends_is_read_up_to_the_limit() -> None:
    result = CliRunner().invoke(main, ["check", "/dev/zero"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines() == [
        "/dev/zero: can't be read: more than 1048576 bytes, the limit",
        "1 problem",
    ]


@pytest.mark.parametrize(
    ("named", "size"), [("plant.yaml", 1 << 20), ("profile.yaml", 3 << 20), ("values.csv", 8 << 20)]
)
def test_a_large_file_is_refused_before_it_is_parsed(named: str, size: int, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(f"{GOOD}profiles: [profile.yaml]\n".replace("8}", "8, initial: values.csv}"))
    (tmp_path / "profile.yaml").write_text("tags: {power: {area: coils, address: 1}}")
    (tmp_path / "values.csv").write_text("coils,1,1\n")
    assert CliRunner().invoke(main, ["check", str(path)]).exit_code == 0
    with (tmp_path / named).open("a") as file:
        file.write(f"# {' ' * (size - 2 - file.tell())}\n")
    result = CliRunner().invoke(main, ["check", str(path)])
    assert result.exit_code == 2
    problem, number = result.stderr.splitlines()
    assert named in problem
    assert problem.endswith(f"can't be read: more than {size} bytes, the limit")
    assert number == "1 problem"


@pytest.mark.skipif(sys.platform == "win32", reason="no such pipes")
class TestPipes:
    """Pipes have their content once, and may never have it."""

    def test_a_configuration_comes_from_the_shell(self) -> None:
        file, result = self.check(GOOD)
        assert (result.exit_code, result.stderr) == (0, "")
        assert "scada:" in result.stdout, file

    def test_problems_of_certificates_have_their_line(self, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").write_text("nothing")
        url = f"tls://127.0.0.1?ca={tmp_path}/ca.pem"
        file, result = self.check(f"{GOOD}links: {{line: {{url: '{url}'}}}}\n")
        assert result.exit_code == 2
        assert result.stderr.startswith(f"{file}:7: links.line.url: {tmp_path}/ca.pem: found ")

    @staticmethod
    def check(text: str) -> tuple[str, Result]:
        """Checks what `<(command)` of a shell prints."""
        reader, writer = os.pipe()
        os.write(writer, text.encode())
        os.close(writer)
        file = f"/dev/fd/{reader}"
        result = CliRunner().invoke(main, ["check", file])
        os.close(reader)
        return file, result

    def test_a_configuration_that_never_comes_is_a_problem(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        patient = bounded_files.read
        monkeypatch.setattr(bounded_files, "read", partial(patient, timeout_ms=50))
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        result = CliRunner().invoke(main, ["check", str(pipe)])
        # 1, not 2: a service manager tries it again.
        assert (result.exit_code, result.stdout) == (1, "")
        assert result.stderr.splitlines() == [
            f"{pipe}: can't be read: no answer within 0.05 s, the limit",
            "1 problem",
        ]

    @pytest.mark.parametrize(
        ("more", "problem"),
        [
            ("profiles: [pipe.yaml]\n", "profiles[0]: found 'pipe.yaml'"),
            (
                "links: {line: {url: 'tls://127.0.0.1?ca=pipe.yaml'}}\n",
                "links.line.url: found ca='pipe.yaml'",
            ),
            (
                "nats: {servers: [nats://h], devices: [127.0.0.1], token_file: pipe.yaml}\n",
                "nats.token_file: found 'pipe.yaml'",
            ),
        ],
        ids=["profile", "certificate", "token"],
    )
    def test_a_file_that_is_read_again_and_again_is_no_pipe(
        self, more: str, problem: str, tmp_path: Path
    ) -> None:
        os.mkfifo(tmp_path / "pipe.yaml")
        path = tmp_path / "p.yaml"
        path.write_text(GOOD + more)
        result = CliRunner().invoke(main, ["check", str(path)])
        assert result.exit_code == 2
        reason = "which can't be read: it is a named pipe, allowed: a regular file"
        assert result.stderr.splitlines()[0] == f"{path}:7: {problem}, {reason}"
