"""Converts configurations of other programs to Holdfast configurations.

Call the `read_…` of the program. A `Note` reports every setting that can't be converted; nothing is
dropped silently. This package never starts anything, and secrets leave it only as hashes.
"""

from __future__ import annotations

from holdfast.importing.home_assistant.hubs import read_home_assistant
from holdfast.importing.imported import ORDINALS, Imported, NotImportable
from holdfast.importing.mma.configuration import read_mma
from holdfast.importing.modbus_proxy import read_modbus_proxy
from holdfast.importing.modpoll import INTERVAL_S, read_modpoll
from holdfast.importing.notes import Kind, Note
from holdfast.importing.replicator import read_replicator
from holdfast.importing.telegraf.configuration import read_telegraf

__all__ = [
    "INTERVAL_S",
    "ORDINALS",
    "Imported",
    "Kind",
    "NotImportable",
    "Note",
    "read_home_assistant",
    "read_mma",
    "read_modbus_proxy",
    "read_modpoll",
    "read_replicator",
    "read_telegraf",
]
