"""HTTP: the host, requests, refusals, and the OpenAPI page."""
