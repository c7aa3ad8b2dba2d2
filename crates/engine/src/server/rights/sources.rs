//! Which peers a rule is for: its networks, and its roles of certificates.

use std::net::IpAddr;

use ipnet::IpNet;

/// Whether a rule with these sources and roles is for a peer.
pub(super) fn match_peer(
    sources: &[IpNet],
    roles: &Option<Vec<String>>,
    peer: IpAddr,
    role: Option<&str>,
) -> bool {
    let is_allowed =
        |role| roles.as_ref().is_none_or(|roles| roles.iter().any(|each| each == role));
    contain(sources, peer) && role.is_none_or(is_allowed)
}

/// Whether one of the networks has this address. An IPv4-mapped IPv6 address is treated as IPv4.
pub(crate) fn contain(sources: &[IpNet], peer: IpAddr) -> bool {
    let peer = peer.to_canonical();
    sources.iter().any(|network| network.contains(&peer))
}
