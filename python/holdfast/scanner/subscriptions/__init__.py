"""Who has subscribed to what: devices, tags, rates, limits and health. Does no I/O, but logs."""
