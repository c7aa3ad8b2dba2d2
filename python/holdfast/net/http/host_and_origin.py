"""The rule for Host, Origin and Sec-Fetch-Site, which every HTTP application applies.

It keeps web pages out. A page of another site can send requests to any address that its visitor
reaches; the browser tells where they come from. And a page can point its own name at this machine
(DNS rebinding), so that the browser takes it for a page of this server; the name in Host tells.
"""

from __future__ import annotations

import functools
import re
from ipaddress import ip_address
from typing import TYPE_CHECKING

from holdfast.net.addresses import LOOPBACK, unbracketed
from holdfast.net.http.requests import BadRequest

if TYPE_CHECKING:
    from collections.abc import Container

    from holdfast.net.addresses import Address
    from holdfast.net.http.requests import Request

_OWN = (b"same-origin", b"none")
"""The values of Sec-Fetch-Site for a page of this server, and for what a person opens."""


class Origins:
    """The rule of one application."""

    def __init__(
        self, *, names: Container[str] | None, name_refusal: str, is_https: bool = False
    ) -> None:
        """`names`: those that Host may have besides addresses, in lower case; `None`: any.

        `name_refusal` is the error for another name, which says what is allowed.
        """
        self._names = names
        self._name_refusal = name_refusal
        self._schemes = (b"https",) if is_https else (b"http", b"https")
        """Over HTTP, an Origin may have HTTPS: a proxy in front of this server may speak it."""

    @staticmethod
    def check_host(request: Request) -> None:
        """Raises `BadRequest` unless the request has one Host; with HTTP/1.0 it may have none."""
        hosts = len(request.values(b"host"))
        if hosts > 1 or (hosts == 0 and request.version != "1.0"):
            raise BadRequest("malformed", f"{hosts} Host headers, HTTP/1.1 requires exactly one")

    def check(self, request: Request) -> None:
        """Raises `BadRequest` for a request of another site's page, and for a name in Host."""
        if self._is_foreign(request):
            raise BadRequest("foreign_page", "the request is from a page of another site")
        if self._names is None or (host := request.header(b"host")) is None:
            return
        name = _name_in(host)
        if name not in self._names and name != "localhost" and _address_in(name) is None:
            raise BadRequest("foreign_page", self._name_refusal)

    def admits(self, request: Request) -> bool:
        """Whether `check` finds nothing."""
        try:
            self.check(request)
        except BadRequest:
            return False
        return True

    def browsers_mark_foreign_requests(self, request: Request) -> bool:
        """Whether browsers mark every request of another site's page to this Host.

        They send Sec-Fetch-Site to URLs that are potentially trustworthy (Fetch Metadata). To
        others, a GET may have neither that nor Origin.

        - All are marked to `localhost`, to loopback addresses, and over HTTPS to any address.
        - They may not be to other names, and over HTTP to other addresses, also to those that reach
          this machine unknown to browsers: unspecified ones, as `0.0.0.0`, and IPv4-mapped ones.
        """
        host = request.header(b"host")
        if host is None:
            return True
        name = _name_in(host)
        address = _address_in(name)
        is_local = address is not None and (
            b"http" not in self._schemes or any(address in network for network in LOOPBACK)
        )
        return name == "localhost" or is_local

    def _is_foreign(self, request: Request) -> bool:
        origins = request.values(b"origin")
        if origins:
            scheme, _, host = origins[0].lower().partition(b"://")
            own = (request.header(b"host") or b"").lower()
            if len(origins) > 1 or scheme not in self._schemes or host != own:
                return True
        return any(site not in _OWN for site in request.values(b"sec-fetch-site"))


def is_from_page(request: Request) -> bool:
    """Whether a web page sent the request, also one of this server."""
    return any(request.values(name) for name in (b"origin", b"referer", b"sec-fetch-site"))


@functools.lru_cache(maxsize=64)
def _name_in(host: bytes) -> str:
    """Returns a Host header without the port, in lower case: a name or an address."""
    return re.sub(r":[0-9]*\Z", "", host.decode("latin-1")).lower()


@functools.lru_cache(maxsize=64)
def _address_in(name: str) -> Address | None:
    """Returns the address that a browser names this server by; `None` for a name.

    An address with a zone is none: no URL has one.
    """
    try:
        return None if "%" in name else ip_address(unbracketed(name))
    except ValueError:
        return None
