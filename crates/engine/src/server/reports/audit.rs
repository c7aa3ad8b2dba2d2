//! Writes, for an audit log. Sending never blocks. When the queue is full, records are dropped and
//! counted, or the writes are refused: then each write takes room for its record before it is carried
//! out.
//!
//! Refused writes take no room from the others: whoever may not write can send any number of them. Few
//! of them wait, and the others are only counted.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_memory::Memory;
use holdfast_protocol::raw_ingest;
use holdfast_runtime::lock;

use crate::link::exception_in;
use crate::server::connections::peer::Peer;
use crate::server::rights::functions::{is_write, only_reads};

/// The most bytes in the queue.
const MAX_QUEUE_BYTES: usize = 32 << 20;

/// Bytes of a record without its data.
const RECORD_OVERHEAD_BYTES: usize = 128;

/// The most refused writes that wait, each with its request.
const MAX_REFUSED: usize = 128;

/// As many more may wait if none of these is similar. Each stands for all that are similar to it.
const MAX_SIMILAR: usize = 128;

/// What happens to a write that can't be recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unrecordable {
    /// It is carried out. Its record is missing.
    Write,
    /// It is refused.
    Refuse,
}

/// A write that was carried out or refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    pub listener: Arc<str>,
    /// `None` on a serial line.
    pub peer: Option<Peer>,
    pub write: Written,
    /// Where the log of a memory has the write.
    pub log_sequence: Option<u64>,
    /// The number of similar refused writes that this one stands for, itself included. 0 if the write
    /// may have been carried out: then it has a line of its own.
    pub refusals: u64,
}

/// A request that was answered elsewhere, and its reply. `memory` is the name of the memory that it writes,
/// `route` that of the device that it was passed on to.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Forwarded<'a> {
    pub(crate) memory: Option<&'a Arc<str>>,
    pub(crate) route: Option<&'a Arc<str>>,
    pub(crate) request: &'a [u8],
    pub(crate) reply: &'a [u8],
    pub(crate) log_sequence: Option<u64>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Written {
    /// A request, unchanged, and the code of the exception that it was refused with. `memory` is the
    /// name of that of the unit, `route` that of what it was passed on to.
    Modbus {
        unit_id: u8,
        memory: Option<Arc<str>>,
        pdu: Vec<u8>,
        refused: Option<u8>,
        route: Option<Arc<str>>,
    },
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
    sender: Sender<Option<Record>>,
    shared: Arc<Shared>,
    unrecordable: Unrecordable,
}

/// Permission to carry out a request.
#[derive(Debug, Default)]
pub(crate) struct Permit {
    room: Option<Room>,
}

/// Room in the queue for one record, until this is dropped.
#[derive(Debug)]
struct Room {
    shared: Arc<Shared>,
    size: usize,
}

/// The receiving side.
#[derive(Debug)]
pub(crate) struct Records {
    /// `None` wakes the reader of the queue. Refused writes are in its place.
    receiver: Mutex<Receiver<Option<Record>>>,
    /// Keeps the channel open without listeners: the reader of the queue must still wait then.
    sender: Sender<Option<Record>>,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    /// The size of the records in the queue, and of the room that is taken.
    waiting: AtomicUsize,
    lost: AtomicU64,
    /// Refused writes, until they are taken.
    refused: Mutex<Vec<Record>>,
    /// The refused writes that are neither in records nor counted in them.
    other_refused: AtomicU64,
    /// Whether the log can't be written at present.
    failing: AtomicBool,
}

pub(crate) fn auditing(unrecordable: Unrecordable) -> (Auditor, Records) {
    let (sender, receiver) = channel();
    let shared = Arc::new(Shared::default());
    let records = Records {
        receiver: Mutex::new(receiver),
        sender: sender.clone(),
        shared: Arc::clone(&shared),
    };
    (Auditor { sender, shared, unrecordable }, records)
}

impl Auditor {
    /// Permits what has these bytes. `None` if it writes and can't be recorded, although it must.
    pub(crate) fn permit(&self, writes: bool, bytes: &[u8]) -> Option<Permit> {
        match self.unrecordable {
            Unrecordable::Refuse if writes => self.take_room(bytes.len()),
            _ => Some(Permit::default()),
        }
    }

    fn take_room(&self, len: usize) -> Option<Permit> {
        if self.shared.failing.load(Ordering::Relaxed) {
            return None;
        }
        let room = Room { shared: Arc::clone(&self.shared), size: RECORD_OVERHEAD_BYTES + len };
        let waiting = self.shared.waiting.fetch_add(room.size, Ordering::Relaxed);
        (waiting <= MAX_QUEUE_BYTES).then_some(Permit { room: Some(room) })
    }

    /// Records a Modbus request to a memory if it writes. `reply` is its reply; empty when there is none.
    /// A request without a permit was not carried out.
    pub(crate) fn note(
        &self,
        listener: &Arc<str>,
        peer: Option<&Peer>,
        (unit_id, memory): (u8, Option<&Memory>),
        (request, reply): (&[u8], &[u8]),
        permit: Option<Permit>,
    ) {
        if is_write(request) {
            let memory = memory.and_then(Memory::name);
            let answered = Forwarded { memory, route: None, request, reply, log_sequence: None };
            let record = || record(listener, peer, unit_id, answered);
            match permit {
                Some(permit) if exception_in(reply).is_none() => self.send(record(), permit),
                // The unit ignores it in listen only mode.
                None if reply.is_empty() => {}
                _ => self.refuse(record()),
            }
        }
    }

    /// Records a request to a device or a journal, unless it is known to only read. Its reply is what
    /// was answered there, or in its place. Without a permit, it was not sent; otherwise it may have been
    /// carried out, whatever the reply.
    pub(crate) fn note_forwarded(
        &self,
        listener: &Arc<str>,
        peer: Option<&Peer>,
        unit_id: u8,
        forwarded: Forwarded<'_>,
        permit: Option<Permit>,
    ) {
        if !only_reads(forwarded.request) {
            let record = record(listener, peer, unit_id, forwarded);
            match permit {
                Some(permit) => self.send(record, permit),
                None => self.refuse(record),
            }
        }
    }

    /// Queues the record of a write that was not carried out, or counts it. It takes no room from others.
    pub(crate) fn refuse(&self, record: Record) {
        let mut refused = lock(&self.shared.refused);
        if refused.len() >= MAX_REFUSED {
            if let Some(similar) = refused.iter_mut().rev().find(|other| other.is_similar(&record))
            {
                similar.refusals += 1;
                return;
            }
            if refused.len() >= MAX_REFUSED + MAX_SIMILAR {
                self.shared.other_refused.fetch_add(1, Ordering::Relaxed);
                return;
            }
        }
        refused.push(Record { refusals: 1, ..record });
        if refused.len() == 1 {
            // An error means that the engine has stopped.
            let _ = self.sender.send(None);
        }
    }

    /// Queues a record, in the room that the permit has taken, if it has.
    pub(crate) fn send(&self, record: Record, permit: Permit) {
        let size = record.size();
        if let Some(mut room) = permit.room {
            debug_assert_eq!(room.size, size);
            // The room belongs to the record now, until the record is taken.
            room.size = 0;
        } else if self.shared.waiting.fetch_add(size, Ordering::Relaxed) > MAX_QUEUE_BYTES {
            self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
            return;
        }
        if self.sender.send(Some(record)).is_err() {
            self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.shared.waiting.fetch_sub(self.size, Ordering::Relaxed);
    }
}

fn record(
    listener: &Arc<str>,
    peer: Option<&Peer>,
    unit_id: u8,
    forwarded: Forwarded<'_>,
) -> Record {
    let Forwarded { memory, route, request, reply, log_sequence } = forwarded;
    let write = Written::Modbus {
        unit_id,
        memory: memory.cloned(),
        pdu: request.to_vec(),
        refused: exception_in(reply),
        route: route.cloned(),
    };
    Record { listener: Arc::clone(listener), peer: peer.cloned(), write, log_sequence, refusals: 0 }
}

impl Record {
    fn size(&self) -> usize {
        RECORD_OVERHEAD_BYTES
            + match &self.write {
                Written::Modbus { pdu, .. } => pdu.len(),
                Written::Packet { payload, .. } => payload.len(),
            }
    }

    /// Whether a refused write is of the same peer, and was refused for the same reason.
    fn is_similar(&self, other: &Record) -> bool {
        let is_same_reason = match (&self.write, &other.write) {
            (Written::Modbus { refused, .. }, Written::Modbus { refused: other, .. }) => {
                refused == other
            }
            (Written::Packet { refused, .. }, Written::Packet { refused: other, .. }) => {
                refused == other
            }
            _ => false,
        };
        let [peer, other_peer] =
            [self, other].map(|each| each.peer.as_ref().map(|peer| (peer.ip(), &peer.certificate)));
        is_same_reason && self.listener == other.listener && peer == other_peer
    }
}

impl Records {
    /// Takes about `most` records. Waits up to `timeout` for the first, and not for the others.
    pub(crate) fn take(&self, timeout: Duration, most: usize) -> Vec<Record> {
        let receiver = lock(&self.receiver);
        let first = receiver.recv_timeout(timeout).ok();
        let (mut records, mut size) = (Vec::new(), 0);
        for record in first.into_iter().chain(receiver.try_iter()) {
            match record {
                Some(record) => {
                    size += record.size();
                    records.push(record);
                }
                None => records.append(&mut lock(&self.shared.refused)),
            }
            if records.len() >= most {
                break;
            }
        }
        self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
        records
    }

    /// Wakes the reader of the queue.
    pub(crate) fn wake(&self) {
        let _ = self.sender.send(None);
    }

    /// Whether the log can't be written, so that writes which must be recorded are refused. Wakes
    /// the reader of the queue: it has to try again.
    pub(crate) fn set_failing(&self, failing: bool) {
        self.shared.failing.store(failing, Ordering::Relaxed);
        self.wake();
    }

    /// The number of dropped records.
    pub(crate) fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }

    /// The number of refused writes that are neither in records nor counted in them.
    pub(crate) fn other_refused(&self) -> u64 {
        self.shared.other_refused.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv4Addr, SocketAddr};
    use std::time::Instant;

    use super::*;

    const WRITE: &[u8] = &[6, 0, 1, 0, 7];
    const READ: &[u8] = &[3, 0, 1, 0, 1];

    fn send(auditor: &Auditor, permit: Permit) {
        auditor.note(&"scada".into(), None, (1, None), (WRITE, WRITE), Some(permit));
    }

    /// Notes a write that was refused with this exception.
    fn refuse(auditor: &Auditor, peer: IpAddr, exception: u8) {
        let peer = SocketAddr::new(peer, 50_000).into();
        auditor.note(&"scada".into(), Some(&peer), (1, None), (WRITE, &[0x86, exception]), None);
    }

    #[test]
    fn a_write_that_must_be_recorded_takes_room_before_it_is_carried_out() {
        let (auditor, records) = auditing(Unrecordable::Refuse);
        let most = MAX_QUEUE_BYTES / (RECORD_OVERHEAD_BYTES + WRITE.len()) + 1;
        let permits: Vec<Permit> = (0..most).map_while(|_| auditor.permit(true, WRITE)).collect();
        assert_eq!(permits.len(), most);
        assert!(auditor.permit(true, WRITE).is_none());
        assert!(auditor.permit(true, &[0, 1]).is_none());
        assert!(auditor.permit(false, READ).is_some());
        for permit in permits {
            send(&auditor, permit);
        }
        assert_eq!((records.take(Duration::ZERO, usize::MAX).len(), records.lost()), (most, 0));
        assert!(auditor.permit(true, WRITE).is_some());
    }

    #[test]
    fn room_that_is_not_used_is_released() {
        let (auditor, records) = auditing(Unrecordable::Refuse);
        let taken = |_| auditor.permit(true, WRITE).is_some();
        assert!((0..2 * MAX_QUEUE_BYTES / RECORD_OVERHEAD_BYTES).all(taken));
        assert_eq!(records.shared.waiting.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn without_room_that_was_taken_records_are_dropped_and_counted() {
        for unrecordable in [Unrecordable::Write, Unrecordable::Refuse] {
            let (auditor, records) = auditing(unrecordable);
            let most = MAX_QUEUE_BYTES / (RECORD_OVERHEAD_BYTES + WRITE.len()) + 1;
            for _ in 0..most + 5 {
                send(&auditor, Permit::default());
            }
            assert_eq!(records.lost(), 5);
            assert_eq!(auditor.permit(true, WRITE).is_some(), unrecordable == Unrecordable::Write);
            assert_eq!(records.take(Duration::ZERO, usize::MAX).len(), most);
            assert!(auditor.permit(true, WRITE).is_some());
        }
    }

    #[test]
    fn refused_writes_take_no_room_and_are_counted() {
        let (auditor, records) = auditing(Unrecordable::Refuse);
        let most = MAX_QUEUE_BYTES / RECORD_OVERHEAD_BYTES;
        let [noisy, quiet] = [7, 8].map(|last| IpAddr::from([127, 0, 0, last]));
        for _ in 0..most {
            refuse(&auditor, noisy, 1);
        }
        refuse(&auditor, quiet, 1);
        refuse(&auditor, noisy, 2);
        assert_eq!(records.shared.waiting.load(Ordering::Relaxed), 0);
        send(&auditor, auditor.permit(true, WRITE).unwrap());
        let taken = records.take(Duration::ZERO, usize::MAX);
        assert_eq!((records.lost(), records.other_refused()), (0, 0));
        let (last, refused) = taken.split_last().unwrap();
        assert_eq!((last.refusals, refused.len()), (0, MAX_REFUSED + 2));
        assert_eq!(refused[MAX_REFUSED - 1].refusals, (most - MAX_REFUSED + 1) as u64);
        assert!(refused[MAX_REFUSED..].iter().all(|each| each.refusals == 1));
        refuse(&auditor, noisy, 1);
        assert_eq!(records.take(Duration::ZERO, usize::MAX).len(), 1);
    }

    #[test]
    fn refused_writes_of_too_many_peers_are_counted_together() {
        let (auditor, records) = auditing(Unrecordable::Write);
        for number in 0..1000 {
            refuse(&auditor, Ipv4Addr::from(number).into(), 1);
        }
        let most = MAX_REFUSED + MAX_SIMILAR;
        assert_eq!(records.take(Duration::ZERO, usize::MAX).len(), most);
        assert_eq!(records.other_refused(), 1000 - most as u64);
    }

    #[test]
    fn a_write_that_may_have_been_carried_out_is_not_counted_as_refused() {
        let (auditor, records) = auditing(Unrecordable::Write);
        let sent = |permit| {
            let reply = &[0x86, 0x0B];
            let (memory, route, log_sequence) = (None, None, None);
            let forwarded = Forwarded { memory, route, request: WRITE, reply, log_sequence };
            auditor.note_forwarded(&"scada".into(), None, 1, forwarded, permit);
        };
        sent(auditor.permit(true, WRITE));
        sent(None);
        // A unit in listen only mode has ignored it.
        auditor.note(&"scada".into(), None, (1, None), (WRITE, &[]), None);
        let refusals = records.take(Duration::ZERO, 10).into_iter().map(|each| each.refusals);
        assert_eq!(refusals.collect::<Vec<_>>(), [0, 1]);
    }

    #[test]
    fn while_the_log_fails_only_writes_that_must_be_recorded_are_refused() {
        for (unrecordable, refused) in [(Unrecordable::Write, false), (Unrecordable::Refuse, true)]
        {
            let (auditor, records) = auditing(unrecordable);
            for failing in [true, false] {
                records.set_failing(failing);
                assert_eq!(auditor.permit(true, WRITE).is_none(), refused && failing);
                assert!(auditor.permit(false, READ).is_some());
            }
        }
    }

    #[test]
    fn whoever_waits_for_writes_can_be_woken() {
        let (_auditor, records) = auditing(Unrecordable::Write);
        records.wake();
        assert_eq!(records.take(Duration::MAX, 10), []);
        records.set_failing(true);
        assert_eq!(records.take(Duration::MAX, 10), []);
    }

    #[test]
    fn whoever_waits_for_writes_waits_even_if_there_are_no_listeners() {
        let (auditor, records) = auditing(Unrecordable::Write);
        drop(auditor);
        let (began, timeout) = (Instant::now(), Duration::from_millis(20));
        assert_eq!(records.take(timeout, 10), []);
        assert!(began.elapsed() >= timeout);
    }
}
