"""The command line: `holdfast COMMAND`, one command a file.

Each command is imported only when it is used, so no command waits for the imports of another.
Commands contain no logic that another caller could need.
"""

from __future__ import annotations

from holdfast.cli.signals import ended_by_ctrl_c, keep_hangups

with ended_by_ctrl_c():
    import contextlib
    import importlib
    import warnings
    from pathlib import Path
    from typing import TYPE_CHECKING, Any

    import click

    from holdfast import __version__
    from holdfast.cli import answers, standard_output
    from holdfast.cli.exit_codes import ExitCode, fail
    from holdfast.cli.old_spellings import OLD_NAMES, hint, renewed
    from holdfast.runtime import extras
    from holdfast.runtime.interpreter import spare_memory
    from holdfast.runtime.suggestion import alike
    from holdfast.runtime.text import either, sentence

if TYPE_CHECKING:
    from collections.abc import Mapping

    from click.shell_completion import CompletionItem

PROGRAM = "holdfast"
COMPLETION_VARIABLE = "_HOLDFAST_COMPLETE"
"""The environment variable in which the scripts for shells ask for completions."""

GROUPS = {
    "Devices": {
        "read": "Read values of a device, once or repeatedly.",
        "write": "Write values to a device.",
        "watch": "Show values of a device or an appliance live.",
        "find": "Find devices: in a network, behind a gateway, on a serial line.",
        "describe": "Describe an undocumented device; map, guess, identify.",
        "simulate": "Run a simulated device from a tag list.",
    },
    "Services": {
        "run": "Run an appliance: the services of a configuration file.",
        "scan": "Run the NATS service, which polls devices for subscribers.",
        "gateway": "Run the HTTP service, with the web console.",
        "proxy": "Serve one device to many Modbus clients.",
    },
    "Appliance": {
        "check": "Check a configuration file.",
        "health": "Ask a running appliance whether it is ready.",
        "reload": "Have a running appliance reread its configuration.",
        "service": "Run an appliance as a service of Windows.",
        "sessions": "List the connections of a running appliance.",
        "fleet": "Show and drain scanners that share devices.",
        "log": "Show, replay, back up and replicate logs.",
        "memory": "Verify, export and import files that keep memories.",
        "audit": "Verify audit logs.",
        "import": "Convert the configuration of another program.",
        "cert": "Make, revoke and show TLS certificates.",
        "token": "Create a secret for a client of REST.",
    },
    "More": {
        "raw-send": "Write values with one Raw Ingest packet.",
        "bench": "Load test of a Modbus server.",
    },
}
"""The commands, in the order of the help, each with a summary. `read` is the function `read` in
`devices.read` here, and so on, but for those in `_ELSEWHERE`."""

_ELSEWHERE = {
    "service": "appliance.windows_service:service",
    "import": "appliance.import_command:import_",
    "raw-send": "more.raw_send:raw_send",
}

COMMANDS = {
    name: _ELSEWHERE.get(name, f"{group.lower()}.{name}:{name}")
    for group, summaries in GROUPS.items()
    for name in summaries
}
"""The module here and function of each command."""


def _imported(place: str) -> click.Command:
    module, _, name = place.partition(":")
    with ended_by_ctrl_c():
        command: click.Command = getattr(importlib.import_module(f"{__name__}.{module}"), name)
    return command


class SuggestingGroup(click.Group):
    """A group whose error for an unknown command says what was probably meant."""

    old_names: Mapping[str, str] = {}
    page = ""
    """The page to read if nothing like an unknown command is known."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of the arguments."""
        name = args[0]
        known = self.list_commands(ctx)
        # A shell that completes a line shows no errors.
        if name not in known and not name.startswith("-") and not ctx.resilient_parsing:
            typed = {**{each: each for each in known}, **self.old_names}
            see = self.page and f" See {self.page}."
            ctx.fail(f"No such command {name!r}.{_suggestion(name, typed) or see}")
        return super().resolve_command(ctx, args)


def _suggestion(name: str, known: Mapping[str, str]) -> str:
    """What was probably meant, as the end of a message: `known` has what to type for each name."""
    if "://" in name:
        return f" Did you mean 'holdfast read {name}'?"
    close = alike(name.lower(), known, most=3)
    return f" Did you mean {either(repr(known[each]) for each in close)}?" if close else ""


class CommandWithSubcommands(click.Command):
    """A command with arguments of its own, and subcommands: `describe URL`, `describe map URL`.

    A subcommand is imported only when it is used.
    """

    def __init__(self, *args: Any, subcommands: Mapping[str, tuple[str, str]], **more: Any) -> None:
        super().__init__(*args, **more)
        self.subcommands = subcommands
        """For each name, the module and function, and a summary."""

    def subcommand(self, name: str) -> click.Command:
        """Imports a subcommand."""
        return _imported(self.subcommands[name][0])

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the options, and the subcommands below."""
        super().format_options(ctx, formatter)
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in self.subcommands.items()])


def complete_subcommand(
    ctx: click.Context, param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Completes the first argument of a `CommandWithSubcommands`."""
    from click.shell_completion import CompletionItem

    assert isinstance(ctx.command, CommandWithSubcommands)
    found = [name for name in ctx.command.subcommands if name.startswith(incomplete)]
    return [*map(CompletionItem, found), *param.type.shell_complete(ctx, param, incomplete)]


class _WrongUsage(click.UsageError):
    """An error of usage that is shown as JSON."""

    def __init__(self, error: click.UsageError) -> None:
        super().__init__(error.format_message(), error.ctx)

    def show(self, file: Any = None) -> None:  # noqa: ARG002
        """Prints the error on standard output."""
        with contextlib.nullcontext() if self.ctx is None else self.ctx.scope(cleanup=False):
            answers.print_wrong("usage", self.message)


class Program(SuggestingGroup):
    """All commands. Each is imported on its first use; old names lead to the new ones."""

    old_names = OLD_NAMES

    def main(self, *args: Any, **more: Any) -> Any:
        """Runs the program. Ends with 1 if standard output can't be written."""
        standard_output.prepare()
        # Files of a system contain old authorities with a serial number that is not positive.
        warnings.filterwarnings("ignore", "Parsed a serial number")
        try:
            return super().main(*args, **more)
        except OSError as error:
            if not standard_output.is_unwritable(error):
                raise
            standard_output.leave()
            fail(f"standard output: {standard_output.reason(error)}")

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """The names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command with that name, or `None`."""
        if cmd_name not in COMMANDS:
            return None
        # An appliance runs for years, and on small machines. Other commands end, or need OpenSSL.
        sparing = spare_memory() if cmd_name == "run" else contextlib.nullcontext()
        if cmd_name == "run" and not ctx.resilient_parsing:
            keep_hangups()
        try:
            with sparing:
                return _imported(COMMANDS[cmd_name])
        except ModuleNotFoundError:
            if ctx.resilient_parsing:
                return None
            raise

    def invoke(self, ctx: click.Context) -> Any:
        """Runs a command. If an extra is missing, says which: a command imports what it needs.

        Here all errors of usage get their full stop, and are printed as JSON with `--json`.
        """
        as_json = "--json" in ctx.args
        try:
            return super().invoke(ctx)
        except click.UsageError as error:
            error.message = sentence(error.message)  # type: ignore[misc]
            if as_json:
                raise _WrongUsage(error) from error
            raise
        except (KeyboardInterrupt, click.Abort):
            if as_json:
                answers.print_wrong("interrupted", "interrupted")
            fail("interrupted", is_printed=as_json)
        except ModuleNotFoundError as error:
            reason = extras.missing_for(error)
            if reason is None:
                raise
            if as_json:
                answers.print_wrong("missing", f"this command {reason}")
            fail(f"this command {reason}", ExitCode.WRONG, is_printed=as_json)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments, with the new name of an old one."""
        if args and args[0] in OLD_NAMES:
            new = OLD_NAMES[args[0]]
            # A shell that completes a line shows nothing but what it asks for.
            if not ctx.resilient_parsing:
                hint(f"holdfast {args[0]}", f"holdfast {new}")
            args = [*new.split(), *args[1:]]
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of the arguments, or the subcommand of a command that also works alone."""
        name, command, left = super().resolve_command(ctx, args)
        silent = ctx.resilient_parsing
        if isinstance(command, CommandWithSubcommands) and left and left[0] in command.subcommands:
            name = f"{name} {left[0]}"
            return name, command.subcommand(left[0]), renewed(name, left[1:], silent=silent)
        if (
            isinstance(command, CommandWithSubcommands)
            and left
            and left[0].isalpha()
            and not Path(left[0]).exists()
            and not silent
        ):
            typed = {each: f"{name} {each}" for each in command.subcommands}
            if meant := _suggestion(left[0], typed):
                ctx.fail(f"No such command '{name} {left[0]}'.{meant}")
        if isinstance(command, click.Group):
            return (
                name,
                command,
                [*left[:1], *renewed(" ".join([str(name), *left[:1]]), left[1:], silent=silent)],
            )
        return name, command, renewed(str(name), left, silent=silent)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Completes commands; old names only after their first letter."""
        from click.shell_completion import CompletionItem

        found = [
            CompletionItem(name, help=summary)
            for group in GROUPS.values()
            for name, summary in group.items()
            if name.startswith(incomplete)
        ]
        old = [name for name in OLD_NAMES if incomplete and name.startswith(incomplete)]
        # Not those of a group, which would import all commands that begin like this.
        others = click.Command.shell_complete(self, ctx, incomplete)
        return [*found, *others, *map(CompletionItem, old)]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Writes the commands in their groups, without importing them."""
        width = max(map(len, COMMANDS))
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(f"{name:{width}}", summary) for name, summary in group.items()]
                )


def _print_completion(ctx: click.Context, _: click.Parameter, shell: str | None) -> None:
    if shell is not None and not ctx.resilient_parsing:
        from click.shell_completion import get_completion_class

        kind = get_completion_class(shell)
        assert kind is not None
        click.echo(kind(ctx.command, {}, PROGRAM, COMPLETION_VARIABLE).source())
        ctx.exit()


@click.group(
    cls=Program,
    epilog="Example: holdfast read tcp://192.168.0.10 holding_registers 0 4",
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name=PROGRAM, message="%(prog)s %(version)s")
@click.option(
    "--completion",
    type=click.Choice(["bash", "zsh", "fish"]),
    is_eager=True,
    expose_value=False,
    callback=_print_completion,
    help="Print the script with which a shell completes commands and options.",
)
def main() -> None:
    """Modbus software: an appliance with shared memories, and tools for Modbus devices."""
