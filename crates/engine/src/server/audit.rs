//! Writes, for an audit log. Sending never blocks: when the queue is full, records are dropped and
//! counted.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use holdfast_protocol::pdu::Function;
use holdfast_protocol::raw_ingest;

use super::functions::only_reads;
use super::peer::Peer;

/// The most bytes in the queue.
const CAPACITY: usize = 32 << 20;

/// Bytes of a record without its data.
const OVERHEAD: usize = 128;

/// A write that was carried out or refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    pub listener: Arc<str>,
    /// `None` on a serial line.
    pub peer: Option<Peer>,
    pub write: Written,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Written {
    /// A request, unchanged, and the code of the exception that it was refused with. `route` is the
    /// name of what it was passed on to.
    Modbus { unit_id: u8, pdu: Vec<u8>, refused: Option<u8>, route: Option<Arc<str>> },
    /// A packet: its header, if it has a valid one, and the payload if it was written.
    Packet {
        format: raw_ingest::Format,
        header: Option<raw_ingest::Header>,
        payload: Vec<u8>,
        refused: Option<raw_ingest::Refusal>,
    },
}

/// The sending side.
#[derive(Debug, Clone)]
pub(crate) struct Auditor {
    sender: Sender<Record>,
    shared: Arc<Shared>,
}

/// The receiving side.
#[derive(Debug)]
pub(crate) struct Records {
    receiver: Mutex<Receiver<Record>>,
    /// Without listeners, nobody else can send: whoever waits must still wait.
    _sender: Sender<Record>,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    waiting: AtomicUsize,
    lost: AtomicU64,
}

pub(crate) fn auditing() -> (Auditor, Records) {
    let (sender, receiver) = channel();
    let shared = Arc::new(Shared::default());
    let records = Records {
        receiver: Mutex::new(receiver),
        _sender: sender.clone(),
        shared: Arc::clone(&shared),
    };
    (Auditor { sender, shared }, records)
}

impl Auditor {
    /// Records a Modbus request if it writes. `reply` is its reply; empty when there is none.
    pub(crate) fn note(
        &self,
        listener: &Arc<str>,
        peer: Option<&Peer>,
        unit_id: u8,
        request: &[u8],
        reply: &[u8],
    ) {
        let function = request.first().copied().and_then(Function::from_code);
        if function.is_some_and(Function::is_write) {
            self.send(record(listener, peer, unit_id, request, reply, None));
        }
    }

    /// Records a request to a device, unless it is known to only read. `reply` is what the device
    /// answered, or what was answered in its place.
    pub(crate) fn note_forwarded(
        &self,
        listener: &Arc<str>,
        peer: Option<&Peer>,
        unit_id: u8,
        (route, request, reply): (Option<&Arc<str>>, &[u8], &[u8]),
    ) {
        if !only_reads(request) {
            self.send(record(listener, peer, unit_id, request, reply, route.cloned()));
        }
    }

    pub(crate) fn send(&self, record: Record) {
        let size = record.size();
        if self.shared.waiting.fetch_add(size, Ordering::Relaxed) > CAPACITY
            || self.sender.send(record).is_err()
        {
            self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn record(
    listener: &Arc<str>,
    peer: Option<&Peer>,
    unit_id: u8,
    request: &[u8],
    reply: &[u8],
    route: Option<Arc<str>>,
) -> Record {
    let refused = match reply {
        [code, exception, ..] if code & 0x80 != 0 => Some(*exception),
        _ => None,
    };
    let write = Written::Modbus { unit_id, pdu: request.to_vec(), refused, route };
    Record { listener: Arc::clone(listener), peer: peer.cloned(), write }
}

impl Record {
    fn size(&self) -> usize {
        OVERHEAD
            + match &self.write {
                Written::Modbus { pdu, .. } => pdu.len(),
                Written::Packet { payload, .. } => payload.len(),
            }
    }
}

impl Records {
    /// Takes up to `most` records. Waits up to `timeout` for the first, and not for the others.
    pub(crate) fn take(&self, timeout: Duration, most: usize) -> Vec<Record> {
        let receiver = self.receiver.lock().unwrap_or_else(PoisonError::into_inner);
        let first = receiver.recv_timeout(timeout).ok();
        let records: Vec<Record> =
            first.into_iter().chain(receiver.try_iter()).take(most).collect();
        let size = records.iter().map(Record::size).sum();
        self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
        records
    }

    /// The number of dropped records.
    pub(crate) fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn whoever_waits_for_writes_waits_even_if_there_are_no_listeners() {
        let (auditor, records) = auditing();
        drop(auditor);
        let (began, timeout) = (Instant::now(), Duration::from_millis(20));
        assert_eq!(records.take(timeout, 10), []);
        assert!(began.elapsed() >= timeout);
    }
}
