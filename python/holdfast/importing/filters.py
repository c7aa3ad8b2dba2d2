"""The source's filters of addresses: who may connect."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.importing.peers import EVERYBODY, Peers, parse_network

if TYPE_CHECKING:
    from holdfast.importing.sections import Section
    from holdfast.net.addresses import Network

ALL = Peers.of(EVERYBODY)


def read_filter(parent: Section) -> Peers | None:
    """Those whom `ip_filter` lets in, `None` when there is no filter. To be denied wins."""
    filters = parent.mapping("ip_filter")
    if filters is None:
        return None
    allow, deny = read_networks(filters, "allow"), read_networks(filters, "deny")
    filters.close()
    if not allow and not deny:
        return None
    return (Peers.of(allow) if allow else ALL) - Peers.of(deny)


def read_networks(section: Section, key: str, *, required: bool = False) -> list[Network]:
    """The networks of a list; empty entries name nobody."""
    networks = []
    for path, text in section.entries(key, required=required) or ():
        if text is None or text == "":
            section.desk.note("left out", path, "an empty entry, which names nobody")
            continue
        try:
            networks.append(parse_network(text))
        except ValueError as error:
            section.desk.problem(path, str(error))
    return networks
