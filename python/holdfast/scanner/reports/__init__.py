"""The answers to `browse` and `variables`."""
