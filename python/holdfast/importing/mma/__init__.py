"""Imports configurations of the Modbus Memory Appliance."""
