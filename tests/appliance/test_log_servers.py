"""What the NATS servers of a log say of their disks, at the start of a node."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import Appliance
from support import wire
from support.brokers import NatsServer, free_port
from support.cli import invoke
from support.config_folder import Folder, written
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

MONITOR = ("-m", "-1")


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Callable[..., NatsServer]]:
    with ExitStack() as running:

        def start(name: str, *options: str, **more: bool) -> NatsServer:
            folder = tmp_path / name
            folder.mkdir()
            made = NatsServer(folder, *MONITOR, *options, **more)
            running.callback(made.kill)
            return made

        yield start


def configuration(folder: Path, server: NatsServer, monitoring: list[str]) -> Any:
    log = {"servers": [server.url], "node": "a", "monitoring": monitoring}
    parts = {
        "memories": {"plant": {"holding_registers": 10, "replicate": {"log": "site"}}},
        "logs": {"site": log},
        "rest": {"bind": "127.0.0.1:0", "sources": ["127.0.0.0/8"], "tokens": "none"},
    }
    return Folder(folder).config(written(parts))


def found(caplog: pytest.LogCaptureFixture, event: str) -> list[dict[str, Any]]:
    return [
        {**vars(each)["fields"], "level": each.levelno}
        for each in caplog.records
        if each.message == event
    ]


def test_a_server_that_syncs_late_is_named_with_what_may_be_lost(
    server: Callable[..., NatsServer], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    used = server("late")
    with Appliance(configuration(tmp_path, used, [used.monitoring])):
        wire.until(lambda: found(caplog, "log_server_syncs_late"), "it is logged")
    [told] = found(caplog, "log_server_syncs_late")
    assert told == {
        "level": logging.WARNING,
        "log": "site",
        "server": used.monitoring,
        "seconds": 120.0,
        "lost": "a power cut may cost confirmed writes of that time",
        "allowed": "sync_interval: always",
    }


def test_servers_that_sync_always_are_not_named(
    server: Callable[..., NatsServer], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "always.conf"
    file.write_text(f"jetstream {{store_dir: {tmp_path / 'own'}, sync_interval: always}}\n")
    used, late = server("always", "-c", str(file), jetstream=False), server("late")
    monitoring = [used.monitoring, late.monitoring]
    with Appliance(configuration(tmp_path, used, monitoring)):
        wire.until(lambda: found(caplog, "log_server_syncs_late"), "the second one was asked too")
    [told] = found(caplog, "log_server_syncs_late")
    assert told["server"] == late.monitoring
    assert not found(caplog, "log_server_not_checked")


def test_servers_that_do_not_say_are_named(
    server: Callable[..., NatsServer], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    used, without = server("late"), server("without", jetstream=False)
    nobody = f"http://127.0.0.1:{free_port()}"
    other = f"{used.monitoring}/elsewhere"
    no_http = used.url.replace("nats:", "http:")
    monitoring = [nobody, without.monitoring, other, no_http]
    with Appliance(configuration(tmp_path, used, monitoring)) as appliance:
        assert endpoint(appliance, "rest")  # They delay no start.
        wire.until(lambda: len(found(caplog, "log_server_not_checked")) == 4, "all are logged")
    told = {each["server"]: each["error"] for each in found(caplog, "log_server_not_checked")}
    assert "refused" in told[nobody]
    assert told[without.monitoring] == "the server has no JetStream"
    assert told[other] == "HTTP status 404"
    assert no_http in told


def test_an_embedded_server_needs_no_check(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    log = {"embedded": "log", "node": "a", "monitoring": ["http://127.0.0.1:8222"]}
    memory = {"holding_registers": 10, "replicate": {"log": "site"}}
    file.write_text(written({"memories": {"plant": memory}, "logs": {"site": log}}))
    result = invoke("check", str(file))
    assert result.exit_code == 2
    assert "logs.site.monitoring: found with embedded, allowed: without" in result.output
