//! A link as the listeners see it, from any thread.

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use holdfast_protocol::pdu::{EncodedRequest, ExceptionCode};
use tokio::sync::mpsc;

use super::coming::{Coming, ReplyTo, coming};
use super::pace::InFlight;
use super::queue::Priority;
use crate::client::Endpoint;
use crate::counter::Counter;

/// Settings of a link that listeners use.
#[derive(Debug, Clone)]
pub struct LinkSettings {
    pub name: String,
    pub endpoint: Endpoint,
    /// Requests in flight, over TCP.
    pub in_flight: InFlight,
    /// The most requests of listeners that wait or are in flight.
    pub queue: usize,
    /// Whether equal reads that wait at the same time are answered by one request.
    pub coalesce: bool,
    /// How long a reply answers equal reads; 0 for not at all.
    pub cache: Duration,
    /// Sources whose reads go before those of others.
    pub preferred: Vec<IpAddr>,
}

/// Requests of listeners since the start.
#[derive(Debug, Default)]
pub struct LinkCounters {
    /// All, however they ended.
    pub requests: Counter,
    /// Answered by the device, with exceptions too.
    pub replies: Counter,
    pub exceptions: Counter,
    /// Sent, and not answered in time.
    pub timeouts: Counter,
    /// Invalid replies and lost connections.
    pub failures: Counter,
    /// Refused because the queue was full.
    pub refused_full: Counter,
    /// Refused without a try: the address could not be reached, or the unit was silent.
    pub refused_down: Counter,
    /// Answered by the reply to an equal read.
    pub coalesced: Counter,
    /// Answered by an earlier reply.
    pub cached: Counter,
    /// Not sent, because the client had gone.
    pub withdrawn: Counter,
}

/// The sending side of a link.
#[derive(Debug)]
pub struct SharedLink {
    pub name: Arc<str>,
    pub counters: LinkCounters,
    calls: mpsc::UnboundedSender<Call>,
    max_waiting: usize,
    waiting: AtomicUsize,
    preferred: Vec<IpAddr>,
}

/// A request of a listener.
pub(crate) struct Call {
    pub(super) unit_id: u8,
    pub(super) request: EncodedRequest,
    pub(super) timeout: Duration,
    pub(super) source: u64,
    pub(super) priority: Priority,
    pub(super) reply: Reply,
}

/// Where the reply to a request goes: a PDU, empty after a broadcast. The request has left the queue
/// when this is dropped.
pub(super) struct Reply {
    to: ReplyTo,
    _place: Place,
}

/// A place in the queue of a link.
struct Place(Arc<SharedLink>);

/// Who asks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asker {
    /// A number of its own for each connection.
    pub(crate) source: u64,
    /// `None` on a serial line.
    pub(crate) peer: Option<IpAddr>,
    /// Its requests that wait for replies.
    pub(crate) waiting: usize,
}

/// Where the requests to a unit of a listener go.
#[derive(Debug, Clone)]
pub struct Route {
    /// The name of the device or of the link.
    pub name: Arc<str>,
    pub link: Arc<SharedLink>,
    /// The unit id of the device; `None` for that of the request.
    pub unit_id: Option<u8>,
    pub timeout: Duration,
}

impl SharedLink {
    pub(crate) fn new(settings: &LinkSettings, calls: mpsc::UnboundedSender<Call>) -> SharedLink {
        SharedLink {
            name: settings.name.as_str().into(),
            counters: LinkCounters::default(),
            calls,
            max_waiting: settings.queue,
            waiting: AtomicUsize::new(0),
            preferred: settings.preferred.clone(),
        }
    }

    /// Requests of listeners that wait or are in flight.
    pub fn waiting(&self) -> usize {
        self.waiting.load(Ordering::Relaxed)
    }

    fn priority(&self, request: &EncodedRequest, peer: Option<IpAddr>) -> Priority {
        let preferred = |peer: IpAddr| self.preferred.contains(&peer.to_canonical());
        match peer {
            _ if !request.is_read() => Priority::Urgent,
            Some(peer) if !self.preferred.is_empty() && preferred(peer) => Priority::Preferred,
            _ => Priority::Usual,
        }
    }
}

impl Route {
    /// Sends a request on its way, unchanged.
    ///
    /// # Errors
    /// The exception to refuse it with: the queue is full, or the link has ended. A source may fill no
    /// more of the queue than it leaves to others.
    pub(crate) fn ask(
        &self,
        asker: &Asker,
        unit_id: u8,
        pdu: &[u8],
    ) -> Result<Coming, ExceptionCode> {
        let link = &self.link;
        link.counters.requests.add();
        let request = EncodedRequest::opaque(pdu).ok_or(ExceptionCode::IllegalFunction)?;
        let before = link.waiting.fetch_add(1, Ordering::Relaxed);
        let place = Place(Arc::clone(link));
        if link.max_waiting.saturating_sub(before) <= asker.waiting {
            link.counters.refused_full.add();
            return Err(ExceptionCode::ServerDeviceBusy);
        }
        let priority = link.priority(&request, asker.peer);
        let (to, coming) = coming();
        let call = Call {
            unit_id: self.unit_id.unwrap_or(unit_id),
            request,
            timeout: self.timeout,
            source: asker.source,
            priority,
            reply: Reply { to, _place: place },
        };
        match link.calls.send(call) {
            Ok(()) => Ok(coming),
            Err(_) => Err(ExceptionCode::GatewayPathUnavailable),
        }
    }
}

impl Reply {
    pub(super) fn send(self, pdu: Vec<u8>) {
        self.to.send(pdu);
    }

    /// Whether nobody waits for the reply any more.
    pub(super) fn is_unwanted(&self) -> bool {
        self.to.is_unwanted()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.waiting.fetch_sub(1, Ordering::Relaxed);
    }
}
