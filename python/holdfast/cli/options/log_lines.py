"""The options for the log."""

from __future__ import annotations

from typing import get_args

from holdfast.cli.options.option import choice
from holdfast.events import FORMAT, LEVEL, Format, Level

log_level_option = choice(
    "--log-level", "Least level of events in the log.", get_args(Level), LEVEL
)
log_format_option = choice(
    "--log-format", "ecs: JSON in the names of the Elastic Common Schema.", get_args(Format), FORMAT
)
