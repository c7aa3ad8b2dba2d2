"""Commands for single purposes: Raw Ingest packets and load tests."""
