"""`holdfast health`: exit codes and outputs, against a running appliance."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.brokers import free_port
from support.certificates import Certificates
from support.cli import RunCommand, answer, done, invoke, usage_error
from support.config_folder import written
from support.machine import has_ipv6

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any


needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="needs IPv6")

RULES = [{"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-only"}]
PLANT = {
    "memories": {"plant": {"coils": 8}},
    "listeners": {"scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": RULES}},
}


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Callable[..., RunCommand]]:
    """Runs an appliance of `plant.yaml` with these sections."""
    commands: list[RunCommand] = []

    def start(**sections: Any) -> RunCommand:
        file = tmp_path / "plant.yaml"
        file.write_text(written({**PLANT, **sections}))
        commands.append(RunCommand(file))
        commands[-1].wait_for_greeting()
        return commands[-1]

    yield start
    for command in commands:
        command.process.kill()
        command.process.communicate()


def test_an_appliance_that_serves_is_ready_until_it_ends(
    run: Callable[..., RunCommand], tmp_path: Path
) -> None:
    port = free_port()
    appliance = run(metrics={"bind": f"127.0.0.1:{port}"})
    file, url = str(tmp_path / "plant.yaml"), f"http://127.0.0.1:{port}"
    wire.until(lambda: invoke("health", file).exit_code == 0, "it is ready")
    lines = done("health", "--url", url)
    assert lines[0] == "ready"
    assert [line.split()[:2] for line in lines[2:]] == [
        [name, "ok"] for name in ("running", "threads", "listeners", "services", "devices", "logs")
    ]
    assert done("health", file, "--live")[0] == "live"
    found = answer("health", file)
    assert (found["ok"], found["checks"]["logs"]) == (True, {"ok": True, "detail": "none"})
    assert appliance.end(signal.SIGTERM)[0] == 0
    result = invoke("health", file)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith(f"holdfast: {url}/health/ready: ")
    assert answer("health", file, code=1)["detail"] == os.strerror(errno.ECONNREFUSED)


def test_the_running_appliance_is_asked_whatever_is_in_its_file(
    run: Callable[..., RunCommand], tmp_path: Path
) -> None:
    """An edited file takes effect with a reload. An appliance that serves must not be killed for
    it, as containers are that are not healthy."""
    appliance = run(metrics={"bind": "127.0.0.1:0"})  # Only the appliance knows its port.
    path = tmp_path / "plant.yaml"
    file, kept = str(path), path.read_text()
    wire.until(lambda: invoke("health", file).exit_code == 0, "it is ready")
    metrics, port = {"metrics": {"bind": f"127.0.0.1:{free_port()}"}}, free_port()
    for edited in ("wrong: 1\n", written(PLANT), written({**PLANT, **metrics})):
        path.write_text(edited)
        assert done("health", file)[0] == "ready"
    path.write_text(written({**PLANT, "metrics": {"bind": f"127.0.0.1:{port}"}}))
    done("reload", file)
    assert answer("health", file)["target"] == f"http://127.0.0.1:{port}/health/ready"
    path.write_text(written(PLANT))
    done("reload", file)
    path.write_text(kept)
    assert "no section `metrics` or `gateway`" in usage_error("health", file)
    path.write_text("wrong: 1\n")
    assert appliance.end(signal.SIGTERM)[0] == 0
    assert invoke("health", file).exit_code == 2


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system has no /proc")
def test_a_process_that_hangs_does_not_answer_in_time(
    run: Callable[..., RunCommand], tmp_path: Path
) -> None:
    process = run(metrics={"bind": f"127.0.0.1:{free_port()}"}).process
    file = str(tmp_path / "plant.yaml")
    wire.until(lambda: invoke("health", file).exit_code == 0, "it is ready")
    process.send_signal(signal.SIGSTOP)
    threads = Path(f"/proc/{process.pid}/task")
    wire.until(
        lambda: all("\nState:\tT" in each.read_text() for each in threads.glob("*/status")),
        "all its threads have stopped",
    )
    result = invoke("health", file, "--live", "--timeout", "0.5")
    assert (result.exit_code, "no answer in 0.5 s" in result.stderr) == (1, True)
    assert answer("health", file, "--timeout", "0.1", code=1)["reason"] == "connection"
    process.send_signal(signal.SIGCONT)
    wire.until(lambda: invoke("health", file, "--live").exit_code == 0, "it is live")


def test_a_check_that_fails_is_shown(run: Callable[..., RunCommand], tmp_path: Path) -> None:
    metrics = {"bind": f"127.0.0.1:{free_port()}"}
    with socket.create_server(("127.0.0.1", 0)) as taken:
        rest = {"sources": ["127.0.0.0/8"], "tokens": "none"}
        run(metrics=metrics, rest={"bind": f"127.0.0.1:{taken.getsockname()[1]}", **rest})
        file = str(tmp_path / "plant.yaml")
        wire.until(lambda: invoke("health", file).stdout != "", "it answers")
        result = invoke("health", file)
        assert result.exit_code == 1
        assert result.stdout.splitlines()[0] == "not ready"
        assert ["services", "failed", "not", "serving:", "rest"] in [
            line.split() for line in result.stdout.splitlines()
        ]
        assert answer("health", file, code=1)["checks"]["services"]["ok"] is False
        assert invoke("health", file, "--live").exit_code == 0


def test_the_gateway_is_asked_where_there_are_no_metrics(
    run: Callable[..., RunCommand], tmp_path: Path
) -> None:
    gateway = {"sources": ["127.0.0.0/8"], "allow": ["127.0.0.1"], "access": "read-only"}
    run(gateway={"bind": f"127.0.0.1:{free_port()}", "tokens": "none", **gateway})
    file = str(tmp_path / "plant.yaml")
    wire.until(lambda: invoke("health", file).exit_code == 0, "it is ready")


@needs_ipv6
@pytest.mark.parametrize("source", ["127.0.0.0/8", "::1"])
def test_what_listens_everywhere_is_asked_from_a_source_that_it_admits(
    run: Callable[..., RunCommand], tmp_path: Path, source: str
) -> None:
    run(metrics={"bind": f"[::]:{free_port()}", "sources": [source]})
    file = str(tmp_path / "plant.yaml")
    wire.until(lambda: invoke("health", file).exit_code == 0, "it is ready")


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("[::]", marks=needs_ipv6)])
def test_sources_without_this_machine_are_told(
    run: Callable[..., RunCommand], tmp_path: Path, host: str
) -> None:
    run(metrics={"bind": f"{host}:{free_port()}", "sources": ["10.0.0.0/8"]})
    found = answer("health", str(tmp_path / "plant.yaml"), code=1)
    assert (found["ok"], found["reason"]) == (False, "connection")
    assert found["detail"].endswith("; metrics.sources does not contain 127.0.0.1")


def test_https_is_verified_where_authorities_are_given(
    run: Callable[..., RunCommand], tmp_path: Path
) -> None:
    authority, stranger = Certificates(tmp_path), Certificates(tmp_path, "stranger")
    issued = authority.issue("server", "IP:127.0.0.1")
    client = authority.issue("probe", "DNS:probe")
    files = {"cert_file": issued.certificate, "key_file": issued.key}
    tls = {**files, "client_ca_file": authority.ca}
    port = free_port()
    run(metrics={"bind": f"127.0.0.1:{port}", "tls": {k: str(v) for k, v in tls.items()}})
    file, url = str(tmp_path / "plant.yaml"), f"https://127.0.0.1:{port}"
    own = ("--tls-cert", str(client.certificate), "--tls-key", str(client.key))
    wire.until(lambda: invoke("health", file, *own).exit_code == 0, "it is ready")
    assert invoke("health", "--url", url, "--tls-ca", str(authority.ca), *own).exit_code == 0
    for unverified in ((), ("--tls-ca", str(stranger.ca))):
        result = invoke("health", "--url", url, *unverified, *own)
        assert (result.exit_code, "CERTIFICATE_VERIFY_FAILED" in result.stderr) == (1, True)
    assert invoke("health", file).exit_code == 1


def test_an_encrypted_key_is_unusable_and_no_passphrase_is_asked_for(tmp_path: Path) -> None:
    issued = Certificates(tmp_path).issue("probe", "DNS:probe", "-passout", "pass:secret")
    own = ("--tls-cert", str(issued.certificate), "--tls-key", str(issued.key))
    # Without a terminal, OpenSSL would read the passphrase from standard input.
    ended = subprocess.run(
        [sys.executable, "-m", "holdfast", "health", "--url", "https://127.0.0.1:1", *own],
        input="secret\n",
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,
        timeout=wire.DEADLINE,
    )
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "Error: TLS: [SSL] " in ended.stderr
    assert "pass phrase" not in ended.stderr


@pytest.fixture
def server() -> Iterator[Callable[[bytes], str]]:
    """Serves these bytes to one client, whose connection stays open. Returns the URL."""
    open_sockets: list[socket.socket] = []

    def serve(reply: bytes) -> str:
        listening = socket.create_server(("127.0.0.1", 0))
        open_sockets.append(listening)

        def once() -> None:
            connection, _ = listening.accept()
            open_sockets.append(connection)
            connection.recv(4096)
            connection.sendall(reply)

        threading.Thread(target=once, daemon=True).start()
        return f"http://127.0.0.1:{listening.getsockname()[1]}"

    yield serve
    for each in open_sockets:
        each.close()


def http(status: str, body: bytes) -> bytes:
    return b"HTTP/1.1 %b\r\nContent-Length: %d\r\n\r\n%b" % (status.encode(), len(body), body)


@pytest.mark.parametrize(
    ("reply", "told"),
    [
        (b"", "no answer in 0.3 s"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\n{", "no answer in 0.3 s"),
        (b"\x00\x01not http\r\n\r\n", "\\x00"),
        (http("200 OK", b'{"status":"ok"}'), "status 200, not the answer of an appliance"),
        (http("404 Not Found", b"[]"), "status 404, not the answer of an appliance"),
        (
            http("200 OK", b'{"ok":true,"checks":{"a":1}}'),
            "status 200, not the answer of an appliance",
        ),
        (http("200 OK", b"[" * 100_000), "status 200, not the answer of an appliance"),
    ],
)
def test_what_is_not_an_answer_is_a_failure(
    server: Callable[[bytes], str], reply: bytes, told: str
) -> None:
    timeout = "0.3" if "0.3" in told else "60"
    result = invoke("health", "--url", server(reply), "--timeout", timeout)
    assert (result.exit_code, result.stdout) == (1, "")
    assert told in result.stderr


@pytest.mark.parametrize("host", ["a..b", "x y", "a" * 64])
def test_a_host_that_is_no_name_gives_no_answer(host: str) -> None:
    result = invoke("health", "--url", f"http://{host}:80", "--timeout", "60")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "no answer in" not in result.stderr


def test_a_slow_answer_does_not_take_longer_than_the_timeout() -> None:
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            connection, _ = listening.accept()
            with connection, contextlib.suppress(OSError):
                connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 200\r\n\r\n")
                for _ in range(200):
                    connection.sendall(b" ")
                    if ended.wait(0.05):
                        break

        dripping = threading.Thread(target=drip)
        dripping.start()
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        result = invoke("health", "--url", url, "--timeout", "0.5")
        ended.set()
        dripping.join()
    assert (result.exit_code, "no answer in 0.5 s" in result.stderr) == (1, True)


@pytest.mark.parametrize(
    ("status", "ok", "code"), [("200 OK", True, 0), ("200 OK", False, 1), ("503 No", True, 1)]
)
def test_only_a_good_answer_with_a_good_status_is_ready(
    server: Callable[[bytes], str], status: str, ok: bool, code: int
) -> None:
    """As of a proxy that changes the status."""
    body = json.dumps({"ok": ok, "checks": {"a": {"ok": ok, "detail": ""}}}).encode()
    result = invoke("health", "--url", server(http(status, body)))
    assert (result.exit_code, result.stdout.startswith("ready\n")) == (code, code == 0)


def test_texts_of_a_stranger_are_shown_without_control_characters(
    server: Callable[[bytes], str],
) -> None:
    body = json.dumps(
        {"ok": False, "checks": {"a\x1b": {"ok": False, "detail": "\x1b[2J"}}}
    ).encode()
    result = invoke("health", "--url", server(http("503 No", body)))
    assert (result.exit_code, "\x1b" in result.stdout) == (1, False)
    assert r"\x1b[2J" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "Give either FILE or --url."),
        (("plant.yaml", "--url", "http://127.0.0.1:1"), "Give either FILE or --url."),
        (("--url", "127.0.0.1:9464"), "allowed: http://HOST[:PORT]"),
        (("--url", "http://127.0.0.1:9464/metrics"), "allowed: http://HOST[:PORT]"),
        (("--url", "http://127.0.0.1:99999"), "allowed: http://HOST[:PORT]"),
        (("--url", "http://[::1:80"), "allowed: http://HOST[:PORT]"),
        (("--url", "http://127.0.0.1:1", "--timeout", "0"), "is not a time"),
        (("--url", "https://127.0.0.1:1", "--tls-cert", __file__), "requires --tls-key"),
    ],
)
def test_wrong_usage(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("health", *arguments)


def test_a_configuration_that_answers_no_probes_is_wrong_usage(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(written(PLANT))
    assert "no section `metrics` or `gateway`" in usage_error("health", str(file))
    file.write_text(written({**PLANT, "metrics": {"bind": "127.0.0.1:0"}}))
    assert "metrics.bind has port 0: use --url." in usage_error("health", str(file))
    file.write_text("memories: 1\n")
    result = invoke("health", str(file))
    assert (result.exit_code, result.stdout) == (2, "")
    assert "plant.yaml:1: memories: " in result.stderr
