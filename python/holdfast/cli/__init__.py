"""The command line: `holdfast COMMAND`, one command a file.

Each command is imported only when it is used, so no command waits for the imports of another.
Commands contain no logic that another caller could need.
"""

from __future__ import annotations

import importlib

import click

from holdfast import __version__

COMMANDS = {
    "audit": "holdfast.cli.audit:audit",
    "bench": "holdfast.cli.bench:bench",
    "cert": "holdfast.cli.cert:cert",
    "check": "holdfast.cli.check:check",
    "completion": "holdfast.cli.completion:completion",
    "describe": "holdfast.cli.describe:describe",
    "find": "holdfast.cli.find:find",
    "gateway": "holdfast.cli.gateway:gateway",
    "guess": "holdfast.cli.guess:guess",
    "identify": "holdfast.cli.identify:identify",
    "import": "holdfast.cli.import_:import_",
    "map": "holdfast.cli.map_:map_",
    "plan": "holdfast.cli.plan:plan",
    "proxy": "holdfast.cli.proxy:proxy",
    "raw-send": "holdfast.cli.raw_send:raw_send",
    "read": "holdfast.cli.read:read",
    "reload": "holdfast.cli.reload:reload",
    "run": "holdfast.cli.run:run",
    "scan": "holdfast.cli.scan:scan",
    "schema": "holdfast.cli.schema:schema",
    "sessions": "holdfast.cli.sessions:sessions",
    "simulate": "holdfast.cli.simulate:simulate",
    "token": "holdfast.cli.token:token",
    "watch": "holdfast.cli.watch:watch",
    "write": "holdfast.cli.write:write",
}


class LazyGroup(click.Group):
    """A group that imports each command on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """The names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """The command with that name, or `None`."""
        if cmd_name not in COMMANDS:
            return None
        module, _, name = COMMANDS[cmd_name].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name)
        return command


@click.group(
    cls=LazyGroup,
    epilog="Example: holdfast run plant.yaml",
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="holdfast", message="%(prog)s %(version)s")
def main() -> None:
    """Modbus software: an appliance with shared memories, and tools for Modbus devices."""
