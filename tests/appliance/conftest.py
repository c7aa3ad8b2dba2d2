"""What the tests of appliances share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.events import log_lines
from support import web

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def log() -> Iterator[web.Records]:
    """All that the project logs, from level info."""
    records = web.Records()
    level = log_lines.LOGGER.level
    log_lines.LOGGER.addHandler(records)
    log_lines.LOGGER.setLevel("INFO")
    yield records
    log_lines.LOGGER.removeHandler(records)
    log_lines.LOGGER.setLevel(level)
