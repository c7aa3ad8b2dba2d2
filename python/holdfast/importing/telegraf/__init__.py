"""Imports the Modbus inputs of Telegraf."""

from __future__ import annotations

from holdfast.importing.telegraf.configuration import read_telegraf

__all__ = ["read_telegraf"]
