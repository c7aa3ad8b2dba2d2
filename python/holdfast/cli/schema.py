"""`holdfast schema`: the JSON Schema of a configuration, for editors."""

from __future__ import annotations

import json

import click

from holdfast.config import json_schema


@click.command()
def schema() -> None:
    """Print the JSON Schema of a configuration, so that editors check and complete it.

    \b
    Example:
      holdfast schema > holdfast.schema.json

    With the YAML language server, a file then begins with:
      # yaml-language-server: $schema=holdfast.schema.json
    """
    click.echo(json.dumps(json_schema(), indent=2))
