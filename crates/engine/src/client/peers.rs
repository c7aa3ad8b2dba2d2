//! The addresses that a request may go to.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

/// The addresses of its device that a request may be sent to. By default, any.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct Peers(Option<Arc<[IpAddr]>>);

impl Peers {
    /// Only these.
    pub fn only(addresses: impl IntoIterator<Item = IpAddr>) -> Peers {
        Peers(Some(addresses.into_iter().map(|each| each.to_canonical()).collect()))
    }

    /// Whether a request may be sent on a connection to `peer`; `None` if that is not known.
    pub(crate) fn hold(&self, peer: Option<IpAddr>) -> bool {
        let Some(all) = &self.0 else { return true };
        peer.is_some_and(|peer| all.contains(&peer.to_canonical()))
    }

    /// Those of the addresses of a name that may be connected to; `None` if all are others.
    pub(crate) fn among(&self, mut found: Vec<SocketAddr>) -> Option<Vec<SocketAddr>> {
        if self.0.is_none() {
            return Some(found);
        }
        found.retain(|each| self.hold(Some(each.ip())));
        (!found.is_empty()).then_some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_goes_only_to_its_peers_in_either_form() {
        let found = |all: &[&str]| all.iter().map(|each| each.parse().unwrap()).collect::<Vec<_>>();
        let (both, other) = (found(&["[::1]:502", "127.0.0.1:502"]), found(&["[::1]:502"]));
        assert_eq!(Peers::default().among(both.clone()), Some(both.clone()));
        assert!(Peers::default().hold(None));
        let peers = Peers::only(["::ffff:127.0.0.1".parse().unwrap()]);
        assert_eq!(peers.among(both), Some(found(&["127.0.0.1:502"])));
        assert_eq!(peers.among(other), None);
        assert!(!peers.hold(None), "who it is, is not known");
    }
}
