"""`holdfast gateway` over HTTPS: its options, what it prints, and whom it serves."""

from __future__ import annotations

import re
import signal
from typing import TYPE_CHECKING

import pytest

from support import web
from support.certificates import Certificates, Issued
from support.cli import ServingCommand, usage_error
from support.tls_peer import context

if TYPE_CHECKING:
    from pathlib import Path

ALLOW = ("gateway", "--bind", "127.0.0.1:0", "--allow", "127.0.0.1")


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="module")
def server(authority: Certificates) -> Issued:
    return authority.issue("server", "DNS:localhost,IP:127.0.0.1")


def options(server: Issued, **more: Path) -> list[str]:
    files = {"cert": server.certificate, "key": server.key, **more}
    return [part for name, file in files.items() for part in (f"--https-{name}", str(file))]


def test_console_and_api_are_served_over_https(authority: Certificates, server: Issued) -> None:
    client_ca = ("--https-client-ca", str(authority.ca))
    command = ServingCommand(*ALLOW, *options(server), *client_ca)
    greeting = command.wait_for_greeting()
    match = re.search(r"Console: https://([0-9.]+):([0-9]+)/,", greeting)
    assert match, greeting
    assert f"curl https://{match[1]}:{match[2]}/api/modbus/connect" in greeting
    panel = authority.issue("panel", "DNS:panel")
    client = web.Client((match[1], int(match[2])), tls=context(authority.ca, panel))
    assert client.get("/").status == 200
    origin = {"Origin": f"https://{match[1]}:{match[2]}", "Content-Type": "application/json"}
    answer = client.ask("POST", "/api/modbus/connect", {"host": "10.0.0.1"}, origin)
    assert (answer.status, answer.headers["holdfast-reason"]) == (403, "refused_target")
    client.close()
    assert command.end(signal.SIGTERM)[0] == 0


def test_wrong_options_are_named(authority: Certificates, server: Issued) -> None:
    cert, key = str(server.certificate), str(server.key)
    cases = {
        ("--https-cert", cert): "--https-cert requires --https-key.",
        ("--https-key", key): "--https-key requires --https-cert.",
        ("--https-client-ca", cert): "--https-passphrase-file and --https-client-ca require "
        "--https-cert.",
        ("--https-cert", str(authority.ca), "--https-key", key): "HTTPS: "
        f"{key}: it is not the key of the certificate in {authority.ca}.",
    }
    for given, message in cases.items():
        assert usage_error(*ALLOW, *given) == f"Error: {message}"
