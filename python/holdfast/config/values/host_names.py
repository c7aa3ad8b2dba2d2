"""Host names in a configuration: the names under which a service may be reached."""

from __future__ import annotations

import re

from holdfast.config.text.messages import show

HOST_NAME_FORM = "a host name without a port, as in gateway.plant.example"

_LABEL = "[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
# A name that ends in a number is an IPv4 address for browsers and resolvers.
_NAME = re.compile(rf"(?=.{{1,253}}\Z)({_LABEL}\.)*(?![0-9]+\Z){_LABEL}", re.ASCII)


def parse_host_name(text: object) -> str:
    """Returns a host name in lower case. Raises `ValueError` for anything else."""
    if not isinstance(text, str) or _NAME.fullmatch(text) is None:
        raise ValueError(f"found {show(text)}, allowed: {HOST_NAME_FORM}")
    return text.lower()
