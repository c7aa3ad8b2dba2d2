"""The operations of the gateway on devices, one module for each kind."""
