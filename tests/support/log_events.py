"""The names of all events that the code can log, from its text."""

from __future__ import annotations

import ast
import functools
import re
from typing import TYPE_CHECKING

from holdfast.appliance.parts.shared_logs import EVENTS
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PYTHON = ROOT / "python" / "holdfast"
SERVER = ROOT / "crates" / "engine" / "src" / "server" / "reports"

BY_VARIABLE = {
    "appliance/parts/certificate_expiry.py": {"certificate_expires", "certificate_expired"},
    "appliance/parts/listeners.py": set(),  # The events of listeners.
    "appliance/parts/log_servers.py": {"log_server_syncs_late", "log_server_not_checked"},
    "appliance/parts/shared_logs.py": set(EVENTS),
    "events/log_lines.py": set(),
    "scanner/jetstream/availability.py": {
        "bucket_not_watched",
        "bucket_watched",
        "heartbeat",
        "no_heartbeat",
        "subscriptions_kept",
        "subscriptions_not_kept",
    },
    "scanner/polling/devices.py": {
        f"device_{state}" for state in ("connecting", "online", "offline")
    },
    "scanner/requests.py": {
        "datatype_ignored",
        "keys_ignored",
        "scan_rate_raised",
        "tag_repeated",
        "writable_ignored",
    },
    "net/http/server.py": {"refused_source", "refused_full"},
}
"""The names that a file logs without a literal."""

PLACES = {"write": 1, "count": 1, "limited": 1, "requested": 1, "refused": 0, "problem": 0}
"""The functions of `log_lines`, and the place of the name among their arguments."""


@functools.cache
def logged() -> frozenset[str]:
    """The names of all events. Raises `AssertionError` for a name that can't be found."""
    found = {"log_dropped", *_of_listeners()}
    for file in PYTHON.rglob("*.py"):
        for argument in _names(file):
            words = {each.value for each in ast.walk(argument) if isinstance(each, ast.Constant)}
            known = {str(word) for word in words if isinstance(word, str)}
            if not known or isinstance(argument, ast.JoinedStr):
                place = str(file.relative_to(PYTHON))
                assert place in BY_VARIABLE, f"{file}:{argument.lineno}: which events?"
                known = BY_VARIABLE[place]
            found |= known
    return frozenset(found)


def _of_listeners() -> Iterator[str]:
    for file in ("event.rs", "refused_request.rs"):
        body = (SERVER / file).read_text().split("pub const fn name(self)")[1].split("\n    }\n")[0]
        yield from re.findall(r'=> "(\w+)"', body)


def _names(file: Path) -> Iterator[ast.expr]:
    """The arguments that are names of events."""
    for node in ast.walk(ast.parse(file.read_text())):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        owner, _, name = called.rpartition(".")
        if (owner == "log_lines" or (file.name == "log_lines.py" and not owner)) and name in PLACES:
            yield node.args[PLACES[name]]
        elif called == "log_lines.LOGGER.error" or (
            file.name == "host.py" and called.endswith((".note", "host.note"))
        ):
            yield node.args[0]
