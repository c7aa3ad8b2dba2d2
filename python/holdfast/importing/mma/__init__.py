"""Imports configurations of the Modbus Memory Appliance."""

from __future__ import annotations

from holdfast.importing.mma.configuration import read_mma

__all__ = ["read_mma"]
