"""Keys of earlier versions, and keys in the wrong place: what to write instead."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.text.raw_access import entries, mapping

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath

_RELAXED = {"packets": "many", "after_refusal": "continue", "crc": "none", "flags": "ignore"}
"""What relaxes the raw ingest protocol, with the only value of each key. They were keys of the
listener itself before."""


def _relaxed(key: str, found: object) -> str:
    where = f"compat: {{{key}: {_RELAXED[key]}}}"
    if found == _RELAXED[key]:
        return f"moved, allowed: {where}"
    if (key, found) == ("crc", "if-present"):
        return f"moved, allowed: no key, if all senders send a CRC, otherwise {where}"
    return f"moved, allowed: no key for the strict protocol, otherwise {where}"


FORMER: dict[str, str | Callable[[str, object], str]] = {
    **dict.fromkeys(
        ("listeners.*.max_requests_per_source", "listeners.*.max_writes_per_source"),
        "removed, there is no limit per second: an address waits only while others do: delete the "
        "key",
    ),
    **{f"listeners.<raw-ingest>.{key}": _relaxed for key in _RELAXED},
    **{f"listeners.<modbus-tcp>.raw_ingest.{key}": _relaxed for key in _RELAXED},
    **dict.fromkeys(
        ("listeners.<modbus-rtu>.rules.*.sources", "listeners.<modbus-ascii>.rules.*.sources"),
        "not allowed on a serial line, allowed: units, access, functions, deny",
    ),
    **dict.fromkeys(
        ("listeners.*.tls.expired_crl", "*.tls.expired_crl"),
        "removed, clients are refused after the nextUpdate of a list: delete the key, and fetch a "
        "list with a later nextUpdate for crl_file",
    ),
    "listeners.*.max_handshakes": "removed, it is max_connections, at least 256: delete the key",
    "listeners.<modbus-rtu>.serial.data_bits": "removed, RTU has 8 data bits: delete the key",
    "devices.*.cost": "removed, allowed: max_gap: auto, which measures the device, or max_gap: N "
    "with N = per_request / per_register",
    **{
        f"{place}.*.count": "removed, allowed: end, the last address: start + count - 1"
        for place in (
            "devices.*.readable",
            "devices.*.forbidden",
            "listeners.*.rules.*.units.*.read",
            "listeners.*.rules.*.units.*.write",
        )
    },
}
"""What to write instead of each key. In its place, `*` stands for any name, unit id or index, and
`<TYPE>` for a listener of that type."""


def take_out_former_keys(report: Report) -> None:
    """Reports former keys, and removes them from the data."""
    for place, message in FORMER.items():
        *parts, key = place.split(".")
        for path, owner in _owners(report.document.data, parts, ()):
            if key in owner:
                words = message if isinstance(message, str) else message(key, owner[key])
                report.add_key((*path, key), words)
                del owner[key]


def _owners(
    data: Any, parts: Sequence[str], path: KeyPath
) -> Iterator[tuple[KeyPath, dict[Any, Any]]]:
    """The mappings at a place, with their paths."""
    if not parts:
        if isinstance(data, dict):
            yield path, data
        return
    inside: dict[Any, Any] = dict(enumerate(entries(data))) or mapping(data)
    for key, value in inside.items():
        if parts[0] in (key, "*", f"<{mapping(value).get('type')}>"):
            yield from _owners(value, parts[1:], (*path, key))
