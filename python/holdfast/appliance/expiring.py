"""Logs certificates and revocation lists that expire soon, or have expired."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from holdfast import logs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.appliance.configured_certificates import Expiries

SOON = 30 * 24 * 3600.0
"""A certificate that expires within this time is logged, in seconds."""

REPEAT = 24 * 3600.0
"""Seconds after which it is logged again."""


class Expiring:
    """Logs expiries once a day. For one thread."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str, str], float] = {}

    def check(self, expiries: Expiries, now: float | None = None) -> None:
        """Logs what is due. `now` is Unix time. Call it often."""
        now = time.time() if now is None else now
        self._check("certificate", expiries.certificates, now)
        self._check("revocation list", expiries.revocation_lists, now)

    def _check(self, kind: str, ends: Mapping[str, float], now: float) -> None:
        for file, end in ends.items():
            if end - now > SOON:
                continue
            event = "certificate_expired" if end <= now else "certificate_expires"
            told = self._told.get((event, kind, file))
            # The clock may have been set back.
            if told is not None and 0 <= now - told < REPEAT:
                continue
            self._told[event, kind, file] = now
            level = logging.ERROR if end <= now else logging.WARNING
            logs.write(level, event, kind=kind, file=file, expires=logs.timestamp(end))
