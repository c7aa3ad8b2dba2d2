"""An appliance with every part that has metrics, and what Prometheus finds there."""

from __future__ import annotations

import socket
import urllib.request
from collections import defaultdict
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from support import web, wire
from support.brokers import NatsServer, free_port
from support.certificates import Certificates
from support.config_folder import written
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.promql import Labels

SOURCES = ["127.0.0.0/8"]


def sections(folder: Path, nats: str, device: tuple[str, int]) -> dict[str, Any]:
    """A configuration in which every metric has a sample."""
    authority = Certificates(folder)
    server = authority.issue("server", "IP:127.0.0.1")
    files = {"cert_file": server.certificate, "key_file": server.key, "ca_file": authority.ca}
    tls = {key: str(file) for key, file in files.items()}
    https = {key: tls[key] for key in ("cert_file", "key_file")}
    tls["crl_file"] = str(authority.revoke())
    at: dict[str, Any] = {"bind": "127.0.0.1:0", "sources": SOURCES}
    units = {"sources": SOURCES, "units": {1: "kept", 2: {"route": "bus"}}, "access": "read-write"}
    raw = {"sources": SOURCES, "units": {1: "kept"}, "areas": ["holding_registers"]}
    url = "tcp://{}:{}".format(*device)
    into = {"memory": "plant", "area": "holding_registers", "address": 0}
    reads = [{"area": "holding_registers", "address": 0, "count": 2, "into": into}]
    tags = {"level": {"area": "holding_registers", "address": 0, "unit": "m"}}
    forward = [{"url": f"raw://127.0.0.1:{free_port()}", "unit": 1}]
    return {
        "memories": {
            "plant": {"holding_registers": 9, "coils": 8, "seal": {"area": "coils", "address": 0}},
            "kept": {"holding_registers": 9, "keep": {"file": "kept.redb"}},
            "shared": {"holding_registers": 9, "replicate": {"log": "site"}},
        },
        "logs": {"site": {"servers": [nats], "node": "a"}},
        "listeners": {
            "scada": {"type": "modbus-tcp", "bind": at["bind"], "rules": [units]},
            "secure": {
                "type": "modbus-tls",
                "bind": at["bind"],
                "rules": [units],
                "tls": tls,
            },
            "sensors": {"type": "raw-ingest", "bind": at["bind"], "rules": [raw]},
        },
        "devices": {
            "meter": {
                "url": url,
                "interval": 0.1,
                "reads": reads,
                "stale": {"after": 60},
                "tags": tags,
                "forward": forward,
            },
            "bus": {"url": url, "unit": 7},
        },
        "rest": {**at, "tokens": "none"},
        "mqtt": {
            "url": f"mqtt://127.0.0.1:{free_port()}",
            "client_id": "a",
            "subscriptions": [{"topic": "a", "memories": ["plant"], "areas": ["coils"]}],
        },
        "nats": {"servers": [nats], "devices": SOURCES},
        "gateway": {
            **at,
            "tokens": "none",
            "allow": SOURCES,
            "access": "read-only",
            "tls": https,
        },
        "outputs": {"table": {"type": "file", "file": "out.jsonl", "format": "jsonl"}},
        "metrics": {**at, "values": True},
        "audit": {"file": "audit.log", "syslog": f"udp://127.0.0.1:{free_port()}"},
    }


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    folder = tmp_path_factory.mktemp("plant")
    memory = holdfast.Memory(holding_registers=10)
    nats = NatsServer(folder)
    try:
        with holdfast.Server(
            {1: memory, 7: memory}, bind="127.0.0.1:0", access="read-only"
        ) as device:
            file = folder / "plant.yaml"
            file.write_text(written(sections(folder, nats.url, device.address)))
            with Appliance(load(file)) as running:
                yield running
    finally:
        nats.kill()


def scraped(appliance: Appliance) -> dict[str, dict[str, set[str]]]:
    """The metrics, their labels and values, as a scrape finds them."""
    address = "http://{}:{}/metrics".format(*endpoint(appliance, "metrics"))
    with urllib.request.urlopen(address, timeout=wire.DEADLINE) as answer:
        text = answer.read().decode()
    found: dict[str, dict[str, set[str]]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            values = found.setdefault(sample.name, defaultdict(set))
            for label, value in sample.labels.items():
                values[label].add(value)
    return found


@pytest.fixture(scope="module")
def metrics(appliance: Appliance) -> Labels:
    """The metrics of an appliance in which what is counted by its reason has happened."""
    host, port = endpoint(appliance, "scada")
    with holdfast.SyncClient(f"tcp://{host}:{port}") as client:
        client.read_holding_registers(0, 1)
        with pytest.raises(holdfast.ModbusException):
            client.read_holding_registers(100, 1)
    with closing(web.Client(endpoint(appliance, "rest"))) as rest:
        assert rest.ingest({}).status == 400
    for listener, sent in (
        ("secure", "not TLS"),
        ("gateway", "not TLS"),
        ("sensors", "not a packet"),
    ):
        with socket.create_connection(endpoint(appliance, listener), wire.DEADLINE) as stranger:
            stranger.sendall(sent.encode())
            while stranger.recv(64):
                pass
    names = ["packets_refused_total", "ingest_refused_total", "tag_value"]
    names += ["tls_failed_total", "adapter_tls_failed_total"]
    adapters = appliance.diagnostics.adapters
    found: dict[str, dict[str, set[str]]] = {}

    def has_all() -> bool:
        states = [supervisor.status()["state"] for supervisor in adapters.values()]
        if set(states) != {"running"}:
            return False
        found.update(scraped(appliance))
        return all(f"holdfast_{name}" in found for name in names)

    wire.until(has_all, "everything is counted")
    return found
