"""Leases in a bucket of NATS JetStream: which of several nodes may use something, such as a device.

A lease is a key with a TTL. Its holder renews it, and stops by its own clock if it can't: everyone
else waits longer than that before they take it. `LeaseTimes` are these times.
"""
