"""Host names in a configuration: the names under which a service may be reached."""

from __future__ import annotations

from holdfast.config.text.messages import show
from holdfast.net.hosts import is_host_name

HOST_NAME_FORM = "a host name without a port, as in gateway.plant.example"


def parse_host_name(text: object) -> str:
    """Returns a host name in lower case. Raises `ValueError` for anything else."""
    # Browsers send names of other languages in ASCII, as in xn--…
    if not isinstance(text, str) or not text.isascii() or not is_host_name(text):
        raise ValueError(f"found {show(text)}, allowed: {HOST_NAME_FORM}")
    return text.lower()
