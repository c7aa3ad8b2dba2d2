"""Converts the address filters of the source."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.importing.peers import EVERYBODY, Peers, parse_network

if TYPE_CHECKING:
    from holdfast.importing.sections import Section
    from holdfast.net.addresses import Network

ALL = Peers.of(EVERYBODY)


def read_filter(parent: Section) -> Peers | None:
    """The peers that `ip_filter` admits, `None` without a filter. Denied networks win."""
    filters = parent.mapping("ip_filter")
    if filters is None:
        return None
    allow, deny = read_networks(filters, "allow"), read_networks(filters, "deny")
    filters.close()
    if not allow and not deny:
        return None
    return (Peers.of(allow) if allow else ALL) - Peers.of(deny)


def read_networks(section: Section, key: str, *, required: bool = False) -> list[Network]:
    """The networks of a list; empty entries are ignored, with a note."""
    networks = []
    for path, text in section.entries(key, required=required) or ():
        if text is None or text == "":
            section.desk.note("left out", path, "the entry is empty")
            continue
        try:
            networks.append(parse_network(text))
        except ValueError as error:
            section.desk.problem(path, str(error))
    return networks
