"""The text of a configuration: YAML with places, templates, and the report of all problems."""
