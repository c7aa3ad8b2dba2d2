"""Streams of events: watched ranges, and views of several ranges."""
