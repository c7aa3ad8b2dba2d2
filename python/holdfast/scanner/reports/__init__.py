"""The answers to `browse` and `variables`."""

from __future__ import annotations

from holdfast.scanner.reports.browse import browsed

__all__ = ["browsed"]
