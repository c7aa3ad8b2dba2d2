//! Peers as Python's logs have them.

use std::net::SocketAddr;

/// A peer as text, an IPv4 address mapped into IPv6 as that IPv4 address.
pub fn text(peer: SocketAddr) -> String {
    SocketAddr::new(peer.ip().to_canonical(), peer.port()).to_string()
}
