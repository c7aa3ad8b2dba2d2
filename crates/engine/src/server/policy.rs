//! Access rules, compiled into tables.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

use holdfast_memory::{Area, Memory};
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
}

/// Which peers have which rights: the first entry whose sources contain a peer applies.
#[derive(Debug)]
pub struct Grants<G> {
    entries: Vec<(Vec<IpNet>, Arc<G>)>,
}

impl<G> Grants<G> {
    pub fn new(entries: impl IntoIterator<Item = (Vec<IpNet>, G)>) -> Grants<G> {
        let entries = entries.into_iter().map(|(sources, rights)| (sources, Arc::new(rights)));
        Grants { entries: entries.collect() }
    }

    /// The rights of a peer; `None` when no entry matches.
    pub fn rights(&self, peer: IpAddr) -> Option<Arc<G>> {
        let mut entries = self.entries.iter();
        entries.find(|(sources, _)| contain(sources, peer)).map(|(_, rights)| Arc::clone(rights))
    }
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
        self.find(peer, |roles| roles.iter().any(|allowed| allowed == role))
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

/// Ranges of areas, for reading and for writing; `None` is everything.
#[derive(Debug, Clone, Default)]
pub struct Ranges {
    read: Option<Vec<Items>>,
    write: Option<Vec<Items>>,
}

/// Items of an area.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Items {
    pub area: Area,
    pub address: u16,
    pub count: u32,
}

impl Items {
    fn end(self) -> u32 {
        u32::from(self.address) + self.count
    }

    fn is_in(self, ranges: &Option<Vec<Items>>) -> bool {
        ranges.as_ref().is_none_or(|ranges| {
            ranges.iter().any(|range| {
                range.area == self.area
                    && range.address <= self.address
                    && self.end() <= range.end()
            })
        })
    }
}

impl Ranges {
    pub fn new(read: Option<Vec<Items>>, write: Option<Vec<Items>>) -> Ranges {
        Ranges { read: read.map(joined), write: write.map(joined) }
    }

    fn is_everything(&self) -> bool {
        self.read.is_none() && self.write.is_none()
    }

    /// Whether a request reads and writes only inside the ranges.
    pub(crate) fn allow(&self, request: &Request<'_>) -> bool {
        let (read, written) = touched(request);
        read.is_none_or(|items| items.is_in(&self.read))
            && written.is_none_or(|items| items.is_in(&self.write))
    }
}

/// Joins ranges that meet, so that a request may cross from one into the other.
fn joined(mut ranges: Vec<Items>) -> Vec<Items> {
    ranges.sort_by_key(|range| {
        (Area::ALL.iter().position(|area| *area == range.area), range.address)
    });
    let mut all: Vec<Items> = Vec::new();
    for range in ranges {
        match all.last_mut() {
            Some(last) if last.area == range.area && u32::from(range.address) <= last.end() => {
                last.count = range.end().max(last.end()) - u32::from(last.address);
            }
            _ => all.push(range),
        }
    }
    all
}

/// What a request reads, and what it writes.
fn touched(request: &Request<'_>) -> (Option<Items>, Option<Items>) {
    let items = |area, address, count: u16| Some(Items { area, address, count: count.into() });
    let (coils, registers) = (Area::Coils, Area::HoldingRegisters);
    match *request {
        Request::ReadCoils(range) => (items(coils, range.address(), range.quantity()), None),
        Request::ReadDiscreteInputs(range) => {
            (items(Area::DiscreteInputs, range.address(), range.quantity()), None)
        }
        Request::ReadHoldingRegisters(range) => {
            (items(registers, range.address(), range.quantity()), None)
        }
        Request::ReadInputRegisters(range) => {
            (items(Area::InputRegisters, range.address(), range.quantity()), None)
        }
        Request::WriteSingleCoil { address, .. } => (None, items(coils, address, 1)),
        Request::WriteSingleRegister { address, .. }
        | Request::MaskWriteRegister { address, .. } => (None, items(registers, address, 1)),
        Request::WriteMultipleCoils { address, bits } => {
            (None, items(coils, address, bits.quantity()))
        }
        Request::WriteMultipleRegisters { address, registers: new } => {
            (None, items(registers, address, new.quantity()))
        }
        Request::ReadWriteMultipleRegisters { read, write_address, registers: new } => (
            items(registers, read.address(), read.quantity()),
            items(registers, write_address, new.quantity()),
        ),
        _ => (None, None),
    }
}

/// Function codes.
#[derive(Debug, Clone, Copy, Default)]
struct Codes([u64; 4]);

impl Codes {
    #[inline]
    fn has(&self, code: u8) -> bool {
        self.0[usize::from(code >> 6)] >> (code & 63) & 1 == 1
    }

    fn of(functions: &Functions, access: AccessMode, of_device: bool) -> Codes {
        let mut codes = Codes::default();
        for code in (0..=u8::MAX).filter(|code| is_allowed(*code, functions, access, of_device)) {
            codes.0[usize::from(code >> 6)] |= 1 << (code & 63);
        }
        codes
    }

    fn with(self, other: Codes) -> Codes {
        Codes(std::array::from_fn(|index| self.0[index] | other.0[index]))
    }
}

fn is_allowed(code: u8, functions: &Functions, access: AccessMode, of_device: bool) -> bool {
    let (named, listed) = match functions {
        Functions::All => (true, false),
        Functions::Only(codes) => (codes.contains(&code), true),
        Functions::Except(codes) => (!codes.contains(&code), false),
    };
    let writes = access == AccessMode::ReadWrite;
    named
        && match Function::from_code(code) {
            Some(function) => writes || !function.is_write(),
            // Only devices know other functions.
            None if !of_device || code & 0x80 != 0 => false,
            None if OTHER_READS.contains(&code) => true,
            None => writes && (listed || code == WRITE_FILE_RECORD),
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
    /// `None` if the memory answers everything.
    elsewhere: Option<Elsewhere>,
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
                *place = Some(UnitRights { memory, elsewhere, functions: codes, access, ranges });
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
    pub(crate) fn elsewhere(&self, unit_id: u8) -> Option<&Elsewhere> {
        self.unit(unit_id)?.elsewhere.as_ref()
    }

    /// The ranges that requests to a unit id must be inside, if they are limited.
    #[inline]
    pub(crate) fn ranges(&self, unit_id: u8) -> Option<&Ranges> {
        self.unit(unit_id)?.ranges.as_ref()
    }

    /// Whether a request to a device is denied for what follows its function code: a read-only peer may
    /// send only sub-functions that are known to change nothing.
    pub(crate) fn denies(&self, unit_id: u8, request: &[u8]) -> bool {
        let with_sub_functions = [Function::Diagnostics, Function::EncapsulatedInterface];
        let code = request.first().copied().unwrap_or_default();
        self.is_read_only(unit_id)
            && with_sub_functions.iter().any(|function| function.code() == code)
            && !Request::parse(request).is_ok_and(|request| request.is_read())
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
