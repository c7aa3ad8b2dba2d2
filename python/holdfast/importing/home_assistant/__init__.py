"""Imports the `modbus` section of Home Assistant."""

from __future__ import annotations

from holdfast.importing.home_assistant.hubs import read_home_assistant

__all__ = ["read_home_assistant"]
