//! Events of connections, for a log. Sending never blocks: when the queue is full, events are
//! dropped and counted.

use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use holdfast_protocol::raw_ingest::Refusal;

use super::peer::Peer;
use super::rates::Excess;
use super::refused_request::RefusedRequest;

/// The most events in the queue.
const CAPACITY: usize = 1024;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Opened,
    /// The TLS handshake is complete: the peer has a certificate.
    Secured,
    /// The peer closed the connection, or the connection broke.
    Closed,
    /// Closed after `idle_timeout`.
    Idle,
    /// A request did not arrive within `request_timeout`.
    RequestTimeout,
    /// The peer did not read its replies.
    SlowReader,
    /// A frame had an invalid length, or began like a Raw Ingest packet.
    BrokenFrame,
    /// Closed in favour of a new connection.
    Evicted,
    /// Closed during the handshake in favour of a new connection.
    EvictedHandshake,
    /// Ended by a reload: no rule names the peer any more.
    RightsRevoked,
    /// Ended by an operator.
    Ended,
    RefusedSource,
    /// No rule names the role of the peer.
    RefusedRole,
    RefusedFull,
    /// A source sent more requests or writes per second than it may.
    RateLimited(Excess),
    /// A peer asked for listen only mode, which the listener does not allow.
    RefusedListenOnly,
    /// A request was refused because of rights, or because a memory is sealed.
    RefusedRequest(RefusedRequest),
    /// TLS failed, usually in the handshake. The reason is a word for programs.
    TlsFailed(&'static str),
    AcceptError,
    /// A Raw Ingest packet was not written.
    PacketRefused(Refusal),
    /// This many bytes behind an accepted Raw Ingest packet were dropped.
    BytesDropped(u64),
    /// A serial device was lost. The listener tries to open it again.
    LineLost,
    /// A lost serial device was opened again.
    LineBack,
}

impl Kind {
    /// Whether this event belongs to the normal life of a connection.
    const fn is_ordinary(self) -> bool {
        matches!(self, Kind::Opened | Kind::Closed | Kind::Idle | Kind::Ended)
    }

    pub const fn name(self) -> &'static str {
        match self {
            Kind::Opened => "opened",
            Kind::Secured => "secured",
            Kind::Closed => "closed",
            Kind::Idle => "idle",
            Kind::RequestTimeout => "request_timeout",
            Kind::SlowReader => "slow_reader",
            Kind::BrokenFrame => "broken_frame",
            Kind::Evicted | Kind::EvictedHandshake => "evicted",
            Kind::RightsRevoked => "rights_revoked",
            Kind::Ended => "ended",
            Kind::RefusedSource => "refused_source",
            Kind::RefusedRole => "refused_role",
            Kind::RefusedFull => "refused_full",
            Kind::RateLimited(_) => "rate_limited",
            Kind::RefusedListenOnly => "refused_listen_only",
            Kind::RefusedRequest(refused) => refused.why.name(),
            Kind::TlsFailed(_) => "tls_failed",
            Kind::AcceptError => "accept_error",
            Kind::PacketRefused(_) => "packet_refused",
            Kind::BytesDropped(_) => "bytes_dropped",
            Kind::LineLost => "line_lost",
            Kind::LineBack => "line_back",
        }
    }

    /// The reason, if the name does not include it.
    pub const fn reason(self) -> Option<&'static str> {
        match self {
            Kind::PacketRefused(refusal) => Some(refusal.name()),
            Kind::TlsFailed(reason) => Some(reason),
            Kind::RateLimited(excess) => Some(excess.name()),
            Kind::EvictedHandshake => Some("handshake"),
            _ => None,
        }
    }

    /// The number of bytes that the event is about.
    pub const fn bytes(self) -> Option<u64> {
        match self {
            Kind::BytesDropped(count) => Some(count),
            _ => None,
        }
    }
}

/// An event of a listener.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    pub listener: Arc<str>,
    pub kind: Kind,
    pub peer: Option<Peer>,
    /// The subject of the certificate of a peer whose handshake failed, cut to 256 characters.
    pub subject: Option<Box<str>>,
}

/// Which events are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verbosity {
    Nothing,
    /// Only refusals and faults.
    Refusals,
    /// Also the events of every connection.
    All,
}

/// The sending side.
#[derive(Debug, Clone)]
pub(crate) struct Reporter {
    verbosity: Arc<AtomicU8>,
    sender: SyncSender<Event>,
    lost: Arc<AtomicU64>,
}

/// The receiving side.
#[derive(Debug)]
pub(crate) struct Events {
    receiver: Mutex<Receiver<Event>>,
    /// Without listeners, nobody else can send: whoever waits must still wait.
    _sender: SyncSender<Event>,
    lost: Arc<AtomicU64>,
}

pub(crate) fn channel(verbosity: Verbosity) -> (Reporter, Events) {
    let (sender, receiver) = sync_channel(CAPACITY);
    let lost = Arc::new(AtomicU64::new(0));
    let events =
        Events { receiver: Mutex::new(receiver), _sender: sender.clone(), lost: Arc::clone(&lost) };
    let verbosity = Arc::new(AtomicU8::new(verbosity as u8));
    (Reporter { verbosity, sender, lost }, events)
}

impl Reporter {
    pub(crate) fn set_verbosity(&self, verbosity: Verbosity) {
        self.verbosity.store(verbosity as u8, Ordering::Relaxed);
    }

    pub(crate) fn report(
        &self,
        listener: &Arc<str>,
        kind: Kind,
        peer: Option<Peer>,
        subject: Option<&str>,
    ) {
        let verbosity = self.verbosity.load(Ordering::Relaxed);
        let least = if kind.is_ordinary() { Verbosity::All } else { Verbosity::Refusals };
        if verbosity < least as u8 {
            return;
        }
        let subject = subject.map(Box::from);
        let event = Event { listener: Arc::clone(listener), kind, peer, subject };
        if self.sender.try_send(event).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Events {
    /// The next event; `None` when none arrives within `timeout`.
    pub(crate) fn next(&self, timeout: Duration) -> Option<Event> {
        self.receiver.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(timeout).ok()
    }

    /// The number of dropped events.
    pub(crate) fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn whoever_waits_for_events_waits_even_if_there_are_no_listeners() {
        let (reporter, events) = channel(Verbosity::All);
        drop(reporter);
        let (began, timeout) = (Instant::now(), Duration::from_millis(20));
        assert_eq!(events.next(timeout), None);
        assert!(began.elapsed() >= timeout);
    }
}
