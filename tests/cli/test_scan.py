"""`holdfast scan` as a user has it: a process, its output, its signals, its exit codes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from nats.errors import NoRespondersError

from holdfast.scanner.messages.schema import json_schema
from support import wire
from support.brokers import NatsServer
from support.cli import done, invoke, usage_error
from support.commands import Command
from support.nats_bus import Caller, subscription, tag
from support.nats_keys import Operator, User

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import holdfast

    Start = Callable[..., Command]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `holdfast scan`; it is killed when the test ends."""
    started: list[Command] = []

    def scan(*options: str, **environment: str) -> Command:
        process = Command("scan", *options, environment={**os.environ, **environment})
        started.append(process)
        return process

    yield scan
    for process in started:
        process.kill()
        process.communicate()


def greeting(process: Command) -> str:
    """What it says first."""
    assert process.stdout is not None
    text = ""
    while "Ctrl-C stops it." not in text:
        line = process.stdout.readline()
        assert line, process.communicate()
        text += line
    return text


def connected(process: Command) -> None:
    """Waits until it says that it is connected."""
    assert process.stderr is not None
    for line in process.stderr:
        if "nats_connected" in line:
            return
    raise AssertionError(process.communicate())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_says_what_it_does_and_a_signal_ends_it(
    start: Start, nats: NatsServer, number: signal.Signals
) -> None:
    process = start("--prefix", "plant", NATS_SERVERS=f"127.0.0.1:{nats.port}")
    said = greeting(process)
    assert f"Scanning for subscribers at nats://127.0.0.1:{nats.port}." in said
    assert "plant.subscribe, plant.unsubscribe, plant.browse" in said
    assert (
        '  writes     every subscribed coil and holding register without "writable": false\n'
        "             by every NATS client that may publish to plant.subscribe, plant.command.>\n"
        "             narrowed by nats.writes (--writes): explicit or none; "
        "nats.devices (--allow); permissions in NATS\n"
    ) in said
    connected(process)
    process.send_signal(number)
    out, log = process.communicate(timeout=wire.DEADLINE)
    assert (process.returncode, out) == (0, "")
    assert log.splitlines()[-1].endswith("info stopped")
    assert "Traceback" not in log


def test_a_message_ends_it(start: Start, nats: NatsServer, caller: Caller) -> None:
    process = start("--nats", nats.url, "--log-format", "json")
    connected(process)
    # The subjects are subscribed to when the connection is there, a moment after it says so.
    wire.until(lambda: _answers(caller), "it answers")
    caller.publish("modbus.shutdown")
    _, log = process.communicate(timeout=wire.DEADLINE)
    assert process.returncode == 0
    assert "shutdown_asked" in [json.loads(line)["event"] for line in log.splitlines()]


def test_options_say_what_requests_leave_out_and_what_is_written(
    start: Start, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    logs = caller.listen("service.logs.>")
    options = "--timeout 700ms --publish change --deadband 0.5 --every 200ms --writes none --strict"
    more = "--no-publish-logs --no-keep-subscriptions"
    process = start("--nats", nats.url, *options.split(), *more.split())
    connected(process)
    wire.until(lambda: _answers(caller), "it answers")
    request = subscription(server, tag("a", 0, writable=True))
    del request["scanRate"]
    assert (
        "unknown field `more`"
        in caller.request("modbus.subscribe", {**request, "more": 1})["error"]
    )
    assert caller.request("modbus.subscribe", request)["success"]
    [found] = caller.request("modbus.browse", {"deviceId": "plc1"})["devices"]
    assert (found["timeout"], found["scanRate"]) == (700, 200)
    [subscriber] = found["subscribers"]
    assert (subscriber["publish"], subscriber["deadband"]) == ("change", 0.5)
    refused = caller.request("modbus.command.a", "1")
    assert "this scanner writes nothing (nats.writes is none)" in refused["error"]
    assert caller.kept("holdfast_scanner") == {}
    assert logs.take() == []


def test_it_serves_the_programs_of_tentacle_next(
    start: Start, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    data = caller.listen("plant.data.plc1.a")
    entry = {**subscription(server), "tags": [tag("a", 0)]}
    caller.put("scanner_config_plant", "hmi.plc1", entry)
    process = start("--nats", nats.url, "--dialect", "tentacle-next", "--prefix", "plant")
    said = greeting(process)
    assert "plant.data.DEVICE.TAG" in said
    assert "entries    bucket scanner_config_plant" in said
    assert data.next()["value"] == 0
    process.terminate()
    process.communicate(timeout=wire.DEADLINE)
    caller.forget("scanner_config_plant")
    caller.forget("service_enabled")


def _answers(caller: Caller) -> bool:
    try:
        return bool(caller.request("modbus.browse", b"")["success"])
    except NoRespondersError:
        return False


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ("--deadband 1", "--deadband requires --publish change."),
        ("--timeout 9ms", "'9ms' is not"),
        ("--every 49ms", "'49ms' is not a time"),
        ("--publish always", "'always' is not one of 'scan', 'change'"),
        ("--writes all", "'all' is not one of 'tags', 'explicit', 'none'"),
        ("--dialect next", "'next' is not one of 'tentacle', 'tentacle-next'"),
        (
            "--dialect tentacle-next --prefix a.b",
            "'--prefix': found 'a.b', allowed with dialect tentacle-next: no dots.",
        ),
    ],
)
def test_wrong_options_are_told(options: str, error: str) -> None:
    assert error in usage_error("scan", *options.split())


def test_secrets_are_used_and_not_shown(
    start: Start, tmp_path: Path, server: holdfast.Server
) -> None:
    own = NatsServer(tmp_path, "--user", "scan", "--pass", "s3cret")
    try:
        password = tmp_path / "password"
        password.write_text("s3cret\n")
        wrong = tmp_path / "wrong"
        wrong.write_text("guess")
        refused = start("--nats", own.url, "--user", "scan", "--password-file", str(wrong))
        assert refused.stderr is not None
        assert "started" in refused.stderr.readline()
        line = refused.stderr.readline()
        assert "nats_connect_failed" in line
        assert "uthorization" in line
        for options in (
            ("--nats", own.url, "--user", "scan", "--password-file", str(password)),
            ("--nats", f"nats://scan:s3cret@127.0.0.1:{own.port}"),
        ):
            process = start(*options)
            assert "s3cret" not in greeting(process)
            connected(process)
            with Caller(own.url.replace("//", "//scan:s3cret@")) as caller:
                data = caller.listen("modbus.data.plc1")
                _subscribe(caller, server)
                data.next()
            process.terminate()
            _, log = process.communicate(timeout=wire.DEADLINE)
            assert "s3cret" not in log
    finally:
        own.kill()


def test_a_new_password_is_used_after_sighup_and_a_wrong_file_changes_nothing(
    start: Start, tmp_path: Path, server: holdfast.Server
) -> None:
    own = NatsServer(tmp_path, "--user", "scan", "--pass", "s3cret")
    try:
        password = tmp_path / "password"
        password.write_text("guess")
        process = start("--nats", own.url, "--user", "scan", "--password-file", str(password))
        assert process.stderr is not None
        _await_line(process, "nats_connect_failed")
        password.write_bytes(b"\xff")
        process.send_signal(signal.SIGHUP)
        assert "is not UTF-8 text" in _await_line(process, "reload_refused")
        password.write_text("s3cret")
        process.send_signal(signal.SIGHUP)
        assert "changed=files" in _await_line(process, "reloaded")
        connected(process)
        process.send_signal(signal.SIGHUP)
        assert "changed=nothing" in _await_line(process, "reloaded")
        password.unlink()
        os.mkfifo(password)
        process.send_signal(signal.SIGHUP)
        assert "it is a named pipe" in _await_line(process, "reload_refused")
        with Caller(own.url.replace("//", "//scan:s3cret@")) as caller:
            data = caller.listen("modbus.data.plc1")
            _subscribe(caller, server)
            data.next()
        process.terminate()
        process.communicate(timeout=wire.DEADLINE)
        assert process.returncode == 0
    finally:
        own.kill()


@pytest.mark.parametrize("keep", [True, False])
def test_after_sighup_subscriptions_go_on_without_jetstream(
    start: Start, tmp_path: Path, server: holdfast.Server, keep: bool
) -> None:
    options = ("--user", "scan", "--pass", "s3cret")
    own = NatsServer(tmp_path, *options, jetstream=not keep)
    try:
        password = tmp_path / "password"
        password.write_text("s3cret")
        files = ("--user", "scan", "--password-file", str(password))
        more = () if keep else ("--no-keep-subscriptions",)
        process = start("--nats", own.url, *files, *more)
        connected(process)
        with Caller(own.url.replace("//", "//scan:s3cret@")) as caller:
            _subscribe(caller, server)
            password.write_text("s3cret\n")
            process.send_signal(signal.SIGHUP)
            assert "changed=files" in _await_line(process, "reloaded")
            _await_line(process, "restored")
            caller.listen("modbus.data.plc1").next()
    finally:
        own.kill()


def _await_line(process: Command, event: str) -> str:
    """The next line of the log that has this event."""
    assert process.stderr is not None
    for line in process.stderr:
        if event in line:
            return line
    raise AssertionError(process.communicate())


def test_credentials_are_used_and_not_shown(start: Start, tmp_path: Path) -> None:
    operator = Operator()
    own = NatsServer(tmp_path, "-c", str(operator.configure(tmp_path / "nats.conf")))
    try:
        user = User(operator.plant)
        process = start("--nats", own.url, "--creds", str(user.write(tmp_path / "scan.creds")))
        said = greeting(process)
        connected(process)
        process.terminate()
        _, log = process.communicate(timeout=wire.DEADLINE)
        assert process.returncode == 0
        for secret in (user.key.seed, user.jwt):
            assert secret not in said + log
    finally:
        own.kill()


def _subscribe(caller: Caller, server: holdfast.Server) -> None:
    """Subscribes as soon as the scanner serves."""

    def subscribed() -> bool:
        with contextlib.suppress(NoRespondersError):
            request = subscription(server, tag("a", 0))
            return bool(caller.request("modbus.subscribe", request)["success"])
        return False

    wire.until(subscribed, "it answers")


def test_it_brings_its_own_server_and_takes_it_along(
    start: Start, tmp_path: Path, server: holdfast.Server
) -> None:
    process = start("--embedded", "--nats", "nats://127.0.0.1:0", "--store", str(tmp_path / "kept"))
    found = re.search(r"nats://127\.0\.0\.1:([0-9]+)\.", greeting(process))
    assert found is not None
    port = int(found[1])
    connected(process)
    with Caller(f"nats://127.0.0.1:{port}") as caller:
        data = caller.listen("modbus.data.plc1")
        _subscribe(caller, server)
        data.next()
    assert process.stderr is not None
    while " heartbeat " not in (line := process.stderr.readline()):
        assert line
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=wire.DEADLINE)
    assert process.returncode == 0
    assert not _listens(port)
    assert (tmp_path / "kept" / "jetstream").is_dir()


LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="as only Linux has it")


@LINUX
def test_its_own_server_ends_even_when_it_is_killed(start: Start) -> None:
    process = start("--embedded", "--nats", "nats://127.0.0.1:0")
    found = re.search(r"nats://127\.0\.0\.1:([0-9]+)\.", greeting(process))
    assert found is not None
    process.kill()
    process.wait()
    wire.until(lambda: not _listens(int(found[1])), "the server has ended too")


@LINUX
def test_it_ends_with_its_own_server(start: Start) -> None:
    process = start("--embedded", "--nats", "nats://127.0.0.1:0")
    greeting(process)
    connected(process)
    lists = Path(f"/proc/{process.pid}/task").glob("*/children")
    [child] = [child for children in lists for child in children.read_text().split()]
    os.kill(int(child), signal.SIGKILL)
    _, log = process.communicate(timeout=wire.DEADLINE)
    assert process.returncode == 1
    assert "holdfast: nats-server ended: killed by signal 9" in log
    assert "Traceback" not in log


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def test_a_port_that_is_taken_is_one_line(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        process = start("--embedded", "--nats", f"nats://127.0.0.1:{port}")
        out, log = process.communicate(timeout=wire.DEADLINE)
    assert (process.returncode, out) == (1, "")
    assert log.startswith("holdfast: nats-server ended:")
    assert "address already in use" in log
    assert log.count("\n") == 1


def test_a_server_that_is_not_installed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    result = invoke("scan", "--embedded")
    assert result.exit_code == 1
    assert "nats-server is not installed" in result.stderr


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--nats", "http://localhost"], "found neither nats:// nor tls://, allowed: nats://host"),
        (["--nats", "nats://host:port"], "found an invalid host or port"),
        (["--nats", "nats://me:secret@"], "found no host"),
        (["--allow", "10.0.0.1/8"], "found '10.0.0.1/8', which has host bits set: the network is"),
        (["--allow", "example"], "found 'example', allowed: a network or an address"),
        (["--prefix", "a b"], "found 'a b', allowed: letters, digits"),
        (["--prefix", "a.>"], "found 'a.>', allowed: letters, digits"),
        (["--password-file", __file__], "--password-file requires --user."),
        (["--tls-cert", __file__], "--tls-cert requires --tls-key."),
        (["--device-key", __file__], "--device-key requires --device-cert."),
        (["--device-ca", "missing"], "'missing' does not exist."),
        (
            ["--user", "a", "--token-file", __file__],
            "--user and --token-file can't be used together.",
        ),
        (["--user", "a", "--creds", __file__], "--user and --creds can't be used together."),
        (["--creds", "missing"], "'missing' does not exist."),
        (["--store", "x"], "--store requires --embedded."),
        (["--embedded", "--nats", "nats://10.0.0.1"], "--embedded only serves at 127.0.0.1"),
        (["--embedded", "--user", "a"], "--embedded only serves at 127.0.0.1"),
        (["--partitions", "0"], "found 0, allowed: 1 to 4096."),
    ],
)
def test_wrong_usage_is_told(options: list[str], error: str) -> None:
    assert error in usage_error("scan", *options)


def test_a_wrong_server_in_the_environment_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NATS_SERVERS", "localhost:4222,ftp://x")
    assert "found neither nats:// nor tls://" in usage_error("scan")


def test_a_serial_device_is_allowed_beside_private_addresses(
    start: Start, nats: NatsServer
) -> None:
    said = greeting(start("--nats", f"{nats.url}/", "--allow", "/dev/ttyUSB7"))
    assert "devices    /dev/ttyUSB7, 127.0.0.0/8, 10.0.0.0/8, " in said


def test_the_schema_is_printed() -> None:
    assert json.loads("\n".join(done("scan", "--schema"))) == json_schema()


@pytest.mark.parametrize("option", ["--creds", "--tls-ca"])
def test_a_file_that_can_not_be_used_is_told(start: Start, nats: NatsServer, option: str) -> None:
    process = start("--nats", nats.url, option, __file__)
    _, log = process.communicate(timeout=wire.DEADLINE)
    assert process.returncode == 1
    assert "holdfast: " in log
    assert "Traceback" not in log


@pytest.mark.parametrize("embedded", [False, True])
def test_a_file_for_devices_that_can_not_be_used_is_told_before_anything_is_served(
    start: Start, nats: NatsServer, embedded: bool
) -> None:
    where = ("--embedded", "--nats", "nats://127.0.0.1:0") if embedded else ("--nats", nats.url)
    process = start(*where, "--device-ca", __file__)
    out, log = process.communicate(timeout=wire.DEADLINE)
    assert (process.returncode, out) == (1, "")
    assert log.startswith("holdfast: ")
    assert __file__ in log
    assert log.count("\n") == 1
