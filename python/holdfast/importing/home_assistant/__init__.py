"""Imports the `modbus` section of Home Assistant."""
