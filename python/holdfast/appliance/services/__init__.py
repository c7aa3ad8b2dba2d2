"""The services of an appliance: adapters and outputs, each supervised in a thread of its own."""
