"""`holdfast completion`: prints completion scripts for shells."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

VARIABLE = "_HOLDFAST_COMPLETE"
PROGRAM = "holdfast"


@click.command(
    epilog="Example: holdfast completion fish > ~/.config/fish/completions/holdfast.fish"
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the script with which SHELL completes commands and options.

    \b
    bash   holdfast completion bash > ~/.local/share/bash-completion/completions/holdfast
    zsh    holdfast completion zsh > ~/.zfunc/_holdfast     (a folder of fpath)
    fish   holdfast completion fish > ~/.config/fish/completions/holdfast.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(ctx.find_root().command, {}, PROGRAM, VARIABLE).source())
