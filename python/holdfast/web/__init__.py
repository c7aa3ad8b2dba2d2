"""HTTP for ASGI applications: the host, requests, refusals, and the OpenAPI page."""
