//! Events of connections, for a log. Sending never waits: when the queue is full, events are dropped and
//! counted.
//!
//! A source that causes many events must not displace those of others. If many of its events wait,
//! further refusals that equal one of them, but for the port of the peer, are only counted there, and
//! other events have half of the queue.

use std::collections::{HashMap, VecDeque};
use std::io;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use holdfast_protocol::raw_ingest::Refusal;
use holdfast_runtime::lock;

use crate::server::connections::peer::Peer;
use crate::server::reports::refused_request::RefusedRequest;

/// The most events in the queue.
const MAX_EVENTS: usize = 1024;

/// How many events of one source wait one by one, whatever it sends.
const MAX_EVENTS_OF_SOURCE: usize = 32;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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
    /// What a peer sent is not HTTP.
    BrokenRequest,
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
    /// A peer asked for listen only mode, which the listener does not allow.
    RefusedListenOnly,
    /// A peer has set this unit to listen only mode.
    UnitSilenced(u8),
    /// A peer or a reload has ended the listen only mode of this unit.
    UnitBack(u8),
    /// A request was refused because of rights, or because a memory is sealed.
    RefusedRequest(RefusedRequest),
    /// TLS failed, usually in the handshake. The reason is a word for programs.
    TlsFailed(&'static str),
    /// The number is that of the error of the system.
    AcceptError(Option<i32>),
    /// A Raw Ingest packet was not written.
    PacketRefused(Refusal),
    /// This many bytes followed the only Raw Ingest packet of a connection, which was written.
    SurplusBytes(u64),
    /// This many bytes of a Raw Ingest packet behind others were dropped: its end is missing.
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

    /// Whether repetitions by a noisy source may be counted instead of sent.
    const fn is_refusal(self) -> bool {
        let is_change = matches!(
            self,
            Kind::RightsRevoked
                | Kind::LineLost
                | Kind::LineBack
                | Kind::UnitSilenced(_)
                | Kind::UnitBack(_)
        );
        !self.is_ordinary() && !is_change && !matches!(self, Kind::Secured)
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
            Kind::BrokenRequest => "broken_request",
            Kind::Evicted | Kind::EvictedHandshake => "evicted",
            Kind::RightsRevoked => "rights_revoked",
            Kind::Ended => "ended",
            Kind::RefusedSource => "refused_source",
            Kind::RefusedRole => "refused_role",
            Kind::RefusedFull => "refused_full",
            Kind::RefusedListenOnly => "refused_listen_only",
            Kind::UnitSilenced(_) => "unit_silenced",
            Kind::UnitBack(_) => "unit_back",
            Kind::RefusedRequest(refused) => refused.why.name(),
            Kind::TlsFailed(_) => "tls_failed",
            Kind::AcceptError(_) => "accept_error",
            Kind::PacketRefused(_) => "packet_refused",
            Kind::SurplusBytes(_) => "surplus_bytes",
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
            Kind::EvictedHandshake => Some("handshake"),
            _ => None,
        }
    }

    /// The error of the system, for people.
    pub fn error(self) -> Option<String> {
        match self {
            Kind::AcceptError(code) => Some(io::Error::from_raw_os_error(code?).to_string()),
            _ => None,
        }
    }

    /// The number of bytes that the event is about.
    pub const fn bytes(self) -> Option<u64> {
        match self {
            Kind::SurplusBytes(count) | Kind::BytesDropped(count) => Some(count),
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
    /// How often it occurred before it was taken from the queue, with any port of the peer.
    pub count: u64,
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
    shared: Arc<Shared>,
}

/// The receiving side.
#[derive(Debug)]
pub(crate) struct Events {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    queue: Mutex<Queue>,
    arrived: Condvar,
    lost: AtomicU64,
}

/// The events that wait. All maps are about these alone, so they are bounded with them.
#[derive(Debug, Default)]
struct Queue {
    events: VecDeque<Event>,
    /// The number of events that were taken.
    taken: usize,
    /// The place of the last of equal refusals, counted from the first event ever.
    refusals: HashMap<Repeated, usize>,
    /// How many events each source has.
    of_source: HashMap<IpAddr, usize>,
}

/// What repetitions of a refusal have in common.
#[derive(Debug, PartialEq, Eq, Hash)]
struct Repeated {
    listener: Arc<str>,
    kind: Kind,
    source: Option<IpAddr>,
    subject: Option<Box<str>>,
}

impl Repeated {
    fn of(event: &Event) -> Option<Repeated> {
        let certificate = event.peer.as_ref().and_then(|peer| peer.certificate.as_ref());
        let subject = event.subject.as_deref().or(certificate.map(|own| own.subject.as_str()));
        event.kind.is_refusal().then(|| Repeated {
            listener: Arc::clone(&event.listener),
            kind: event.kind,
            source: event.source(),
            subject: subject.map(Box::from),
        })
    }
}

impl Event {
    /// Where it comes from: an address, or the network /64 of an IPv6 address, because a host can
    /// use any address of it.
    fn source(&self) -> Option<IpAddr> {
        Some(match self.peer.as_ref()?.ip() {
            IpAddr::V6(whole) => {
                IpAddr::V6(Ipv6Addr::from_bits(whole.to_bits() & (u128::MAX << 64)))
            }
            four => four,
        })
    }
}

impl Queue {
    /// Returns whether there was room.
    fn put(&mut self, event: Event) -> bool {
        let source = event.source();
        let of_source =
            source.map_or(0, |source| self.of_source.get(&source).copied().unwrap_or(0));
        let repeated = Repeated::of(&event);
        if of_source >= MAX_EVENTS_OF_SOURCE || self.events.len() >= MAX_EVENTS {
            if let Some(place) = repeated.as_ref().and_then(|each| self.refusals.get(each)) {
                self.events[place - self.taken].count += 1;
                return true;
            }
            if self.events.len() >= if source.is_some() { MAX_EVENTS / 2 } else { MAX_EVENTS } {
                return false;
            }
        }
        if let Some(source) = source {
            self.of_source.insert(source, of_source + 1);
        }
        if let Some(repeated) = repeated {
            self.refusals.insert(repeated, self.taken + self.events.len());
        }
        self.events.push_back(event);
        true
    }

    fn take(&mut self) -> Option<Event> {
        let event = self.events.pop_front()?;
        if let Some(repeated) = Repeated::of(&event)
            && self.refusals.get(&repeated) == Some(&self.taken)
        {
            self.refusals.remove(&repeated);
        }
        self.taken += 1;
        if let Some(source) = event.source() {
            match self.of_source.get_mut(&source) {
                Some(count @ 2..) => *count -= 1,
                _ => _ = self.of_source.remove(&source),
            }
        }
        debug_assert!(!self.events.is_empty() || self.refusals.is_empty());
        debug_assert!(!self.events.is_empty() || self.of_source.is_empty());
        Some(event)
    }
}

pub(crate) fn channel(verbosity: Verbosity) -> (Reporter, Events) {
    let shared = Arc::new(Shared::default());
    let events = Events { shared: Arc::clone(&shared) };
    (Reporter { verbosity: Arc::new(AtomicU8::new(verbosity as u8)), shared }, events)
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
        let event = Event { listener: Arc::clone(listener), kind, peer, subject, count: 1 };
        if lock(&self.shared.queue).put(event) {
            self.shared.arrived.notify_one();
        } else {
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Events {
    /// The next event; `None` when none arrives within `timeout`.
    pub(crate) fn next(&self, timeout: Duration) -> Option<Event> {
        let empty = |queue: &mut Queue| queue.events.is_empty();
        let waited =
            self.shared.arrived.wait_timeout_while(lock(&self.shared.queue), timeout, empty);
        waited.unwrap_or_else(PoisonError::into_inner).0.take()
    }

    /// The number of dropped events.
    pub(crate) fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;
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

    #[cfg(unix)]
    #[test]
    fn a_connection_that_is_not_accepted_has_the_error_of_the_system() {
        let error = Kind::AcceptError(Some(24)).error();
        assert_eq!(error.unwrap(), "Too many open files (os error 24)");
        assert_eq!(Kind::Closed.error(), None);
    }

    /// The `port`-th connection of a source, refused.
    fn refuse(reporter: &Reporter, source: &str, port: u16, kind: Kind) {
        let peer = Peer::from(SocketAddr::new(source.parse().unwrap(), port));
        reporter.report(&"scada".into(), kind, Some(peer), None);
    }

    fn taken(events: &Events) -> Vec<(String, u64)> {
        let all = std::iter::from_fn(|| events.next(Duration::ZERO));
        all.map(|event| (event.peer.unwrap().ip().to_string(), event.count)).collect()
    }

    #[test]
    fn a_flood_of_one_source_does_not_displace_the_events_of_others() {
        let (reporter, events) = channel(Verbosity::Refusals);
        // It begins anew when the events were taken.
        for _ in 0..2 {
            for port in 0..u16::MAX {
                refuse(&reporter, "10.0.0.9", port, Kind::RefusedSource);
            }
            refuse(&reporter, "10.0.0.7", 1, Kind::RefusedSource);
            let mut found = taken(&events);
            assert_eq!(found.pop(), Some(("10.0.0.7".into(), 1)));
            assert_eq!(found.len(), MAX_EVENTS_OF_SOURCE);
            let counts: u64 = found.iter().map(|(_, count)| count).sum();
            assert_eq!((counts, events.lost()), (u64::from(u16::MAX), 0));
        }
    }

    #[test]
    fn a_source_has_half_of_the_queue() {
        let (reporter, events) = channel(Verbosity::All);
        for _ in 0..MAX_EVENTS {
            refuse(&reporter, "10.0.0.9", 1, Kind::Opened);
        }
        refuse(&reporter, "10.0.0.7", 1, Kind::RefusedSource);
        let found = taken(&events);
        assert_eq!(found.len(), MAX_EVENTS / 2 + 1);
        assert_eq!(found[MAX_EVENTS / 2], ("10.0.0.7".into(), 1));
        assert_eq!(events.lost(), (MAX_EVENTS / 2) as u64);
    }

    #[test]
    fn a_network_of_ipv6_is_one_source() {
        let (reporter, events) = channel(Verbosity::Refusals);
        for host in 0..u16::MAX {
            let kind = Kind::RefusedSource;
            refuse(&reporter, &format!("2001:db8::{host:x}"), 1, kind);
        }
        refuse(&reporter, "2001:db8:0:1::1", 1, Kind::RefusedSource);
        assert_eq!((taken(&events).len(), events.lost()), (MAX_EVENTS_OF_SOURCE + 1, 0));
    }

    #[test]
    fn other_events_and_subjects_of_a_noisy_source_are_not_counted_together() {
        let (reporter, events) = channel(Verbosity::Refusals);
        for port in 0..u16::MAX {
            refuse(&reporter, "10.0.0.9", port, Kind::RefusedSource);
        }
        let peer = || Some(Peer::from(SocketAddr::from(([10, 0, 0, 9], 1))));
        for listener in ["scada", "raw"] {
            for reason in ["expired", "revoked"] {
                for subject in [None, Some("CN=a"), Some("CN=b")] {
                    for _ in 0..2 {
                        reporter.report(&listener.into(), Kind::TlsFailed(reason), peer(), subject);
                    }
                }
            }
        }
        let all: Vec<Event> = std::iter::from_fn(|| events.next(Duration::ZERO)).collect();
        let counts: Vec<u64> =
            all[MAX_EVENTS_OF_SOURCE..].iter().map(|event| event.count).collect();
        assert_eq!(counts, [2; 12]);
    }

    #[test]
    fn changes_of_a_unit_keep_their_order() {
        let (reporter, events) = channel(Verbosity::Refusals);
        let changes: Vec<Kind> =
            std::iter::repeat_n([Kind::UnitSilenced(5), Kind::UnitBack(5)], 40)
                .flatten()
                .chain([Kind::UnitSilenced(5)])
                .collect();
        for kind in &changes {
            refuse(&reporter, "10.0.0.9", 1, *kind);
        }
        let found = std::iter::from_fn(|| events.next(Duration::ZERO));
        assert_eq!(found.map(|event| event.kind).collect::<Vec<_>>(), changes);
    }

    #[test]
    fn events_of_more_sources_than_the_queue_has_room_for_are_lost_and_counted() {
        let (reporter, events) = channel(Verbosity::Refusals);
        for number in 0..2 * MAX_EVENTS {
            let source = format!("10.0.{}.{}", number / 256, number % 256);
            refuse(&reporter, &source, 1, Kind::RefusedSource);
        }
        assert_eq!((taken(&events).len(), events.lost()), (MAX_EVENTS, MAX_EVENTS as u64));
    }
}
