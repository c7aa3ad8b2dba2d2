//! Peers as fields of events and audit lines.

use std::net::SocketAddr;

use holdfast_engine::server::Peer;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Formats the address of a peer. An IPv4-mapped IPv6 address is shown as IPv4.
pub fn text(peer: &Peer) -> String {
    SocketAddr::new(peer.ip(), peer.address.port()).to_string()
}

/// Adds the address of a peer to a dictionary, and what its certificate says.
pub fn add_to(fields: &Bound<'_, PyDict>, peer: &Peer) -> PyResult<()> {
    fields.set_item("peer", text(peer))?;
    if let Some(certificate) = &peer.certificate {
        fields.set_item("role", &certificate.role)?;
        fields.set_item("subject", &certificate.subject)?;
        fields.set_item("serial", &certificate.serial)?;
    }
    Ok(())
}
