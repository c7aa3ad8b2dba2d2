"""Several scanners that share their devices."""
