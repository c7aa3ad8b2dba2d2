"""Rules between the keys of a configuration, a module for each section."""
