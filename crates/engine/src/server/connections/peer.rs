//! The peer of a connection: its address, and what its certificate says.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use crate::tls::server::PeerCertificate;

/// The peer of a connection or datagram.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    pub address: SocketAddr,
    /// The certificate that a TLS peer has proved to own.
    pub certificate: Option<Arc<PeerCertificate>>,
}

impl Peer {
    /// The address without the port. An IPv4-mapped IPv6 address is given as IPv4.
    pub fn ip(&self) -> IpAddr {
        self.address.ip().to_canonical()
    }

    /// The role in its certificate; `None` without a certificate.
    pub(crate) fn role(&self) -> Option<&str> {
        self.certificate.as_ref().map(|certificate| &*certificate.role)
    }
}

impl From<SocketAddr> for Peer {
    fn from(address: SocketAddr) -> Peer {
        Peer { address, certificate: None }
    }
}
