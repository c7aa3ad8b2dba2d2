"""The devices that are polled: their addresses, and how polls and writes reach them."""
