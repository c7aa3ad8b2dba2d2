"""The scanner and the gateway as parts of an appliance."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import signal
import socket
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from nats.errors import NoRespondersError

from holdfast.config import load
from holdfast.events import log_lines
from support import web, wire
from support.brokers import NatsServer, free_port
from support.cli import RunCommand as Command
from support.nats_bus import Caller, subscription, tag
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import holdfast
    from holdfast.appliance import Appliance
    from support.running import Run

    Start = Callable[[str], Command]

NATS = """
nats:
  servers: ["{url}"]
  devices: [127.0.0.0/8]
  prefix: {prefix}
"""
GATEWAY = """
gateway:
  bind: 127.0.0.1:{port}
  sources: [127.0.0.0/8]
  allow: ["127.0.0.0/8:*"]
  access: {access}
  tokens: {tokens}
"""
METRICS = """
metrics: {bind: 127.0.0.1:0}
"""
MODBUS = """
memories: {plant: {holding_registers: 8}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
"""


def nats_section(url: str, prefix: str = "plant") -> str:
    return NATS.format(url=url, prefix=prefix)


def gateway_section(port: int = 0, access: str = "read-only", tokens: str = "none") -> str:
    return GATEWAY.format(port=port, access=access, tokens=tokens)


def status(appliance: Appliance, name: str) -> dict[str, Any]:
    found = appliance.diagnostics.adapter(name)
    assert found is not None
    return found


def until_connected(appliance: Appliance) -> None:
    wire.until(lambda: status(appliance, "nats").get("connected"), "the scanner is connected")


def ask(appliance: Appliance, path: str, body: Any, secret: str | None = None) -> web.Answer:
    client = web.Client(endpoint(appliance, "gateway"), secret)
    with contextlib.closing(client):
        return client.ask("POST", f"/api/modbus{path}", body)


def read(server: holdfast.Server, address: int = 0) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": server.address[1], "functionCode": 3, "address": address}


@pytest.fixture
def log() -> Iterator[web.Records]:
    records = web.Records()
    log_lines.LOGGER.addHandler(records)
    log_lines.LOGGER.setLevel("INFO")
    yield records
    log_lines.LOGGER.removeHandler(records)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts `holdfast run`; it is killed when the test ends."""
    started: list[Command] = []

    def run(text: str) -> Command:
        file = tmp_path / "plant.yaml"
        file.write_text(text)
        started.append(Command(file))
        return started[-1]

    yield run
    for each in started:
        each.process.kill()
        each.process.communicate()


# The gateway.


def test_devices_are_read_over_http_and_not_written(run: Run, server: holdfast.Server) -> None:
    appliance = run(gateway_section())
    assert ask(appliance, "/read", read(server)).json["values"] == [0]
    write = {"host": "127.0.0.1", "port": server.address[1], "address": 0, "value": 7}
    refused = ask(appliance, "/write/register", write)
    assert (refused.status, refused.headers["holdfast-reason"]) == (403, "writes_off")
    assert "access: read-write in the configuration" in refused.json["error"]
    page = web.Client(endpoint(appliance, "gateway"))
    with contextlib.closing(page):
        assert b"<title>" in page.get("/").body


def test_devices_are_written_where_the_configuration_lets_it(
    run: Run, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    appliance = run(gateway_section(access="read-write"))
    write = {"host": "127.0.0.1", "port": server.address[1], "address": 3, "value": 7}
    assert ask(appliance, "/write/register", write).json["success"] is True
    assert memory.read("holding_registers", 3, 1) == [7]


def test_a_device_outside_the_list_is_refused(run: Run, server: holdfast.Server) -> None:
    text = gateway_section().replace("127.0.0.0/8:*", f"127.0.0.1:{server.address[1]}")
    appliance = run(text)
    assert ask(appliance, "/read", read(server)).status == 200
    other = ask(appliance, "/read", {**read(server), "port": server.address[1] ^ 1})
    assert (other.status, other.headers["holdfast-reason"]) == (403, "refused_target")


def test_requests_need_a_token_where_there_are_some(run: Run, server: holdfast.Server) -> None:
    digest = hashlib.sha256(b"secret").hexdigest()
    appliance = run(gateway_section(tokens=f"[{{name: panel, sha256: {digest}}}]"))
    assert ask(appliance, "/read", read(server)).status == 401
    assert ask(appliance, "/read", read(server), "secret").status == 200


PROFILES = """
profiles:
  tank:
    tags:
      level: {area: holding_registers, address: 5, scale: 0.1, unit: mm}
"""


def test_profiles_can_be_viewed_by_name(
    run: Run, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 5, [215])
    appliance = run(gateway_section() + PROFILES)
    target = {"host": "127.0.0.1", "port": server.address[1]}
    body = {**target, "parts": [{"profile": "tank", "only": ["level"]}], "once": True}
    answer = ask(appliance, "/watch/view", body)
    assert answer.status == 200
    data = answer.body.decode().partition("data: ")[2]
    assert json.loads(data)["parts"][0]["texts"] == ["21.5"]


def test_the_gateway_tells_its_figures(run: Run, server: holdfast.Server) -> None:
    appliance = run(gateway_section(access="read-write") + METRICS)
    ask(appliance, "/read", read(server))
    ask(appliance, "/read", {**read(server), "host": "10.0.0.1"})
    ask(appliance, "/read", {**read(server), "port": free_port()})
    ask(appliance, "/write/register", {**read(server), "functionCode": 6})
    target = {"host": "127.0.0.1", "port": server.address[1]}
    ask(appliance, "/write/register", {**target, "address": 0, "value": 1})
    told = status(appliance, "gateway")
    host, port = endpoint(appliance, "gateway")
    assert {key: told[key] for key in ("address", "requests", "refused", "failed", "writes")} == {
        "address": f"{host}:{port}",
        "requests": 5,
        "refused": {"refused_target": 1, "malformed": 1},
        "failed": 1,
        "writes": 1,
    }
    assert (told["state"], told["connections"]["accepted"]) == ("running", 5)
    metrics = scraped(appliance)
    assert 'holdfast_adapter_status{adapter="gateway",field="requests"} 5.0' in metrics
    assert 'holdfast_ingest_refused_total{adapter="gateway",reason="malformed"} 1.0' in metrics
    assert 'holdfast_adapter_connections_accepted_total{adapter="gateway"} 5.0' in metrics


def scraped(appliance: Appliance) -> str:
    client = web.Client(endpoint(appliance, "metrics"))
    with contextlib.closing(client):
        return client.get("/metrics").body.decode()


# The scanner.


def subscribed(caller: Caller, server: holdfast.Server, prefix: str = "plant") -> dict[str, Any]:
    """The answer to a subscription, as soon as somebody answers."""
    answers: list[dict[str, Any]] = []

    def answered() -> bool:
        with contextlib.suppress(NoRespondersError):
            request = subscription(server, tag("a", 5))
            answers.append(caller.request(f"{prefix}.subscribe", request))
        return bool(answers)

    wire.until(answered, "the scanner answers")
    return answers[-1]


def test_devices_are_polled_for_subscribers(
    run: Run, nats: NatsServer, caller: Caller, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 5, [4711])
    appliance = run(nats_section(nats.url) + METRICS)
    data = caller.listen("plant.data.plc1")
    assert subscribed(caller, server) == {"success": True, "count": 1}
    assert data.next()["value"] == 4711
    wire.until(lambda: status(appliance, "nats")["published"] > 1, "its figures tell of it")
    told = status(appliance, "nats")
    assert (told["state"], told["connected"], told["devices"]) == ("running", True, 1)
    assert (told["servers"], told["prefix"]) == ([nats.url], "plant")
    assert 'holdfast_adapter_status{adapter="nats",field="devices"} 1.0' in scraped(appliance)


def reload(appliance: Appliance, file: Path, text: str) -> None:
    """Reloads a changed section `nats`, and waits until the scanner is connected."""
    file.write_text(text)
    assert appliance.reload(load(file)) == ["nats"]
    until_connected(appliance)


def test_after_a_reload_subscriptions_go_on(
    run: Run,
    nats: NatsServer,
    caller: Caller,
    server: holdfast.Server,
    tmp_path: Path,
    log: web.Records,
) -> None:
    file = tmp_path / "appliance.yaml"
    text = MODBUS + nats_section(nats.url) + "  keep_subscriptions: false\n"
    appliance = run(text)
    data = caller.listen("plant.data.plc1")
    assert subscribed(caller, server)["success"] is True
    data.next()
    reload(appliance, file, text + "  limits: {tags: 7}\n")
    assert caller.request("plant.browse", b"")["count"] == 1
    data.take()
    data.next()
    [restored] = log.of("restored")
    assert (restored["device"], restored["tags"]) == ("plc1", 1)

    # One that its files keep from starting loses nothing.
    (tmp_path / "ca.pem").write_text("no certificate")
    unusable = text + "  device_tls: {ca_file: ca.pem}\n"
    file.write_text(unusable)
    appliance.reload(load(file))
    wire.until(lambda: log.of("adapter_failed"), "it has failed")
    reload(appliance, file, text)
    assert caller.request("plant.browse", b"")["count"] == 1

    other = text.replace("prefix: plant", "prefix: other")
    reload(appliance, file, other)
    assert caller.request("other.browse", b"")["count"] == 0
    assert subscribed(caller, server, "other")["success"] is True
    file.write_text(MODBUS)
    assert appliance.reload(load(file)) == ["nats"]
    reload(appliance, file, other)
    assert caller.request("other.browse", b"")["count"] == 0

    assert subscribed(caller, server, "other")["success"] is True
    caller.publish("other.shutdown")
    wire.until(lambda: log.of("adapter_stopped"), "the scanner has ended")
    reload(appliance, file, other + "  limits: {tags: 7}\n")
    assert caller.request("other.browse", b"")["count"] == 0


def test_a_reload_that_allows_a_device_again_restores_its_subscriptions(
    run: Run,
    nats: NatsServer,
    caller: Caller,
    server: holdfast.Server,
    tmp_path: Path,
    log: web.Records,
) -> None:
    file = tmp_path / "appliance.yaml"
    text = MODBUS + nats_section(nats.url) + "  keep_subscriptions: false\n"
    appliance = run(text)
    assert subscribed(caller, server)["success"] is True
    for device in ("plc2", "plc3"):
        request = subscription(server, tag("a", 0), tag("b", 1), deviceId=device)
        assert caller.request("plant.subscribe", request)["success"] is True
    mistaken = text.replace("devices: [127.0.0.0/8]", "devices: [10.0.0.0/8]")
    for more in ("", "  limits: {tags: 7}\n"):
        reload(appliance, file, mistaken + more)
        assert caller.request("plant.browse", b"")["count"] == 0
    assert len(log.of("not_restored")) == 6
    for device, ids in (("plc2", "all"), ("plc3", ["b"])):
        request = {"deviceId": device, "subscriberId": "hmi", "tagIds": ids}
        assert caller.request("plant.unsubscribe", request)["success"] is True
    reload(appliance, file, text)
    found = caller.request("plant.browse", b"")["devices"]
    assert {each["deviceId"]: [tag["id"] for tag in each["tags"]] for each in found} == {
        "plc1": ["a"],
        "plc3": ["a"],
    }


def test_a_subscription_that_a_reload_refused_displaces_no_other(
    run: Run, nats: NatsServer, caller: Caller, server: holdfast.Server, tmp_path: Path
) -> None:
    def reload_with(limits: str) -> None:
        reload(appliance, tmp_path / "appliance.yaml", f"{text}  limits: {{{limits}}}\n")

    def subscribe(device: str, **more: int) -> None:
        request = subscription(server, tag("a", 0), deviceId=device, **more)
        assert caller.request("plant.subscribe", request)["success"] is True

    def devices() -> list[str]:
        return [each["deviceId"] for each in caller.request("plant.browse", b"")["devices"]]

    text = MODBUS + nats_section(nats.url) + "  keep_subscriptions: false\n"
    appliance = run(text)
    until_connected(appliance)
    subscribe("plc1")
    subscribe("plc2")
    subscribe("plc3", ttl=1000)
    reload_with("devices: 1")
    assert devices() == ["plc1"]
    request = {"deviceId": "plc1", "subscriberId": "hmi", "tagIds": "all"}
    assert caller.request("plant.unsubscribe", request)["success"] is True
    subscribe("plc4")
    reload_with("devices: 1, tags: 7")
    assert devices() == ["plc4"]
    reload_with("devices: 3")
    assert devices() == ["plc2", "plc4"]  # The subscriber of plc3 repeats its request.


def test_devices_outside_the_list_are_not_polled(
    run: Run, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    run(nats_section(nats.url).replace("127.0.0.0/8", "/dev/ttyUSB9, 10.0.0.0/8"))
    assert subscribed(caller, server) == {
        "success": False,
        "error": "127.0.0.1 is not allowed, allowed: 10.0.0.0/8",
    }


def test_limits_are_those_of_the_configuration(
    run: Run, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    run(nats_section(nats.url) + "  limits: {tags: 1}\n")
    assert subscribed(caller, server)["success"] is True
    more = subscription(server, tag("b", 5), tag("c", 6))
    assert caller.request("plant.subscribe", more)["error"] == ("there would be 3 tags, allowed: 1")


def test_a_server_that_is_not_there_yet_is_waited_for(
    run: Run, own_nats: NatsServer, server: holdfast.Server, log: web.Records
) -> None:
    own_nats.kill()
    appliance = run(MODBUS + nats_section(own_nats.url))
    wire.until(lambda: log.of("nats_connect_failed"), "it was tried")
    assert status(appliance, "nats")["connected"] is False
    with wire.Connection(endpoint(appliance, "scada")) as client:
        assert client.ask(bytes.fromhex("0300000001")) == bytes.fromhex("03020000")
    own_nats.start()
    until_connected(appliance)
    with Caller(own_nats.url) as caller:
        assert subscribed(caller, server)["success"] is True
    assert status(appliance, "nats")["restarts"] == 0


def test_it_stops_while_no_server_is_there(run: Run, log: web.Records) -> None:
    appliance = run(nats_section(f"nats://127.0.0.1:{free_port()}"))
    wire.until(lambda: log.of("nats_connect_failed"), "it was tried")
    appliance.stop()
    assert log.of("adapter_does_not_stop") == []


def test_a_message_ends_the_scanner_and_nothing_else(
    run: Run, nats: NatsServer, caller: Caller, server: holdfast.Server, log: web.Records
) -> None:
    appliance = run(MODBUS + nats_section(nats.url) + gateway_section())
    subscribed(caller, server)
    caller.publish("plant.shutdown")
    wire.until(lambda: status(appliance, "nats")["state"] == "stopped", "the scanner has ended")
    told = status(appliance, "nats")
    assert (told["restarts"], told["last_error"]) == (0, None)
    assert (told["connected"], told["devices"]) == (False, 0)
    [stopped] = log.of("adapter_stopped")
    assert stopped["adapter"] == "nats"
    assert (log.of("adapter_ended"), log.of("adapter_failed")) == ([], [])
    assert len(log.of("shutdown_asked")) == 1
    with pytest.raises(NoRespondersError):
        caller.request("plant.browse", b"")
    with wire.Connection(endpoint(appliance, "scada")) as client:
        assert client.ask(bytes.fromhex("0300000001")) == bytes.fromhex("03020000")
    assert ask(appliance, "/read", read(server)).status == 200


def test_a_file_that_can_not_be_used_is_a_failure_of_the_scanner_alone(
    run: Run, nats: NatsServer, tmp_path: Path, server: holdfast.Server, log: web.Records
) -> None:
    (tmp_path / "ca.pem").write_text("no certificate")
    text = nats_section(nats.url.replace("nats://", "tls://")) + "  tls: {ca_file: ca.pem}\n"
    appliance = run(text + gateway_section())
    wire.until(lambda: status(appliance, "nats")["state"] == "failed", "it has failed")
    assert log.of("adapter_failed")[0]["adapter"] == "nats"
    assert ask(appliance, "/read", read(server)).status == 200


def test_password_and_user_come_from_the_configuration(
    run: Run, tmp_path: Path, log: web.Records
) -> None:
    (tmp_path / "nats").mkdir()
    own = NatsServer(tmp_path / "nats", "--user", "scan", "--pass", "s3cret")
    try:
        (tmp_path / "password").write_text("s3cret\n")
        text = nats_section(own.url) + "  username: scan\n  password_file: password\n"
        appliance = run(text)
        until_connected(appliance)
        assert "s3cret" not in json.dumps(status(appliance, "nats")) + "".join(log.lines)
    finally:
        own.kill()


# As a process.


def test_it_says_what_is_served_and_a_signal_ends_it(
    start: Start, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    command = start(nats_section(nats.url, "signalled") + gateway_section())
    said = command.wait_for_greeting()
    assert f"  nats     {nats.url}\n" in said
    assert "polls and writes 127.0.0.0/8 for subscribers at signalled.subscribe\n" in said
    assert "console and API; reads 127.0.0.0/8:* for 127.0.0.0/8; no tokens\n" in said
    match = re.search(r"gateway  http://127\.0\.0\.1:([0-9]+)\n", said)
    assert match is not None
    assert subscribed(caller, server, "signalled")["success"] is True
    client = web.Client(("127.0.0.1", int(match[1])))
    with contextlib.closing(client):
        answer = client.ask("POST", "/api/modbus/read", read(server))
    assert answer.json["values"] == [0]
    code, log = command.end(signal.SIGTERM)
    assert code == 0
    assert "Traceback" not in log
    assert "adapter_" not in log


def test_a_gateway_without_a_port_does_not_keep_the_scanner_from_serving(
    start: Start, nats: NatsServer, caller: Caller, server: holdfast.Server
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        command = start(nats_section(nats.url, "taken") + gateway_section(port))
        assert "not served yet, retried: Address already in use\n" in command.wait_for_greeting()
        assert subscribed(caller, server, "taken")["success"] is True
        code, log = command.end(signal.SIGTERM)
    assert code == 0
    assert f"adapter_not_listening adapter=gateway bind=127.0.0.1:{port} " in log


PARTS = """
import sys
from pathlib import Path
from holdfast.appliance import Appliance
from holdfast.config import load
with Appliance(load(Path(sys.argv[1]))):
    print(*sys.modules)
"""


@pytest.mark.parametrize(
    ("serves_nats", "parts"), [(False, set()), (True, {"nats", "holdfast.scanner"})]
)
def test_what_is_not_served_is_not_imported(
    tmp_path: Path, serves_nats: bool, parts: set[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = "nats://{}:{}".format(*silent.getsockname())
        file = tmp_path / "plant.yaml"
        file.write_text(MODBUS + nats_section(url) * serves_nats)
        made = subprocess.run(
            [sys.executable, "-c", PARTS, str(file)],
            capture_output=True,
            text=True,
            timeout=wire.DEADLINE,
            check=True,
        )
    heavy = {"nats", "paho", "holdfast.net.http.server", "holdfast.gateway", "holdfast.scanner"}
    assert heavy & set(made.stdout.split()) == parts
