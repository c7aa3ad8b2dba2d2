//! Formats peers for the logs of Python.

use std::net::SocketAddr;

/// Formats the address of a peer. An IPv4-mapped IPv6 address is shown as IPv4.
pub fn text(peer: SocketAddr) -> String {
    SocketAddr::new(peer.ip().to_canonical(), peer.port()).to_string()
}
