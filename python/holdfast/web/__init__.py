"""HTTP for ASGI applications: the host, requests, the page of an OpenAPI document."""
