//! Access rules, compiled into tables.

use std::net::IpAddr;
use std::sync::Arc;

use holdfast_memory::Memory;
use holdfast_protocol::pdu::{Function, Request};
use ipnet::IpNet;

use crate::link::Route;
use crate::poller::Passage;

/// Functions of the standard that only read, and that memories do not know (V1.1b3, 6): exception
/// status, event log, file records, FIFO queue.
pub(super) const OTHER_READS: [u8; 4] = [7, 12, 20, 24];

/// The function of the standard that writes file records (V1.1b3, 6.15).
const WRITE_FILE_RECORD: u8 = 21;

/// What a rule allows its peers to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessMode {
    ReadOnly,
    ReadWrite,
}

/// The function codes of a rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Functions {
    All,
    Only(Vec<u8>),
    Except(Vec<u8>),
}

/// The rights of peers from some networks.
#[derive(Debug, Clone)]
pub struct Rule {
    pub sources: Vec<IpNet>,
    /// The roles that a rule applies to; empty text is the null role, `None` is any role. Only TLS
    /// has roles.
    pub roles: Option<Vec<String>>,
    pub units: Vec<(u8, Arc<Memory>)>,
    /// Units whose requests, or some of them, go to devices.
    pub elsewhere: Vec<(u8, Elsewhere)>,
    pub access: AccessMode,
    pub functions: Functions,
}

/// Where requests to a unit go that its memory does not answer.
#[derive(Debug, Clone)]
pub enum Elsewhere {
    /// All go to a device. The unit has no memory.
    Device(Route),
    /// Writes into some ranges of its memory are passed on.
    Mirror(Arc<Passage>),
}

/// The rules of a listener. The first rule that matches a peer applies.
#[derive(Debug)]
pub struct Policy<G> {
    rules: Vec<Entry<G>>,
}

#[derive(Debug)]
struct Entry<G> {
    sources: Vec<IpNet>,
    roles: Option<Vec<String>>,
    rights: Arc<G>,
}

impl<G> Policy<G> {
    /// Creates a policy from the sources and rights of each rule.
    pub fn new(rules: impl IntoIterator<Item = (Vec<IpNet>, G)>) -> Policy<G> {
        let rules = rules.into_iter().map(|(sources, rights)| {
            let rights = Arc::new(rights);
            Entry { sources, roles: None, rights }
        });
        Policy { rules: rules.collect() }
    }

    /// The rights of a peer, whatever its role; `None` when no rule matches. An IPv4-mapped IPv6
    /// address is treated as IPv4.
    pub fn rights(&self, peer: IpAddr) -> Option<&Arc<G>> {
        self.find(peer, |_| true)
    }

    /// The rights of a peer with that role; `None` when no rule matches.
    pub fn grant_of_role(&self, peer: IpAddr, role: &str) -> Option<&Arc<G>> {
        self.find(peer, |roles| roles.iter().any(|allowed| allowed == role))
    }

    fn find(&self, peer: IpAddr, allows: impl Fn(&[String]) -> bool) -> Option<&Arc<G>> {
        let peer = peer.to_canonical();
        let mut rules = self.rules.iter();
        let found = rules.find(|rule| {
            rule.sources.iter().any(|network| network.contains(&peer))
                && rule.roles.as_deref().is_none_or(&allows)
        });
        found.map(|rule| &rule.rights)
    }
}

impl Policy<PeerRights> {
    pub fn of(rules: &[Rule]) -> Policy<PeerRights> {
        let rules = rules.iter().map(|rule| Entry {
            sources: rule.sources.clone(),
            roles: rule.roles.clone(),
            rights: Arc::new(PeerRights::new(rule)),
        });
        Policy { rules: rules.collect() }
    }
}

/// One rule, compiled to tables.
#[derive(Debug)]
pub struct PeerRights {
    units: [Option<Arc<Memory>>; 256],
    /// `None` when memories answer everything.
    elsewhere: Option<Box<[Option<Elsewhere>; 256]>>,
    functions: [bool; 256],
    access: AccessMode,
}

impl PeerRights {
    pub fn new(rule: &Rule) -> PeerRights {
        let mut units = [const { None }; 256];
        for (unit, memory) in &rule.units {
            units[usize::from(*unit)] = Some(Arc::clone(memory));
        }
        let mut elsewhere = None;
        for (unit, place) in &rule.elsewhere {
            let units = elsewhere.get_or_insert_with(|| Box::new([const { None }; 256]));
            units[usize::from(*unit)] = Some(place.clone());
        }
        let is_device = |(_, place): &(u8, Elsewhere)| matches!(place, Elsewhere::Device(_));
        let has_devices = rule.elsewhere.iter().any(is_device);
        let functions = std::array::from_fn(|code| {
            let code = code as u8;
            let (named, listed) = match &rule.functions {
                Functions::All => (true, false),
                Functions::Only(codes) => (codes.contains(&code), true),
                Functions::Except(codes) => (!codes.contains(&code), false),
            };
            let writes = rule.access == AccessMode::ReadWrite;
            named
                && match Function::from_code(code) {
                    Some(function) => writes || !function.is_write(),
                    // Only devices know other functions.
                    None if !has_devices || code & 0x80 != 0 => false,
                    None if OTHER_READS.contains(&code) => true,
                    None => writes && (listed || code == WRITE_FILE_RECORD),
                }
        });
        PeerRights { units, elsewhere, functions, access: rule.access }
    }

    /// The memory of a unit id.
    #[inline]
    pub fn memory(&self, unit_id: u8) -> Option<&Memory> {
        self.units[usize::from(unit_id)].as_deref()
    }

    /// Where requests to a unit id go, or some of them.
    #[inline]
    pub(crate) fn elsewhere(&self, unit_id: u8) -> Option<&Elsewhere> {
        self.elsewhere.as_ref()?[usize::from(unit_id)].as_ref()
    }

    /// Whether a request to a device is denied for what follows its function code: a read-only peer may
    /// send only sub-functions that are known to change nothing.
    pub(crate) fn denies(&self, request: &[u8]) -> bool {
        let with_sub_functions = [Function::Diagnostics, Function::EncapsulatedInterface];
        let code = request.first().copied().unwrap_or_default();
        self.read_only()
            && with_sub_functions.iter().any(|function| function.code() == code)
            && !Request::parse(request).is_ok_and(|request| request.is_read())
    }

    /// One unit id per memory, chosen among the `wanted` unit ids.
    pub fn one_unit_of_each_memory(&self, wanted: impl Fn(u8) -> bool) -> Vec<u8> {
        let mut found: Vec<(u8, &Arc<Memory>)> = Vec::new();
        for (unit_id, memory) in (0..=u8::MAX).zip(&self.units) {
            if let Some(memory) = memory
                && wanted(unit_id)
                && !found.iter().any(|(_, known)| Arc::ptr_eq(known, memory))
            {
                found.push((unit_id, memory));
            }
        }
        found.into_iter().map(|(unit_id, _)| unit_id).collect()
    }

    /// Whether a function code is known and allowed.
    #[inline]
    pub fn allows(&self, function_code: u8) -> bool {
        self.functions[usize::from(function_code)]
    }

    pub fn read_only(&self) -> bool {
        self.access == AccessMode::ReadOnly
    }
}
