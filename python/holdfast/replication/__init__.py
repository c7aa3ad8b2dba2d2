"""What nodes of an appliance or a fleet share: leases, and backups of their logs."""
