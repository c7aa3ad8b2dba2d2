//! A rule of a listener: for which peers it is, and what they may do with which units.

use std::sync::Arc;

use holdfast_memory::{Area, Memory};
use ipnet::IpNet;

use crate::link::Route;
use crate::poller::Passage;
use crate::server::rights::functions::{AccessMode, Functions};
use crate::server::rights::ranges::Ranges;

/// The rights of peers from some networks.
#[derive(Debug, Clone)]
pub struct Rule {
    pub sources: Vec<IpNet>,
    /// The roles that a rule applies to; empty text is the null role, `None` is any role. Only TLS
    /// has roles.
    pub roles: Option<Vec<String>>,
    pub units: Vec<(u8, Arc<Memory>)>,
    /// Units whose requests, or some of them, go to devices.
    pub destinations: Vec<(u8, RequestDestination)>,
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
    /// Area and address of the eight bits that function 7 reads; with `None`, the unit does not have it.
    pub exception_status: Option<(Area, u16)>,
    /// The holding registers that function 24 finds a queue at; without any, the unit does not have it.
    pub queues: Box<[u16]>,
}

/// Where requests to a unit go that its memory does not answer.
#[derive(Debug, Clone)]
pub enum RequestDestination {
    /// All go to a device. The unit has no memory.
    Device(Route),
    /// Writes into some ranges of its memory are passed on.
    Mirror(Arc<Passage>),
    /// Writes are carried out by the journal of its memory.
    Journal(Arc<Memory>),
}

impl RequestDestination {
    /// Whether requests are sent to a device.
    pub(crate) fn is_device(&self) -> bool {
        matches!(self, RequestDestination::Device(_) | RequestDestination::Mirror(_))
    }

    /// The memory of the unit; `None` if it is a device.
    pub(crate) fn memory(&self) -> Option<&Memory> {
        match self {
            RequestDestination::Device(_) => None,
            RequestDestination::Mirror(passage) => Some(&passage.memory),
            RequestDestination::Journal(memory) => Some(memory),
        }
    }
}
