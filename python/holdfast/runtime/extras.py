"""The extras of the distribution: what each installs, and what to say where it is missing.

Python packages that few installations need belong to an extra. Only this module decides whether one
is missing.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal, NamedTuple, TypeAlias

DISTRIBUTION = "holdfast-modbus"

Extra: TypeAlias = Literal["certs", "mqtt", "nats", "sparkplug", "windows"]


class _Package(NamedTuple):
    name: str
    module: str
    extra: Extra
    """The extra that a failed import of the module names."""


_CRYPTOGRAPHY = _Package("cryptography", "cryptography", "certs")
_NATS = _Package("nats-py", "nats", "nats")
_PAHO = _Package("paho-mqtt", "paho.mqtt", "mqtt")
_PROTOBUF = _Package("protobuf", "google.protobuf", "sparkplug")
_PYWIN32 = _Package("pywin32", "win32service", "windows")

_PACKAGES: dict[Extra, tuple[_Package, ...]] = {
    "certs": (_CRYPTOGRAPHY,),
    "mqtt": (_PAHO,),
    "nats": (_NATS, _CRYPTOGRAPHY),
    "sparkplug": (_PROTOBUF, _PAHO),
    "windows": (_PYWIN32,),
}


def missing(extra: Extra) -> str | None:
    """What an extra lacks, to put behind what needs it; `None` if it is installed."""
    for package in _PACKAGES[extra]:
        if not _is_installed(package.module):
            return _requires(package, extra)
    return None


def missing_for(error: ModuleNotFoundError) -> str | None:
    """As `missing`, for a failed import; `None` for a module that belongs to no extra."""
    top = (error.name or "").partition(".")[0]
    for packages in _PACKAGES.values():
        for package in packages:
            if package.module.partition(".")[0] == top:
                return _requires(package, package.extra)
    return None


def _requires(package: _Package, extra: Extra) -> str:
    return f"requires {package.name}, not installed: pip install '{DISTRIBUTION}[{extra}]'"


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # The package that contains it is missing, or hidden.
        return False
