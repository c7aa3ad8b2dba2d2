"""Sessions over REST: listed and ended by tokens that may manage, and recorded."""

from __future__ import annotations

import contextlib
import hashlib
from typing import TYPE_CHECKING, Any

import pytest

from support import web, wire
from support.audits import lines
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Connect, Run

OPERATOR, WRITER = "secret-operator", "secret-writer"

CONFIGURATION = """
memories:
  plant: {{holding_registers: 10}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-write}}]
audit: {{file: audit.log}}
rest:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  tokens: {tokens}
"""

TOKEN = """
    - name: {name}
      sha256: "{digest}"
      memories: [plant]
      areas: [coils]
      access: {access}
{more}"""

SESSIONS, END = "/api/v1/sessions", "/api/v1/sessions/end"
WRITE = bytes.fromhex("0600070001")


def token(name: str, secret: str, access: str, more: str = "") -> str:
    digest = hashlib.sha256(secret.encode()).hexdigest()
    return TOKEN.format(name=name, digest=digest, access=access, more=more)


TOKENS = token("operator", OPERATOR, "read-only", "      manage: true\n") + token(
    "writer", WRITER, "read-write", "      manage: false\n"
)


@pytest.fixture
def appliance(run: Run) -> Appliance:
    return run(CONFIGURATION.format(tokens=TOKENS))


@contextlib.contextmanager
def client(appliance: Appliance, secret: str | None) -> Iterator[web.Client]:
    wire.until(
        lambda: appliance.diagnostics.stats()["adapters"]["rest"]["state"] == "running", "it runs"
    )
    with contextlib.closing(web.Client(endpoint(appliance, "rest"), secret)) as connected:
        yield connected


@pytest.fixture
def operator(appliance: Appliance) -> Iterator[web.Client]:
    with client(appliance, OPERATOR) as connected:
        yield connected


def end(asker: web.Client, body: Any) -> web.Answer:
    return asker.ask("POST", END, body)


def events(folder: Path) -> list[dict[str, Any]]:
    return [line for line in lines(folder / "audit.log") if line.get("event") == "session_ended"]


def test_a_token_that_may_manage_lists_and_ends_sessions(
    appliance: Appliance, operator: web.Client, connect: Connect, tmp_path: Path
) -> None:
    first, second = (connect(endpoint(appliance, "scada")) for _ in range(2))
    assert first.ask(WRITE) == second.ask(WRITE) == WRITE
    listed = operator.get(SESSIONS)
    assert listed.status == 200
    peers = ["{}:{}".format(*each.socket.getsockname()) for each in (first, second)]
    assert [each["peer"] for each in listed.json["sessions"]] == peers
    assert set(listed.json["sessions"][0]) == {"listener", "id", "peer", "opened", "idle"}
    wanted = f"scada/{listed.json['sessions'][1]['id']}"
    ended = end(operator, {"id": wanted})
    assert (ended.status, ended.json) == (200, {"status": "ended", "id": wanted})
    assert second.rest() == b""
    assert first.ask(WRITE) == WRITE
    assert [each["peer"] for each in operator.get(SESSIONS).json["sessions"]] == peers[:1]
    again = end(operator, {"id": wanted})
    assert (again.status, again.json["reason"]) == (404, "unknown_session")
    counted = appliance.diagnostics.stats()["listeners"]["scada"]["connections"]
    assert counted["ended"] == 1
    [recorded] = events(tmp_path)
    assert recorded["session"] == wanted
    assert recorded["session_peer"] == peers[1]
    assert (recorded["listener"], recorded["source"]) == ("rest", "operator")
    assert recorded["peer"].startswith("127.0.0.1:")


@pytest.mark.parametrize(
    ("tokens", "secret", "status", "reason"),
    [
        (TOKENS, WRITER, 403, "not_granted"),
        (TOKENS, "secret-unknown", 401, "unauthorized"),
        (TOKENS, None, 401, "unauthorized"),
        ("none", None, 403, "not_granted"),
        ("none", OPERATOR, 403, "not_granted"),
    ],
)
def test_nobody_else_may(
    run: Run, connect: Connect, tmp_path: Path, tokens: str, secret: str | None, status: int,
    reason: str,
) -> None:  # fmt: skip
    appliance = run(CONFIGURATION.format(tokens=tokens))
    peer = connect(endpoint(appliance, "scada"))
    assert peer.ask(WRITE) == WRITE
    number = appliance.sessions()[0]["id"]
    with client(appliance, secret) as asker:
        for answer in (asker.get(SESSIONS), end(asker, {"id": f"scada/{number}"})):
            assert (answer.status, answer.json["reason"]) == (status, reason)
            assert "127.0.0.1" not in answer.body.decode()
    assert peer.ask(WRITE) == WRITE
    assert events(tmp_path) == []


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{}",
        b"[]",
        b'{"id": 17}',
        b'{"id": "17"}',
        b'{"id": "scada/"}',
        b'{"id": "/17"}',
        b'{"id": "scada/north/17"}',
        b'{"id": "scada/-1"}',
        b'{"id": "scada/18446744073709551616"}',
        b'{"id": "scada/17", "force": true}',
        b'{"id": "scada/\xff"}',
        b'{"id": "' + b"x" * 5000 + b'"}',
    ],
)
def test_a_malformed_request_ends_nothing(operator: web.Client, body: bytes) -> None:
    answer = end(operator, body)
    assert (answer.status, answer.json["reason"]) == (400, "malformed")
    assert len(answer.body) < 400


@pytest.mark.parametrize("wanted", ["scada/18446744073709551615", "other/0", "\u2028/0"])
def test_a_session_that_is_not_there(operator: web.Client, wanted: str) -> None:
    answer = end(operator, {"id": wanted})
    assert (answer.status, answer.json["reason"]) == (404, "unknown_session")


def test_the_body_is_json(operator: web.Client) -> None:
    answer = operator.ask("POST", END, b'{"id": "scada/0"}', {"Content-Type": "text/plain"})
    assert (answer.status, answer.json["reason"]) == (415, "not_json")
