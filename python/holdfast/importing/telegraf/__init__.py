"""Imports the Modbus inputs of Telegraf."""
