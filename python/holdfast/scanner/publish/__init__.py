"""From polls to messages for NATS."""
