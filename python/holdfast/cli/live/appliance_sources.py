"""The memories of a running appliance as sources of `holdfast watch`."""

from __future__ import annotations

import hashlib
import http.client
import json
import ssl
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from holdfast.cli.live.sources import DeviceSource, Unreadable, Unwatchable, WatchedRange, within
from holdfast.cli.options import device
from holdfast.config.models.listeners import ModbusTcpListener
from holdfast.config.unit_rights import items, matching, together
from holdfast.net.addresses import joined, parse_address, reachable
from holdfast.net.certificates.own import own_der
from holdfast.protocol import READ_FUNCTIONS
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.cli.live.sources import Source
    from holdfast.config import Config
    from holdfast.config.models.services import RestConfig
    from holdfast.config.unit_rights import UnitRights
    from holdfast.config.values.ip_addresses import Bind


class _PinnedHttps(http.client.HTTPSConnection):
    """A connection to a server on this machine, whose certificate its configuration names."""

    def __init__(self, host: str, port: int, expected: bytes, timeout: float) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        # The certificate itself is compared, which is stricter than its name and its issuer.
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        super().__init__(host, port, timeout=timeout, context=context)
        self._expected = expected

    def connect(self) -> None:
        """Connects, and compares the certificate before anything is sent."""
        super().connect()
        assert isinstance(self.sock, ssl.SSLSocket)
        if self.sock.getpeercert(binary_form=True) != self._expected:
            self.close()
            raise ConnectionError("the server has another certificate than its configuration")


class Rest:
    """Blocks of memories, read over the REST interface of an appliance."""

    def __init__(
        self,
        settings: RestConfig,
        blocks: Sequence[WatchedRange],
        token: str | None,
        timeout: float,
    ) -> None:
        bind = settings.bind
        scheme = "http" if settings.tls is None else "https"
        address = reachable(bind.host, settings.sources), bind.port
        self.url = f"{scheme}://{joined(*address)}"
        self.where = f"REST at {self.url}"
        self.blocks = list(blocks)
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._connection = (
            http.client.HTTPConnection(*address, timeout=timeout)
            if settings.tls is None
            else _PinnedHttps(*address, own_der(settings.tls.cert_file), timeout)
        )

    def read(self) -> list[list[int]]:
        """Reads the values of each block."""
        try:
            return [self._values(block) for block in self.blocks]
        except (OSError, http.client.HTTPException, ValueError, KeyError) as error:
            self.close()
            if isinstance(error, OSError):
                raise
            raise Unreadable(f"invalid REST reply: {error!r}") from error

    def _values(self, block: WatchedRange) -> list[int]:
        query = {
            "memory": block.memory,
            "area": block.area,
            "address": block.address,
            "count": block.count,
        }
        self._connection.request(
            "GET", f"/api/v1/memory/read?{urlencode(query)}", headers=self._headers
        )
        response = self._connection.getresponse()
        answer = json.loads(response.read())
        if response.status != http.client.OK:
            raise Unreadable(f"{response.status} {answer['reason']}: {answer.get('detail', '')}")
        values: list[int] = answer["values"]
        return values

    def close(self) -> None:
        """Closes the connection."""
        self._connection.close()


def readable(
    config: Config, token: str | None
) -> tuple[list[WatchedRange], Callable[[list[WatchedRange], float], Source]]:
    """What can be read of an appliance, and how with a timeout: over REST if its file has that,
    otherwise from its first Modbus TCP listener. Raises `Unwatchable`.
    """
    rest = config.rest
    if rest is not None:
        needed = None if rest.tokens == "none" else token
        return by_rest(config, token), lambda blocks, timeout: Rest(rest, blocks, needed, timeout)
    name, address, found = by_modbus(config)
    url = f"tcp://{address}"

    def over_modbus(blocks: list[WatchedRange], timeout: float) -> Source:
        client = device.connect(url, blocks[0].unit, timeout)
        return DeviceSource(f"listener {name} at {url}", url, client, blocks)

    return found, over_modbus


def by_rest(config: Config, token: str | None) -> list[WatchedRange]:
    """The memories that the token may read. Raises `Unwatchable`."""
    rest = config.rest
    assert rest is not None
    _check_port("rest", rest.bind)
    if rest.tls is not None and rest.tls.client_ca_file is not None:
        raise Unwatchable("rest requires client certificates, which holdfast watch does not have")
    memories, areas = set(config.memories), set(AREAS)
    if rest.tokens != "none":
        if token is None:
            raise Unwatchable("rest requires a token: set HOLDFAST_TOKEN")
        digest = hashlib.sha256(token.encode()).hexdigest()
        granted = [each for each in rest.tokens if each.sha256.lower() == digest]
        if not granted:
            raise Unwatchable("rest does not accept the token in HOLDFAST_TOKEN")
        memories, areas = set(granted[0].memories), set(granted[0].areas)
    return [
        block
        for name in config.memories
        if name in memories
        for block in _areas(config, name, 0)
        if block.area in areas
    ]


def by_modbus(config: Config) -> tuple[str, str, list[WatchedRange]]:
    """The first Modbus TCP listener, where it is reached, and its readable memories.

    Raises `Unwatchable`.
    """
    found = [
        (name, listener)
        for name, listener in config.listeners.items()
        if isinstance(listener, ModbusTcpListener)
    ]
    if not found:
        raise Unwatchable("found neither rest nor a listener of type modbus-tcp")
    name, listener = found[0]
    _check_port(f"listener {name}", listener.bind)
    sources = [source for rule in listener.rules for source in rule.sources]
    host = reachable(listener.bind.host, sources)
    rules = matching(listener.rules, parse_address(host))
    if not rules:
        raise Unwatchable(f"no rule of listener {name} admits {host}")
    blocks: list[WatchedRange] = []
    seen: set[str] = set()
    for unit, rights in together(rules).items():
        if rights.memory is None or rights.memory in seen:
            continue
        readable = _readable(_areas(config, rights.memory, unit), rights)
        if readable:
            seen.add(rights.memory)
            blocks += readable
    return name, joined(host, listener.bind.port), blocks


def _check_port(what: str, bind: Bind) -> None:
    if bind.port == 0:
        raise Unwatchable(f"the port of {what} is 0, so the port in use is not known")


def _areas(config: Config, memory: str, unit: int) -> list[WatchedRange]:
    spans = [(area, getattr(config.memories[memory], area)) for area in AREAS]
    return [WatchedRange(memory, unit, area, span.start, span.size) for area, span in spans if span]


def _readable(blocks: Sequence[WatchedRange], rights: UnitRights) -> list[WatchedRange]:
    """The parts of blocks that may be read."""
    allowed = [block for block in blocks if rights.allows(READ_FUNCTIONS[block.area].code)]
    if rights.read is None:
        return allowed
    return [
        part
        for area, first, count in items(rights.read)
        for part in within(allowed, area, first, count)
    ]
