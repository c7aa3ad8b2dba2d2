"""Commands whose standard output can't take what they print."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast.cli import standard_output
from holdfast.events.writer import QueuedHandler
from holdfast.server import Identity
from support import cli, wire
from support.brokers import free_port

if TYPE_CHECKING:
    from collections.abc import Sequence

HOLDFAST = (sys.executable, "-m", "holdfast")
FULL = Path("/dev/full")
TELEGRAF = """
[[inputs.modbus]]
  name = "a"
  controller = "tcp://a:502"
  slave_id = 1
  timeout = "1s"
  holding_registers = [
    {name = "b", byte_order = "AB", data_type = "UINT16", scale = 1.0, address = [0]},
  ]
"""

with_full = pytest.mark.skipif(not FULL.exists(), reason="the system has no /dev/full")


@with_full
@pytest.mark.parametrize("words", [("--help",), ("find", "--help"), ("cert", "--help")])
def test_a_full_disk_is_one_line_of_error(words: Sequence[str]) -> None:
    with FULL.open("wb") as full:
        ended = subprocess.run(
            [*HOLDFAST, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    told = "holdfast: standard output: No space left on device\n"
    assert (ended.returncode, ended.stderr) == (1, told)


@with_full
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_a_full_standard_error_changes_no_exit_code(tmp_path: Path, encoding: str) -> None:
    device = "devices: {a: {url: tcp://a, interval: 1, tags: {x: {area: coils, address: %s}}, %s}}"
    wrong, right = tmp_path / "wrong.yaml", tmp_path / "right.yaml"
    wrong.write_text(device % (-1, ""))
    right.write_text(device % (1, "tolerance: {pause: 2}"))  # Warns of the pause.
    source = tmp_path / "telegraf.conf"
    source.write_text(TELEGRAF)
    # Python prints the error again at its end, unless it does not buffer.
    env = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    env["PYTHONIOENCODING"] = encoding
    for words, code in (
        (("check", right), 0),
        (("check", wrong), 2),
        (("check", "--nope"), 2),
        (("import", "telegraf", source), 0),
    ):
        with FULL.open("wb") as full:
            ended = subprocess.run(
                [*HOLDFAST, *words], stdout=subprocess.PIPE, stderr=full, env=env, check=False
            )
        assert ended.returncode == code


@with_full
def test_log_lines_that_a_full_standard_error_loses_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with FULL.open("w") as full:
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, full)
        standard_output.prepare()
        handler = QueuedHandler(sys.stderr)
        handler.emit(logging.makeLogRecord({"msg": "lost"}))
        handler.flush()
        assert handler.dropped == 1


@with_full
def test_tags_that_a_full_disk_leaves_unwritten_are_named(tmp_path: Path) -> None:
    tags = tmp_path / "tags.yaml"
    place = "area: holding_registers, writable: true"
    rows = [f"  {name}: {{{place}, address: {at}}}" for at, name in enumerate("abc")]
    tags.write_text("\n".join(["tags:", *rows]))
    memory = holdfast.Memory(holding_registers=3)
    with (
        FULL.open("wb") as full,
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server,
    ):
        ended = subprocess.run(
            [*HOLDFAST, "write", cli.url(server), "a=1", "b=2", "c=3", "--tags", str(tags)],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    told = "Written: a = 1\nNot written: b, c\nholdfast: standard output: No space left on device\n"
    assert (ended.returncode, ended.stderr) == (1, told)
    assert memory.read("holding_registers", 0, 3) == [1, 0, 0]


@with_full
@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("hr 0 7", "Written: holding_registers 0, 1 request."),
        ("hr 0 7 --json", "Written: holding_registers 0, 1 request."),
        ("a=7 --tags TAGS --json", "Written: a"),
    ],
)
def test_what_was_written_is_told_on_a_full_disk(tmp_path: Path, words: str, told: str) -> None:
    tags = tmp_path / "tags.yaml"
    tags.write_text("tags: {a: {area: holding_registers, address: 0, writable: true}}")
    memory = holdfast.Memory(holding_registers=3)
    with (
        FULL.open("wb") as full,
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server,
    ):
        command = [*HOLDFAST, "write", cli.url(server), *words.replace("TAGS", str(tags)).split()]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    full_disk = "holdfast: standard output: No space left on device"
    assert (ended.returncode, ended.stderr.splitlines()) == (1, [told, full_disk])
    assert memory.read("holding_registers", 0, 1) == [7]


@with_full
def test_a_service_runs_although_nobody_can_read_its_greeting() -> None:
    port = free_port()
    with FULL.open("wb") as full:
        running = subprocess.Popen(
            [*HOLDFAST, "simulate", "--bind", f"127.0.0.1:{port}"], stdout=full
        )
    try:

        def serves() -> bool:
            try:
                with holdfast.SyncClient(f"tcp://127.0.0.1:{port}", timeout=1) as client:
                    return len(client.read_input_registers(0, 1)) == 1
            except holdfast.ConnectionLost:
                assert running.poll() is None
                return False

        wire.until(serves, "it serves")
        running.send_signal(signal.SIGTERM)
        assert running.wait(wire.DEADLINE) == 0
    finally:
        running.kill()
        running.wait()


@pytest.mark.skipif(sys.platform == "win32", reason="its pipes can't be filled without waiting")
def test_a_service_runs_although_nobody_reads_its_greeting(tmp_path: Path) -> None:
    config = tmp_path / "plant.yaml"
    rule = "sources: [127.0.0.0/8], units: {1: plant}, access: read-only"
    listener = f"type: modbus-tcp, bind: 127.0.0.1:0, rules: [{{{rule}}}]"
    config.write_text(f"memories: {{plant: {{coils: 1}}}}\nlisteners: {{scada: {{{listener}}}}}")
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, b"x")
    os.set_blocking(writer, True)
    running = subprocess.Popen([*HOLDFAST, "run", str(config)], stdout=writer)
    try:
        # A reload is what the main thread does behind the greeting.
        wire.until(lambda: cli.invoke("reload", str(config)).exit_code == 0, "it takes requests")
        running.send_signal(signal.SIGTERM)
        assert running.wait(wire.DEADLINE) == 0
    finally:
        running.kill()
        running.wait()
        os.close(reader)
        os.close(writer)


def test_text_of_a_device_that_the_encoding_does_not_have_is_escaped() -> None:
    memory = holdfast.Memory(holding_registers=10)
    identity = Identity(vendor_name="Ωmega")
    with holdfast.Server(
        {1: memory}, bind="127.0.0.1:0", access="read-only", identity=identity
    ) as server:
        ended = subprocess.run(
            [*HOLDFAST, "describe", "identify", cli.url(server)],
            env={**os.environ, "PYTHONIOENCODING": "cp1252"},
            capture_output=True,
            check=False,
        )
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert rb"\u03a9mega" in ended.stdout


class Stream(io.TextIOWrapper):
    """Standard output of Windows, which is a terminal or not."""

    def __init__(self, *, is_terminal: bool) -> None:
        super().__init__(io.BytesIO(), encoding="cp1252")
        self._is_terminal = is_terminal

    def isatty(self) -> bool:
        return self._is_terminal


@pytest.mark.parametrize(
    ("platform", "is_terminal", "demanded", "encoding"),
    [
        ("win32", False, "", "utf-8"),
        ("win32", False, "cp1252", "cp1252"),
        ("win32", True, "", "cp1252"),
        ("linux", False, "", "cp1252"),
    ],
)
def test_files_and_pipes_of_windows_get_utf_8(
    monkeypatch: pytest.MonkeyPatch, platform: str, is_terminal: bool, demanded: str, encoding: str
) -> None:
    stream = Stream(is_terminal=is_terminal)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setenv("PYTHONIOENCODING", demanded)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    standard_output.prepare()
    assert (stream.encoding, stream.errors) == (encoding, "backslashreplace")


def test_a_reader_that_is_gone_is_an_invalid_argument_on_windows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone = OSError(errno.EINVAL, "Invalid argument")
    gone.winerror = None  # type: ignore[attr-defined]
    refused = OSError(errno.EINVAL, "The remote computer refused the network connection")
    refused.winerror = 1225  # type: ignore[attr-defined]
    assert not standard_output.is_unwritable(gone)
    monkeypatch.setattr(sys, "platform", "win32")
    assert standard_output.is_unwritable(gone)
    assert standard_output.reason(gone) == "Broken pipe"
    assert not standard_output.is_unwritable(refused)
    assert not standard_output.is_unwritable(OSError(errno.EINVAL, "Invalid argument", "a.yaml"))


@pytest.mark.skipif(sys.platform == "win32", reason="a shell of Unix closes the streams")
@pytest.mark.parametrize(
    ("closed", "words", "code"),
    [
        (">&-", "describe map {url} --areas hr --range 0-9", 0),
        ("2>&-", "find {url} --units 1", 0),
        ("2>&-", "read {url} hr:0", 0),
        ("<&-", "watch {url} hr:0 --times 1", 0),
        ("<&- >&- 2>&-", "describe {url} --units 1 --range 0-9", 0),
    ],
)
def test_a_closed_stream_is_no_crash(closed: str, words: str, code: int) -> None:
    memory = holdfast.Memory(holding_registers=3)
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only") as server:
        command = [*HOLDFAST, *words.format(url=cli.url(server)).split()]
        ended = subprocess.run(
            ["sh", "-c", f'exec "$@" {closed}', "sh", *command],
            capture_output=True,
            text=True,
            check=False,
        )
    assert (ended.returncode, "Traceback" in ended.stderr) == (code, False), ended.stderr
