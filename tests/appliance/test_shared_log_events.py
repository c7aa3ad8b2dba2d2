"""What the native log tells has a level in the log of the program."""

from __future__ import annotations

import re

from holdfast.appliance.parts.shared_logs import EVENTS
from support.paths import ROOT

NATIVE = ROOT / "crates" / "journal" / "src" / "log"


def told() -> set[str]:
    """The names of all events of the native log, from its text."""
    names: set[str] = set()
    for file in NATIVE.rglob("*.rs"):
        made = re.findall(r'\bEvent::new\(\s*("\w+")?', file.read_text())
        assert all(made), f"{file}: an event without a literal name"
        names.update(name.strip('"') for name in made)
    return names


def test_each_event_of_the_native_log_has_a_level() -> None:
    assert told() == set(EVENTS)
    assert all(name.startswith("log_") for name in EVENTS)
