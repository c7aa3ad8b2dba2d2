"""The answers to probes: whether a process is live, and whether it is ready for its clients.

The paths are those of every HTTP service that answers probes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.net.http.host_and_origin import Origins
    from holdfast.net.http.requests import Request, Response

LIVE = "/health/live"
READY = "/health/ready"
PATHS = (LIVE, READY)


@dataclass(frozen=True)
class Check:
    """The result of one check: `detail` is a sentence without secrets."""

    ok: bool
    detail: str


class HealthSource(Protocol):
    """What is asked for the state of the process. Thread-safe; does not wait for anything."""

    def live(self) -> Mapping[str, Check]:
        """Returns the checks that must all pass, or a restart is the only remedy."""

    def ready(self) -> Mapping[str, Check]:
        """Returns the checks that must all pass before clients are sent here."""


def answer(health: HealthSource, request: Request, *, shown_to: Origins | None) -> Response:
    """Returns the response to a request for one of `PATHS`, which may have any Host.

    The body has the detail of each check only for hosts that `shown_to` admits. For others, it has
    their names and whether they have passed.
    """
    import msgspec

    from holdfast.net.http.requests import JSON, response

    checks = health.live() if request.path == LIVE else health.ready()
    details = shown_to is not None and shown_to.admits(request)
    ok = all(check.ok for check in checks.values())
    shown = {
        name: {"ok": check.ok, "detail": check.detail} if details else {"ok": check.ok}
        for name, check in checks.items()
    }
    body = msgspec.json.encode({"ok": ok, "checks": shown})
    return response(JSON, body, status=200 if ok else 503)
