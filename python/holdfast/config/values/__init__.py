"""The types of single values in a configuration: numbers, addresses, URLs, subjects."""
