//! The rights of a peer, compiled to a table by unit id: what answers each unit, and what the peer may do with it.

use std::collections::BTreeMap;
use std::sync::Arc;

use holdfast_memory::{Area, Memory};
use holdfast_protocol::pdu::{ExceptionCode, Function, Request, SubFunction};

use crate::server::requests::exceptions::NOT_ALLOWED;
use crate::server::rights::functions::{
    AccessMode, Answerer, Codes, Functions, is_other_interface, only_reads,
};
use crate::server::rights::ranges::Ranges;
use crate::server::rights::rule::{RequestDestination, Rule};

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
    /// Where requests may go; the first destination that takes one gets it. `None` if the memory answers
    /// everything.
    destinations: Option<Box<[RequestDestination]>>,
    functions: Codes,
    /// Whether function 43 was listed: a device gets it with any MEI type then.
    lists_interface: bool,
    access: AccessMode,
    /// `None` if there is no limit.
    ranges: Option<Box<Ranges>>,
    exception_status: Option<(Area, u16)>,
    queues: Box<[u16]>,
}

impl UnitRights {
    /// The rights by a rule that names the unit, and the functions that a peer may learn of by it.
    fn new(
        rule: &Rule,
        unit_id: u8,
        memory: Option<Arc<Memory>>,
        destination: Option<RequestDestination>,
    ) -> (UnitRights, Codes) {
        let narrowed = rule.narrowed.iter().find(|(narrowed, _)| *narrowed == unit_id);
        let (access, allowed, ranges, exception_status, queues) = match narrowed {
            None => (rule.access, &rule.functions, None, None, Box::default()),
            Some((_, own)) => {
                let limited = !own.ranges.is_everything();
                let ranges = limited.then(|| Box::new(own.ranges.clone()));
                let queues = own.queues.clone();
                (own.access, &own.functions, ranges, own.exception_status, queues)
            }
        };
        let answerer = match destination {
            Some(RequestDestination::Device(_)) => Answerer::Device,
            _ => Answerer::Memory {
                exception_status: exception_status.is_some(),
                files: memory.as_ref().is_some_and(|memory| memory.layout().has_files()),
                queues: !queues.is_empty(),
            },
        };
        let functions = Codes::of(allowed, access, answerer);
        let interface = Function::EncapsulatedInterface.code();
        let lists_interface =
            matches!(allowed, Functions::Only(codes) if codes.contains(&interface));
        let known = match answerer {
            Answerer::Memory { .. } => functions,
            // A peer must not learn which units are of devices.
            Answerer::Device => Codes::of(allowed, access, Answerer::PLAIN_MEMORY),
        };
        let journal = memory.as_ref().filter(|memory| memory.has_journal()).cloned();
        let destinations: Box<[_]> =
            destination.into_iter().chain(journal.map(RequestDestination::Journal)).collect();
        let destinations = (!destinations.is_empty()).then_some(destinations);
        let unit = UnitRights {
            memory,
            destinations,
            functions,
            lists_interface,
            access,
            ranges,
            exception_status,
            queues,
        };
        (unit, known)
    }
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
    pub(super) fn of<'r>(rules: impl IntoIterator<Item = &'r Rule>) -> PeerRights {
        let mut units = Box::new([const { None }; 256]);
        let mut functions = Codes::default();
        for rule in rules {
            let mut own: BTreeMap<u8, (Option<Arc<Memory>>, Option<RequestDestination>)> =
                BTreeMap::new();
            for (unit, memory) in &rule.units {
                own.entry(*unit).or_default().0 = Some(Arc::clone(memory));
            }
            for (unit, destination) in &rule.destinations {
                own.entry(*unit).or_default().1 = Some(destination.clone());
            }
            for (unit_id, (memory, destination)) in own {
                let place = &mut units[usize::from(unit_id)];
                if place.is_some() {
                    continue;
                }
                let (unit, known) = UnitRights::new(rule, unit_id, memory, destination);
                functions = functions.with(known);
                *place = Some(unit);
            }
            if rule.units.is_empty() && rule.destinations.is_empty() {
                functions =
                    functions.with(Codes::of(&rule.functions, rule.access, Answerer::PLAIN_MEMORY));
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
    pub(crate) fn destinations(&self, unit_id: u8) -> Option<&[RequestDestination]> {
        self.unit(unit_id)?.destinations.as_deref()
    }

    /// The ranges that requests to a unit id must be inside, if they are limited.
    #[inline]
    pub(crate) fn ranges(&self, unit_id: u8) -> Option<&Ranges> {
        self.unit(unit_id)?.ranges.as_deref()
    }

    /// Where the eight bits are that function 7 reads from the memory of a unit id.
    pub(crate) fn exception_status(&self, unit_id: u8) -> Option<(Area, u16)> {
        self.unit(unit_id)?.exception_status
    }

    /// Whether function 24 finds a queue at a holding register of the memory of a unit id.
    pub(crate) fn has_queue(&self, unit_id: u8, address: u16) -> bool {
        self.unit(unit_id).is_some_and(|unit| unit.queues.contains(&address))
    }

    /// The exception for a request that the peer may not send to this unit: its function is not allowed (writes
    /// are not, for a peer that may only read), or its sub-function is unknown, or changes what it may only read.
    /// A unit that the peer does not have allows what any of its units allows.
    #[inline]
    pub(crate) fn refusal(
        &self,
        unit_id: u8,
        (function_code, pdu): (u8, &[u8]),
        request: &Result<Request<'_>, ExceptionCode>,
    ) -> Option<ExceptionCode> {
        let may_change = |unit: &UnitRights| {
            unit.access == AccessMode::ReadWrite && unit.functions.has(function_code)
        };
        let changes_state = || {
            function_code == Function::Diagnostics.code()
                && SubFunction::from_pdu(pdu).is_some_and(SubFunction::changes_state)
                && !self
                    .unit(unit_id)
                    .map_or_else(|| self.units.iter().flatten().any(may_change), may_change)
        };
        let refused = !self.allows(unit_id, function_code)
            || matches!(request, Err(ExceptionCode::IllegalFunction))
            || changes_state();
        refused.then_some(NOT_ALLOWED)
    }

    /// Whether a request to a device is denied although its function is allowed: a read-only peer may send
    /// only what is known to change nothing, which a sub-function decides too. And what has no known length could
    /// be several requests on a line: it must be listed.
    pub(crate) fn denies(&self, unit_id: u8, request: &[u8]) -> bool {
        let lists_interface = self.unit(unit_id).is_some_and(|unit| unit.lists_interface);
        self.is_read_only(unit_id) && !only_reads(request)
            || !lists_interface && is_other_interface(request)
    }

    /// Whether a function code is known and allowed for a unit; for a unit that the peer does not have,
    /// whether it is for any.
    #[inline]
    pub fn allows(&self, unit_id: u8, function_code: u8) -> bool {
        let functions = self.unit(unit_id).map_or(&self.functions, |unit| &unit.functions);
        functions.has(function_code)
    }

    /// Whether a peer may not write to a unit.
    pub fn is_read_only(&self, unit_id: u8) -> bool {
        self.unit(unit_id).is_none_or(|unit| unit.access == AccessMode::ReadOnly)
    }
}
