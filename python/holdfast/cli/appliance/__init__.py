"""Commands for an appliance: its configuration, its files, and the one that runs."""
