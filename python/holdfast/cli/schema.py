"""`holdfast schema`: prints the JSON Schema of a configuration, for editors."""

from __future__ import annotations

import json

import click

from holdfast.config import json_schema


@click.command(epilog="Example: holdfast schema > holdfast.schema.json")
def schema() -> None:
    """Print the JSON Schema of a configuration, for editors.

    For the YAML language server, start the configuration with the line
    `# yaml-language-server: $schema=holdfast.schema.json`.
    """
    click.echo(json.dumps(json_schema(), indent=2))
