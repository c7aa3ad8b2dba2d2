"""What running services share: pauses between attempts, child processes."""
