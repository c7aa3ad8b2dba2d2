"""What is done with each code block of the pages."""

from __future__ import annotations

import functools
import json
import re
from typing import TYPE_CHECKING

from support.pages import checks, commands, comparing, configurations, python_code
from support.pages.blocks import SHELL
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Callable

    from support.pages.blocks import Block
    from support.pages.stage import Stage

    Decision = Callable[[Block, Stage], None]


def drawing(_: Block, __: Stage) -> None:
    """Not run: a drawing, or a screen that changes."""


def foreign(_: Block, __: Stage) -> None:
    """Not read: a file of another program."""


def windows(_: Block, __: Stage) -> None:
    """Not run: makes an environment on Windows; the release workflow tries the wheel there."""


def elsewhere(test: str) -> Decision:
    """Another test runs it; it must exist."""

    def named(_: Block, __: Stage) -> None:
        file, name = test.split("::")
        assert f"def {name}(" in (ROOT / "tests" / file).read_text(), f"there is no {test}"

    return named


def greeting(block: Block, stage: Stage) -> None:
    """What `make run` prints."""
    found = re.sub(r"\S+/holdfast (?=watch|write)", ".venv/bin/holdfast ", stage.names["greeting"])
    comparing.alike(f"{stage.there(found)}\nCtrl-C stops it.\n", block.text)


def diagnostics(block: Block, stage: Stage) -> None:
    """What `stage.names["diagnostics"]` gets."""
    comparing.same_shape(stage.names["diagnostics"](), json.loads(block.text))


MMA = elsewhere("importing/test_mma.py::test_the_example_of_the_page_is_what_the_command_makes")
TLS = elsewhere("docs/test_tls_page.py::test_the_walk_through_serves_two_roles")
CLIENT = elsewhere("client/test_client.py::test_the_examples_of_the_page_print_what_it_says")
PROGRAM = elsewhere("client/test_client.py::test_the_program_of_the_page_prints_what_it_says")
VALUES = elsewhere("docs/test_values_page.py::test_the_examples_of_the_page_print_what_it_says")
LETTERS = elsewhere(
    "docs/test_values_page.py::test_the_picture_of_four_letters_is_what_encode_makes"
)
ROUTES = elsewhere("docs/test_routes_page.py::test_the_commands_of_the_page_print_what_it_says")
ECS = elsewhere("docs/test_security_events_page.py::test_the_example_is_what_is_logged")
FILEBEAT = elsewhere(
    "docs/test_security_events_page.py::test_the_configuration_of_filebeat_is_yaml"
)
SYNC = elsewhere("docs/test_docs.py::test_every_example_of_a_nats_server_stores_writes_at_once")
PROMETHEUS = elsewhere(
    "monitoring/test_rules.py::test_a_real_prometheus_evaluates_the_rules_against_an_appliance"
)
ADAPTER = "examples/adapter/"

DECISIONS: dict[tuple[str, str], Decision] = {
    ("docs/adapters.md", '"""An adapter'): functools.partial(
        checks.in_file, f"{ADAPTER}holdfast_datagrams.py"
    ),
    ("docs/adapters.md", "[project.entry-points"): functools.partial(
        checks.in_file, f"{ADAPTER}pyproject.toml"
    ),
    ("docs/adapters.md", "adapters:"): checks.adapter,
    ("docs/architecture.md", "              writers"): drawing,
    ("docs/architecture.md", "socket ─►"): drawing,
    ("docs/architecture.md", "cli\nappliance"): drawing,
    ("docs/audit.md", '{"time":'): checks.audit_lines,
    ("docs/cli.md", "REST at http://127.0.0.1:5080   every"): drawing,
    ("docs/troubleshooting.md", "14:03:21.123456 sent"): elsewhere(
        "cli/test_read.py::test_a_trace_shows_the_bytes_on_standard_error"
    ),
    ("docs/durability.md", "jetstream {"): SYNC,
    ("docs/client.md", ">>> import holdfast"): CLIENT,
    ("docs/client.md", ">>> with holdfast.SyncClient"): CLIENT,
    ("docs/client.md", "import asyncio"): PROGRAM,
    ("docs/client.md", "[[11], [22], [33]]"): PROGRAM,
    ("docs/client.md", "ModbusError\n├──"): checks.errors,
    ("docs/gateway.md", "event: "): checks.gateway_events,
    ("docs/metrics.md", "scrape_configs:"): checks.scrape,
    ("docs/monitoring.md", "prometheus "): PROMETHEUS,
    ("docs/modbus-tls.md", "holdfast cert ca"): TLS,
    ("docs/modbus-tls.md", "$ holdfast write 'tls://"): TLS,
    ("docs/moving-from-mma.md", "memory:"): MMA,
    ("docs/moving-from-mma.md", "# Made by"): MMA,
    ("docs/mqtt.md", "2026-11-21T"): checks.log_lines,
    ("docs/mqtt.md", '{"connected": true'): diagnostics,
    ("docs/operations.md", '{"ok": false, "checks"'): checks.readiness,
    ("docs/operations.md", "startupProbe:"): checks.kubernetes_probes,
    ("docs/operations.md", "2026-11-21T"): checks.log_lines,
    ("docs/outputs.md", '{"status":"accepted"'): checks.set_replies,
    ("docs/outputs.md", "sqlite3 "): checks.sql,
    ("docs/replacing.md", "device,boiler,1"): foreign,
    ("docs/rest.md", "id: 41"): checks.gateway_events,
    ("docs/rest.md", "2026-11-21T"): checks.log_lines,
    ("docs/routes.md", "$ holdfast "): ROUTES,
    ("docs/routes.md", '{"time":'): checks.audit_lines,
    ("docs/scanner.md", "modbus."): checks.scanner_messages,
    ("docs/security-events.md", '{"@timestamp"'): ECS,
    ("docs/security-events.md", "filebeat.inputs:"): FILEBEAT,
    ("docs/security-events.md", "<localfile>"): checks.xml,
    ("docs/tour.md", "examples/plant.yaml is served:"): greeting,
    ("docs/service.md", "[Service]"): checks.drop_in,
    ("docs/service.md", "mkdir C:"): windows,
    ("docs/service.md", "C:\\Holdfast\\Scripts"): checks.windows_commands,
    ("docs/values.md", ">>> "): VALUES,
    ("docs/values.md", "                        uint32"): LETTERS,
    ("docs/values.md", "CDABGHEF  registers"): checks.orders,
}
"""By page and the first words of a block."""

BY_LANGUAGE: dict[str, Decision] = {
    "csv": checks.table,
    "json": comparing.reply,
    "python": python_code.python,
    "yaml": configurations.loaded,
}

FRESH = "`make dist-check` runs it, in a fresh clone and a fresh home"
DIST = "packaging/test_dist.py runs it, in `make dist-check`"

NOT_RUN: dict[tuple[str, str], str] = {
    ("docs/benchmarks.md", "make bench"): "takes minutes; its options are checked",
    ("docs/durability.md", "python examples/replicated/"): "test_replicated_example.py runs them",
    ("docs/cli.md", "holdfast read tcp://192.168.0.10"): "needs a device with files and queues",
    ("docs/cli.md", "holdfast write tcp://192.168.0.10"): "needs a device with files",
    ("docs/containers.md", "make "): "builds an image; its targets are checked",
    ("docs/containers.md", "podman "): "needs podman and an image",
    ("docs/containers.md", "docker "): "needs Docker and an image",
    ("docs/containers.md", "kubectl "): "needs a cluster",
    ("docs/service.md", "sudo"): "changes the system; releases are tried by hand",
    ("docs/service.md", "holdfast check /etc"): "has no configuration there",
    ("docs/fleet.md", "holdfast scan"): "the stage has started it",
    ("docs/gateway.md", "holdfast gateway --allow 192.168.0.0/24 --https-cert"): "as the first one",
    ("docs/gateway.md", "holdfast gateway --allow 10.0.0.0/24 --device-ca"): "as the first one",
    ("docs/gateway.md", "curl -s http://127.0.0.1:8090/api/modbus/connect"): "needs 10.0.0.5",
    ("README.md", "make run"): FRESH,
    ("README.md", "make test"): "runs this",
    ("README.md", "make build"): FRESH,
    ("README.md", "source "): FRESH,
    ("docs/start.md", "make build"): FRESH,
    ("docs/start.md", "source "): FRESH,
    ("docs/install.md", "make build"): FRESH,
    ("docs/install.md", "source "): FRESH,
    ("docs/install.md", "python3 -m venv"): DIST,
    ("docs/install.md", ".venv/bin/pip"): DIST,
    ("docs/install.md", "pip download"): DIST,
    ("docs/install.md", "pip install --no-index"): DIST,
    ("docs/install.md", "pip install --no-build-isolation"): "compiles everything; needs maturin",
    ("docs/moving-from-mma.md", "make build"): FRESH,
    ("docs/moving-from-tentacle.md", "make build"): FRESH,
    ("docs/raspberry-pi.md", "make "): "builds packages for ARM; its targets are checked",
    ("docs/raspberry-pi.md", "scp "): "needs a Raspberry Pi",
    ("docs/raspberry-pi.md", "sudo "): "changes the system; needs a Raspberry Pi",
    ("docs/raspberry-pi.md", "journalctl "): "needs the installed service",
    ("docs/moving-from-tentacle.md", "nats pub"): "needs the program nats",
}
"""Commands that the tests of pages only parse, by page and their first words, and the reason."""


def decision(block: Block) -> Decision | None:
    """What is done with a block; `None` if that is not decided."""
    for (page, start), chosen in DECISIONS.items():
        if page == block.page and block.text.startswith(start):
            return chosen
    if block.language in SHELL:
        return shell
    return BY_LANGUAGE.get(block.language)


def shell(block: Block, stage: Stage) -> None:
    """Runs the commands of a block; those of `NOT_RUN` are only parsed."""
    starts = [start for page, start in NOT_RUN if page == block.page]
    commands.run_all(block, stage, lambda command: command.text.startswith(tuple(starts)))
