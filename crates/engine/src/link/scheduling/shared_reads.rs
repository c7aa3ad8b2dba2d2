//! Reads that share a reply: equal ones that wait at the same time, and those that come soon after a
//! reply.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;
use std::time::Duration;

use holdfast_protocol::pdu::EncodedRequest;
use holdfast_runtime::suspend_aware_time;
use tokio::sync::Notify;

use crate::client::Peers;
use crate::link::route::Reply;

/// The most replies that are kept for equal reads.
const MAX_CACHED_READS: usize = 1024;

pub(in crate::link) struct SharedReads {
    /// Whether equal reads that wait at the same time share a reply.
    coalesce: bool,
    /// How long a reply answers equal reads.
    keep: Duration,
    /// By their timeouts too, as none waits longer than its own, and by where they may be sent.
    waiting: RefCell<HashMap<WaitingKey, Rc<EqualReads>>>,
    cached: RefCell<HashMap<ReadKey, Cached>>,
}

/// A read that equal ones can share a reply with: its unit id and PDU.
pub(in crate::link) type ReadKey = (u8, Box<[u8]>);

type WaitingKey = (ReadKey, Duration, Peers);

/// Equal reads. Each waits for a turn of its own, so that none waits longer than without the others; the
/// first to have it is sent for all.
#[derive(Default)]
struct EqualReads {
    replies: RefCell<Vec<Reply>>,
    sent: Notify,
}

struct Cached {
    pdu: Vec<u8>,
    /// By a clock that goes on while the machine is suspended.
    until: Duration,
    /// The count of changes when the read was sent.
    changes: u64,
}

/// The key of a read whose reply can answer equal ones: functions 1 to 4.
pub(in crate::link) fn shareable(unit_id: u8, request: &EncodedRequest) -> Option<ReadKey> {
    let pdu = request.pdu();
    (matches!(pdu[0], 1..=4) && request.request().is_some()).then(|| (unit_id, pdu.into()))
}

impl SharedReads {
    pub(in crate::link) fn new(coalesce: bool, keep: Duration) -> SharedReads {
        SharedReads { coalesce, keep, waiting: RefCell::default(), cached: RefCell::default() }
    }

    /// Lets a request wait with equal reads, if it is a read.
    pub(in crate::link) fn join(&self, read: Option<ReadKey>, reply: Reply) -> Joining<'_> {
        let read = read.filter(|_| self.coalesce);
        let read = read.map(|read| (read, reply.longest_wait, reply.peers.clone()));
        let equal = match &read {
            Some(read) => Rc::clone(self.waiting.borrow_mut().entry(read.clone()).or_default()),
            None => Rc::default(),
        };
        equal.replies.borrow_mut().push(reply);
        let follows_equal = equal.replies.borrow().len() > 1;
        Joining { reads: self, read, equal, follows_equal }
    }

    /// A valid reply to an equal read. `changes` counts requests that may have changed a device.
    pub(in crate::link) fn cached(&self, read: &ReadKey, changes: u64) -> Option<Vec<u8>> {
        if self.keep.is_zero() {
            return None;
        }
        let cached = self.cached.borrow();
        let found = cached.get(read)?;
        let holds = found.changes == changes && suspend_aware_time() < found.until;
        holds.then(|| found.pdu.clone())
    }

    /// Keeps a reply for equal reads, until something may have changed a device since it was asked for.
    pub(in crate::link) fn keep(&self, read: ReadKey, pdu: &[u8], changes: u64) {
        if self.keep.is_zero() {
            return;
        }
        let now = suspend_aware_time();
        let mut cached = self.cached.borrow_mut();
        if cached.len() >= MAX_CACHED_READS {
            cached.retain(|_, kept| now < kept.until);
        }
        if cached.len() < MAX_CACHED_READS {
            cached.insert(read, Cached { pdu: pdu.to_vec(), until: now + self.keep, changes });
        }
    }
}

/// A request that waits for its turn.
pub(in crate::link) struct Joining<'r> {
    reads: &'r SharedReads,
    read: Option<WaitingKey>,
    equal: Rc<EqualReads>,
    /// Whether an equal read waited before it.
    pub(in crate::link) follows_equal: bool,
}

impl Joining<'_> {
    /// Waits until an equal read is sent.
    pub(in crate::link) async fn sent(&self) {
        self.equal.sent.notified().await;
    }

    /// Its client has disconnected: its place in the queue is free, and equal reads wait without it.
    pub(in crate::link) fn withdraw(self) {
        self.equal.replies.borrow_mut().retain(|reply| !reply.is_unwanted());
        // One reference is in `waiting`, the other is this one.
        let is_last = Rc::strong_count(&self.equal) == 2;
        if let Some(read) = self.read.as_ref().filter(|_| is_last) {
            self.reads.waiting.borrow_mut().remove(read);
        }
    }

    /// The request is sent now: later equal reads are answered by another one.
    pub(in crate::link) fn leave(self) -> Vec<Reply> {
        if let Some(read) = &self.read {
            self.reads.waiting.borrow_mut().remove(read);
        }
        self.equal.sent.notify_waiters();
        self.equal.replies.take()
    }
}
