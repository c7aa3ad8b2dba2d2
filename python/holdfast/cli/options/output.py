"""The option for the format of the log."""

from __future__ import annotations

from typing import get_args

from holdfast.cli.options.option import choice
from holdfast.events import Format

log_format_option = choice(
    "--log-format", "ecs: JSON in the names of the Elastic Common Schema.", get_args(Format), "text"
)
