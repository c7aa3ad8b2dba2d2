"""The command line: `holdfast COMMAND`, one command a file.

Each command is imported only when it is used, so no command waits for the imports of another.
Commands contain no logic that another caller could need.
"""

from __future__ import annotations

import importlib

import click

from holdfast import __version__
from holdfast.cli.suggesting import SuggestingGroup

GROUPS = {
    "Devices": {
        "read": ("holdfast.cli.read:read", "Read values of a device, once or repeatedly."),
        "write": ("holdfast.cli.write:write", "Write values to a device."),
        "watch": ("holdfast.cli.watch:watch", "Show values of a device or an appliance live."),
        "find": (
            "holdfast.cli.find:find",
            "Find devices: in a network, behind a gateway, on a serial line.",
        ),
        "describe": (
            "holdfast.cli.describe:describe",
            "Describe an undocumented device, as a tag list.",
        ),
        "map": ("holdfast.cli.map_:map_", "Find the addresses of a device."),
        "guess": ("holdfast.cli.guess:guess", "Guess the type and byte order of a value."),
        "identify": ("holdfast.cli.identify:identify", "Print the identification of a device."),
        "simulate": ("holdfast.cli.simulate:simulate", "Run a simulated device from a tag list."),
        "plan": ("holdfast.cli.plan:plan", "Print the requests that read a device."),
    },
    "Services": {
        "run": ("holdfast.cli.run:run", "Run an appliance: the services of a configuration file."),
        "scan": (
            "holdfast.cli.scan:scan",
            "Run the NATS service, which polls devices for subscribers.",
        ),
        "gateway": ("holdfast.cli.gateway:gateway", "Run the HTTP service, with the web console."),
        "proxy": ("holdfast.cli.proxy:proxy", "Serve one device to many Modbus clients."),
    },
    "Appliance": {
        "check": ("holdfast.cli.check:check", "Check a configuration file."),
        "health": (
            "holdfast.cli.health:health",
            "Ask a running appliance whether it is ready.",
        ),
        "reload": (
            "holdfast.cli.reload:reload",
            "Have a running appliance reread its configuration.",
        ),
        "service": (
            "holdfast.cli.service:service",
            "Run an appliance as a service of Windows.",
        ),
        "sessions": (
            "holdfast.cli.sessions:sessions",
            "List the connections of a running appliance.",
        ),
        "fleet": (
            "holdfast.cli.fleet:fleet",
            "Show and drain scanners that share devices.",
        ),
        "replicas": (
            "holdfast.cli.replicas:replicas",
            "Show the logs of a running appliance, and their nodes.",
        ),
        "replay": (
            "holdfast.cli.replay:replay",
            "Rebuild the memories of a log as they were.",
        ),
        "log": ("holdfast.cli.log:log", "Back up, restore and replicate logs."),
        "memory": (
            "holdfast.cli.memory:memory",
            "Verify, export and import files that keep memories.",
        ),
        "audit": ("holdfast.cli.audit:audit", "Verify audit logs."),
        "schema": ("holdfast.cli.schema:schema", "Print the JSON Schema of a configuration."),
        "import": ("holdfast.cli.import_:import_", "Convert the configuration of another program."),
        "cert": ("holdfast.cli.cert:cert", "Make, revoke and show TLS certificates."),
        "token": ("holdfast.cli.token:token", "Create a secret for a client of REST."),
    },
    "More": {
        "raw-send": ("holdfast.cli.raw_send:raw_send", "Write values with one Raw Ingest packet."),
        "completion": (
            "holdfast.cli.completion:completion",
            "Print a script for shell completion.",
        ),
        "bench": ("holdfast.cli.bench:bench", "Load test of a Modbus server."),
    },
}
"""The commands, in the order of the help: the module and function of each, and a summary."""

COMMANDS = {name: place for group in GROUPS.values() for name, (place, _) in group.items()}


class LazyGroup(SuggestingGroup):
    """A group that imports each command on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """The names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """The command with that name, or `None`."""
        if cmd_name not in COMMANDS:
            return None
        module, _, name = COMMANDS[cmd_name].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Writes the commands in their groups, without importing them."""
        width = max(map(len, COMMANDS))
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(f"{name:{width}}", summary) for name, (_, summary) in group.items()]
                )


@click.group(
    cls=LazyGroup,
    epilog="Example: holdfast read tcp://192.168.0.10 holding_registers 0 4",
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="holdfast", message="%(prog)s %(version)s")
def main() -> None:
    """Modbus software: an appliance with shared memories, and tools for Modbus devices."""
