//! Reads that share a reply: equal ones that wait at the same time, and those that come soon after a
//! reply.

use std::cell::RefCell;
use std::collections::HashMap;
use std::time::Duration;

use holdfast_protocol::pdu::EncodedRequest;
use tokio::time::Instant;

use crate::link::route::Reply;

/// The most replies that are kept for equal reads.
const MAX_CACHED_READS: usize = 1024;

pub(in crate::link) struct SharedReads {
    /// Whether equal reads that wait at the same time share a reply.
    coalesce: bool,
    /// How long a reply answers equal reads.
    keep: Duration,
    /// Reads that wait for their turn, with the replies to equal ones that came later.
    waiting: RefCell<HashMap<Read, Vec<Reply>>>,
    cached: RefCell<HashMap<Read, Cached>>,
}

/// A read that equal ones can share a reply with: its unit id and PDU.
pub(in crate::link) type Read = (u8, Box<[u8]>);

struct Cached {
    pdu: Vec<u8>,
    until: Instant,
    changes: u64,
}

/// The key of a read whose reply can answer equal ones: functions 1 to 4.
pub(in crate::link) fn shareable(unit_id: u8, request: &EncodedRequest) -> Option<Read> {
    let pdu = request.pdu();
    (matches!(pdu[0], 1..=4) && request.request().is_some()).then(|| (unit_id, pdu.into()))
}

impl SharedReads {
    pub(in crate::link) fn new(coalesce: bool, keep: Duration) -> SharedReads {
        SharedReads { coalesce, keep, waiting: RefCell::default(), cached: RefCell::default() }
    }

    /// Adds the reply to an equal read that waits, and returns `None`; without one, returns a `Joining`.
    pub(in crate::link) fn join(&self, read: Option<Read>, reply: Reply) -> Option<Joining<'_>> {
        let Some(read) = read.filter(|_| self.coalesce) else {
            return Some(Joining { reads: self, read: None, first: Some(reply) });
        };
        let mut waiting = self.waiting.borrow_mut();
        if let Some(equal) = waiting.get_mut(&read) {
            equal.push(reply);
            return None;
        }
        waiting.insert(read.clone(), vec![reply]);
        Some(Joining { reads: self, read: Some(read), first: None })
    }

    /// A valid reply to an equal read. `changes` counts requests that may have changed a device.
    pub(in crate::link) fn cached(&self, read: &Read, changes: u64) -> Option<Vec<u8>> {
        if self.keep.is_zero() {
            return None;
        }
        let cached = self.cached.borrow();
        let found = cached.get(read)?;
        let holds = found.changes == changes && Instant::now() < found.until;
        holds.then(|| found.pdu.clone())
    }

    /// Keeps a reply for equal reads, until something may have changed a device since it was asked for.
    pub(in crate::link) fn keep(&self, read: Read, pdu: &[u8], changes: u64) {
        if self.keep.is_zero() {
            return;
        }
        let now = Instant::now();
        let mut cached = self.cached.borrow_mut();
        if cached.len() >= MAX_CACHED_READS {
            cached.retain(|_, kept| now < kept.until);
        }
        if cached.len() < MAX_CACHED_READS {
            cached.insert(read, Cached { pdu: pdu.to_vec(), until: now + self.keep, changes });
        }
    }
}

/// A request that waits for its turn, and the replies to equal ones.
pub(in crate::link) struct Joining<'r> {
    reads: &'r SharedReads,
    read: Option<Read>,
    first: Option<Reply>,
}

impl Joining<'_> {
    /// The request is sent now: later equal reads are answered by another one.
    pub(in crate::link) fn leave(mut self) -> Vec<Reply> {
        let joined =
            self.read.take().and_then(|read| self.reads.waiting.borrow_mut().remove(&read));
        joined.unwrap_or_else(|| self.first.take().into_iter().collect())
    }
}
