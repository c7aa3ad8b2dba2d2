//! The addresses that a request may go to.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

/// The addresses of its device that a request may be sent to. By default, any.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct Peers(Option<Arc<[IpAddr]>>);

impl Peers {
    /// Only these.
    pub fn only(addresses: impl IntoIterator<Item = IpAddr>) -> Peers {
        let mut all: Vec<_> = addresses.into_iter().map(|each| each.to_canonical()).collect();
        // Equal reads have equal ones, in whatever order a name server gives them.
        all.sort_unstable();
        Peers(Some(all.into()))
    }

    /// Whether a request may be sent on a connection to `peer`; `None` if that is not known.
    pub(crate) fn hold(&self, peer: Option<IpAddr>) -> bool {
        let Some(all) = &self.0 else { return true };
        peer.is_some_and(|peer| all.contains(&peer.to_canonical()))
    }

    /// Whether a connection that others use, too, may be opened to any of the addresses of a name. For fewer of them
    /// it would lead those others to another device.
    pub(crate) fn hold_all(&self, found: &[SocketAddr]) -> bool {
        found.iter().all(|each| self.hold(Some(each.ip())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_goes_only_to_its_peers_in_either_form() {
        let found = |all: &[&str]| all.iter().map(|each| each.parse().unwrap()).collect::<Vec<_>>();
        let (both, one) = (found(&["[::1]:502", "127.0.0.1:502"]), found(&["127.0.0.1:502"]));
        assert!(Peers::default().hold_all(&both) && Peers::default().hold(None));
        let peers = Peers::only(["::ffff:127.0.0.1".parse().unwrap()]);
        assert!(peers.hold_all(&one) && !peers.hold_all(&both));
        assert!(!peers.hold(None), "who it is, is not known");
    }
}
