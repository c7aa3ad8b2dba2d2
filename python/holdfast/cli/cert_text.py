"""Formats what is in a PEM file for people."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.certificates.inspection import Described

LABELS = {
    "not_before": "valid from",
    "not_after": "valid to",
    "this_update": "made",
    "next_update": "next list due",
    "public_key_sha256": "public key sha256",
    "fits_certificate": "fits certificate",
}
DATES = ("not_before", "not_after", "this_update", "next_update")


def as_text(described: Sequence[Described]) -> str:
    """Returns the lines of `holdfast cert show`."""
    parts = []
    for each in described:
        shown = {key: value for key, value in each.fields.items() if key != "authority"}
        labels = {key: LABELS.get(key, key) for key in shown}
        width = max(map(len, labels.values()))
        lines = [each.kind]
        lines += [f"  {labels[key]:{width}}  {_shown(key, shown[key])}" for key in shown]
        lines += [f"  fails: {flaw}" for flaw in each.flaws]
        lines += [f"  note: {text}" for text in each.advice]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _shown(key: str, value: Any) -> str:
    if key in DATES and value is not None:
        return f"{datetime.fromisoformat(value):%Y-%m-%d %H:%M} UTC"
    if key == "revoked":
        return "\n    ".join(["", *map(_revoked, value)]) if value else "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "none" if value is None else str(value)


def _revoked(entry: dict[str, str]) -> str:
    date = f"{datetime.fromisoformat(entry['date']):%Y-%m-%d %H:%M} UTC"
    return f"{entry['serial']}  {date}  {entry['reason']}"
