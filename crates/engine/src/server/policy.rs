//! Access rules, compiled into tables.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

use holdfast_memory::Memory;
use ipnet::IpNet;

use super::functions::{AccessMode, Codes, Functions, only_reads};
use super::ranges::Ranges;
use crate::link::Route;
use crate::poller::Passage;

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
    /// Units with rights of their own, in place of those of the rule.
    pub narrowed: Vec<(u8, Narrowed)>,
}

/// The rights of one unit.
#[derive(Debug, Clone)]
pub struct Narrowed {
    pub access: AccessMode,
    pub functions: Functions,
    pub ranges: Ranges,
}

/// Where requests to a unit go that its memory does not answer.
#[derive(Debug, Clone)]
pub enum Elsewhere {
    /// All go to a device. The unit has no memory.
    Device(Route),
    /// Writes into some ranges of its memory are passed on.
    Mirror(Arc<Passage>),
    /// Writes are carried out by the journal of its memory.
    Journal(Arc<Memory>),
}

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
    entries: Vec<PolicyEntry<Arc<G>>>,
}

impl<G> Grants<G> {
    pub fn new(entries: impl IntoIterator<Item = PolicyEntry<G>>) -> Grants<G> {
        let shared = |PolicyEntry { sources, roles, rights }| {
            let rights = Arc::new(rights);
            PolicyEntry { sources, roles, rights }
        };
        Grants { entries: entries.into_iter().map(shared).collect() }
    }

    /// The rights of a peer, whatever its role; `None` when no entry matches.
    pub fn rights(&self, peer: IpAddr) -> Option<Arc<G>> {
        self.find(peer, |_| true)
    }

    /// The rights of a peer with that role; `None` when no entry matches.
    pub fn rights_of_role(&self, peer: IpAddr, role: &str) -> Option<Arc<G>> {
        self.find(peer, |roles| has(roles, role))
    }

    fn find(&self, peer: IpAddr, allows: impl Fn(&[String]) -> bool) -> Option<Arc<G>> {
        let matches = |entry: &&PolicyEntry<Arc<G>>| {
            contain(&entry.sources, peer) && entry.roles.as_deref().is_none_or(&allows)
        };
        self.entries.iter().find(matches).map(|entry| Arc::clone(&entry.rights))
    }
}

fn has(roles: &[String], role: &str) -> bool {
    roles.iter().any(|allowed| allowed == role)
}

/// Whether one of the networks has this address. An IPv4-mapped IPv6 address is treated as IPv4.
fn contain(sources: &[IpNet], peer: IpAddr) -> bool {
    let peer = peer.to_canonical();
    sources.iter().any(|network| network.contains(&peer))
}

/// The rules of a Modbus listener. For each unit id, the first rule that names the peer and the unit
/// decides.
#[derive(Debug)]
pub struct Policy {
    rules: Vec<Rule>,
    /// The rights by each rule alone.
    alone: Vec<Arc<PeerRights>>,
    /// The rights by several rules, by their numbers.
    together: Mutex<HashMap<Vec<usize>, Arc<PeerRights>>>,
}

impl Policy {
    pub fn of(rules: &[Rule]) -> Policy {
        let alone = rules.iter().map(|rule| Arc::new(PeerRights::new(rule))).collect();
        Policy { rules: rules.to_vec(), alone, together: Mutex::default() }
    }

    /// The rights of a peer, whatever its role; `None` when no rule matches.
    pub fn rights(&self, peer: IpAddr) -> Option<Arc<PeerRights>> {
        self.find(peer, |_| true)
    }

    /// The rights of a peer with that role; `None` when no rule matches.
    pub fn rights_of_role(&self, peer: IpAddr, role: &str) -> Option<Arc<PeerRights>> {
        self.find(peer, |roles| has(roles, role))
    }

    fn find(&self, peer: IpAddr, allows: impl Fn(&[String]) -> bool) -> Option<Arc<PeerRights>> {
        let matches =
            |rule: &Rule| contain(&rule.sources, peer) && rule.roles.as_deref().is_none_or(&allows);
        let mut matching =
            self.rules.iter().enumerate().filter(|(_, rule)| matches(rule)).map(|(at, _)| at);
        let first = matching.next()?;
        let Some(second) = matching.next() else {
            return self.alone.get(first).cloned();
        };
        let numbers: Vec<usize> = [first, second].into_iter().chain(matching).collect();
        let mut together = self.together.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = together.get(&numbers) {
            return Some(Arc::clone(known));
        }
        let rules = numbers.iter().filter_map(|number| self.rules.get(*number));
        let rights = Arc::new(PeerRights::of(rules));
        together.insert(numbers, Arc::clone(&rights));
        Some(rights)
    }
}

/// The rights of a peer, compiled to a table by unit id.
#[derive(Debug)]
pub struct PeerRights {
    units: Box<[Option<UnitRights>; 256]>,
    /// The functions of all units together: what a peer learns of units that it does not have.
    functions: Codes,
}

#[derive(Debug)]
struct UnitRights {
    /// `None` if all requests go elsewhere.
    memory: Option<Arc<Memory>>,
    /// Where requests may go; the first place that takes one gets it. `None` if the memory answers
    /// everything.
    places: Option<Box<[Elsewhere]>>,
    functions: Codes,
    access: AccessMode,
    /// `None` if there is no limit.
    ranges: Option<Ranges>,
}

impl PeerRights {
    pub fn new(rule: &Rule) -> PeerRights {
        PeerRights::of([rule])
    }

    /// The rights of a peer that may do nothing: every request is answered with exception 01.
    pub fn none() -> PeerRights {
        PeerRights::of([])
    }

    /// The rights by some rules; for each unit id, the first one that names it decides.
    fn of<'r>(rules: impl IntoIterator<Item = &'r Rule>) -> PeerRights {
        let mut units = Box::new([const { None }; 256]);
        let mut functions = Codes::default();
        for rule in rules {
            let mut own: BTreeMap<u8, (Option<Arc<Memory>>, Option<Elsewhere>)> = BTreeMap::new();
            for (unit, memory) in &rule.units {
                own.entry(*unit).or_default().0 = Some(Arc::clone(memory));
            }
            for (unit, place) in &rule.elsewhere {
                own.entry(*unit).or_default().1 = Some(place.clone());
            }
            for (unit, (memory, elsewhere)) in own {
                let place = &mut units[usize::from(unit)];
                if place.is_some() {
                    continue;
                }
                let narrowed = rule.narrowed.iter().find(|(narrowed, _)| *narrowed == unit);
                let (access, allowed, ranges) = match narrowed {
                    None => (rule.access, &rule.functions, None),
                    Some((_, own)) => {
                        let ranges = (!own.ranges.is_everything()).then(|| own.ranges.clone());
                        (own.access, &own.functions, ranges)
                    }
                };
                let of_device = matches!(elsewhere, Some(Elsewhere::Device(_)));
                let codes = Codes::of(allowed, access, of_device);
                functions = functions.with(codes);
                let has_journal = |memory: &&Arc<Memory>| memory.has_journal();
                let journal = memory.as_ref().filter(has_journal).cloned().map(Elsewhere::Journal);
                let functions = codes;
                let places: Box<[_]> = elsewhere.into_iter().chain(journal).collect();
                let places = (!places.is_empty()).then_some(places);
                *place = Some(UnitRights { memory, places, functions, access, ranges });
            }
            if rule.units.is_empty() && rule.elsewhere.is_empty() {
                functions = functions.with(Codes::of(&rule.functions, rule.access, false));
            }
        }
        PeerRights { units, functions }
    }

    #[inline]
    fn unit(&self, unit_id: u8) -> Option<&UnitRights> {
        self.units[usize::from(unit_id)].as_ref()
    }

    /// The memory of a unit id.
    #[inline]
    pub fn memory(&self, unit_id: u8) -> Option<&Memory> {
        self.unit(unit_id)?.memory.as_deref()
    }

    /// Where requests to a unit id go, or some of them.
    #[inline]
    pub(crate) fn elsewhere(&self, unit_id: u8) -> Option<&[Elsewhere]> {
        self.unit(unit_id)?.places.as_deref()
    }

    /// The ranges that requests to a unit id must be inside, if they are limited.
    #[inline]
    pub(crate) fn ranges(&self, unit_id: u8) -> Option<&Ranges> {
        self.unit(unit_id)?.ranges.as_ref()
    }

    /// Whether a request to a device is denied although its function is allowed: a read-only peer may send
    /// only what is known to change nothing, which a sub-function decides too.
    pub(crate) fn denies(&self, unit_id: u8, request: &[u8]) -> bool {
        self.is_read_only(unit_id) && !only_reads(request)
    }

    /// One unit id per memory, chosen among the `wanted` unit ids: the first one that may do what is
    /// asked, or else the first one.
    pub fn one_unit_of_each_memory(
        &self,
        wanted: impl Fn(u8) -> bool,
        may: impl Fn(u8) -> bool,
    ) -> Vec<u8> {
        let mut found: Vec<(u8, &Arc<Memory>)> = Vec::new();
        for (unit_id, unit) in (0..=u8::MAX).zip(self.units.iter()) {
            let Some(memory) = unit.as_ref().and_then(|unit| unit.memory.as_ref()) else {
                continue;
            };
            if !wanted(unit_id) {
                continue;
            }
            match found.iter_mut().find(|(_, known)| Arc::ptr_eq(known, memory)) {
                None => found.push((unit_id, memory)),
                Some((chosen, _)) if !may(*chosen) && may(unit_id) => *chosen = unit_id,
                Some(_) => {}
            }
        }
        found.into_iter().map(|(unit_id, _)| unit_id).collect()
    }

    /// Whether a function code is known and allowed for a unit; for a unit that the peer does not have,
    /// whether it is for any.
    #[inline]
    pub fn allows(&self, unit_id: u8, function_code: u8) -> bool {
        let functions = self.unit(unit_id).map_or(&self.functions, |unit| &unit.functions);
        functions.has(function_code)
    }

    /// Whether a peer may not write to a unit; for a unit that it does not have, whether to none.
    pub fn is_read_only(&self, unit_id: u8) -> bool {
        let is_read_only = |unit: &UnitRights| unit.access == AccessMode::ReadOnly;
        match self.unit(unit_id) {
            Some(unit) => is_read_only(unit),
            None => self.units.iter().flatten().all(is_read_only),
        }
    }
}
