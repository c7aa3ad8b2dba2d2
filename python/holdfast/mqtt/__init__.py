"""What all connections to MQTT brokers have in common: opening them, waiting, parsing messages."""
