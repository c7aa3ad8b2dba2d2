"""The models of a configuration: one module for each section."""
