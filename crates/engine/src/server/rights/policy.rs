//! Access rules: which of them are for a peer. [`PeerRights`] takes the first of these that names a unit, and
//! decides what is refused.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use holdfast_runtime::lock;
use ipnet::IpNet;

use crate::server::connections::peer::Peer;
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::rule::Rule;
use crate::server::rights::sources::match_peer;

/// The rights of some peers.
#[derive(Debug)]
pub struct PolicyEntry<G> {
    pub sources: Vec<IpNet>,
    /// As in [`Rule`].
    pub roles: Option<Vec<String>>,
    pub rights: G,
}

/// Which peers have which rights: the first entry that matches a peer applies.
#[derive(Debug)]
pub struct Grants<G> {
    pub entries: Vec<PolicyEntry<Arc<G>>>,
    /// Those of a peer that no entry matches.
    pub nobody: Arc<G>,
}

impl<G> Grants<G> {
    /// The rights of a peer with that role, or whatever its role; `None` when no entry matches.
    pub fn rights(&self, peer: IpAddr, role: Option<&str>) -> Option<Arc<G>> {
        let mut entries = self.entries.iter();
        let found = entries.find(|entry| match_peer(&entry.sources, &entry.roles, peer, role));
        found.map(|entry| Arc::clone(&entry.rights))
    }

    /// As [`Policy::by_certificate`]: each packet is refused.
    pub(crate) fn by_certificate(&self, peer: &Peer) -> Result<Arc<G>, Arc<G>> {
        self.rights(peer.ip(), peer.role()).ok_or_else(|| Arc::clone(&self.nobody))
    }
}

/// The rules of a Modbus listener. For each unit id, the first rule that names the peer and the unit
/// decides.
#[derive(Debug)]
pub struct Policy {
    rules: Vec<Rule>,
    /// The rights of a peer that no rule names.
    pub(crate) nobody: Arc<PeerRights>,
    /// The rights by each rule alone.
    alone: Vec<Arc<PeerRights>>,
    /// The rights by several rules, by their numbers.
    together: Mutex<HashMap<Vec<usize>, Arc<PeerRights>>>,
}

impl Policy {
    pub fn of(rules: &[Rule]) -> Policy {
        let alone = rules.iter().map(|rule| Arc::new(PeerRights::new(rule))).collect();
        let nobody = Arc::new(PeerRights::none());
        Policy { rules: rules.to_vec(), nobody, alone, together: Mutex::default() }
    }

    /// The rights of a peer with that role, or whatever its role; `None` when no rule matches.
    pub fn rights(&self, peer: IpAddr, role: Option<&str>) -> Option<Arc<PeerRights>> {
        let matches = |rule: &Rule| match_peer(&rule.sources, &rule.roles, peer, role);
        let mut matching =
            self.rules.iter().enumerate().filter(|(_, rule)| matches(rule)).map(|(at, _)| at);
        let first = matching.next()?;
        let Some(second) = matching.next() else {
            return self.alone.get(first).cloned();
        };
        let numbers: Vec<usize> = [first, second].into_iter().chain(matching).collect();
        let mut together = lock(&self.together);
        if let Some(known) = together.get(&numbers) {
            return Some(Arc::clone(known));
        }
        let rules = numbers.iter().filter_map(|number| self.rules.get(*number));
        let rights = Arc::new(PeerRights::of(rules));
        together.insert(numbers, Arc::clone(&rights));
        Some(rights)
    }

    /// The rights by the role in a certificate; `Err` with those of nobody when no rule matches. The session
    /// stays, and each request gets exception 01 (MB-TCP-Security, R-23, R-31), which tells the peer more than
    /// the end of the connection.
    pub(crate) fn by_certificate(&self, peer: &Peer) -> Result<Arc<PeerRights>, Arc<PeerRights>> {
        self.rights(peer.ip(), peer.role()).ok_or_else(|| Arc::clone(&self.nobody))
    }
}
