//! A link as listeners and event loops see it, from any thread.

use std::future;
use std::net::IpAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use holdfast_protocol::client::Tolerance;
use holdfast_protocol::pdu::{EncodedRequest, ExceptionCode, Function};
use holdfast_runtime::{Retry, lock, suspend_aware_time};
use tokio::sync::mpsc;

use super::caller::{Caller, Waiting};
use super::fault::exception_in;
use crate::client::{self, ClientError, Endpoint, Peers, StrayCounters};
use crate::counter::counters;
use crate::link::limits::permit::Wanted;
use crate::link::limits::queue_share::{Place, QueueShare, Source};
use crate::link::scheduling::in_flight::InFlight;
use crate::link::scheduling::pending_reply::{PendingReply, ReplyTo, pending_reply};
use crate::link::scheduling::queue::Priority;
use crate::link::scheduling::write_barrier::InOrder;

/// Settings of a link that listeners or event loops use.
#[derive(Debug, Clone)]
pub struct LinkSettings {
    pub endpoint: Endpoint,
    /// Requests in flight, over TCP.
    pub in_flight: InFlight,
    pub retry: Retry,
    /// The most requests that wait or are in flight, without those of the poller.
    pub queue: usize,
    /// Whether equal reads that wait at the same time are answered by one request.
    pub coalesce: bool,
    /// How long a reply answers equal reads; 0 for not at all.
    pub cache: Duration,
    /// Sources whose reads go before those of others.
    pub preferred: Vec<IpAddr>,
}

impl LinkSettings {
    /// The most requests that wait, unless a link has another number.
    pub const QUEUE: usize = 256;
    /// The largest such number that a link can have.
    pub const MAX_QUEUE: usize = 65_535;

    /// The default settings.
    pub fn new(endpoint: Endpoint) -> LinkSettings {
        LinkSettings {
            endpoint,
            in_flight: InFlight::Fixed(1),
            retry: Retry::default(),
            queue: LinkSettings::QUEUE,
            coalesce: true,
            cache: Duration::ZERO,
            preferred: Vec::new(),
        }
    }
}

counters! {
    /// Requests since the start, without those of the poller.
    pub struct LinkCounters {
        /// All, however they ended.
        requests,
        /// Answered by the device, with exceptions too.
        replies,
        exceptions,
        /// Not answered in time, or the connection took too long.
        timeouts,
        /// No connection, a lost connection, or an invalid reply.
        failures,
        /// Refused because the queue was full.
        refused_full,
        /// Refused without a try: the address could not be reached, or the unit was silent.
        refused_down,
        /// Answered by the reply to an equal read.
        coalesced,
        /// Answered by an earlier reply.
        cached,
        /// Not sent, because the client or the device had gone, or for a standstill.
        withdrawn,
    }
}

/// The sending side of a link.
#[derive(Debug)]
pub struct SharedLink {
    pub counters: LinkCounters,
    calls: mpsc::UnboundedSender<Call>,
    queue: Arc<QueueShare>,
    /// Whether unit id 0 is the broadcast.
    has_broadcasts: bool,
    strays: OnceLock<Arc<StrayCounters>>,
    error: Mutex<Option<Arc<ClientError>>>,
    preferred: Vec<IpAddr>,
    tolerance: Tolerance,
    /// In nanoseconds; 0 for no limit.
    longest_wait: AtomicU64,
}

/// A request of a listener or of an event loop.
pub(crate) struct Call {
    pub(super) unit_id: u8,
    pub(super) request: EncodedRequest,
    /// When it came, by [`suspend_aware_time`].
    pub(super) queued: Duration,
    pub(super) source: u64,
    pub(super) priority: Priority,
    pub(super) reply: Reply,
}

/// Where the reply to a request goes: a PDU, empty after a broadcast. The request has left the queue
/// when this is dropped.
pub(super) struct Reply {
    to: Receiver,
    /// The longest time that it may take after the request was sent. Event loops wait as long as the most
    /// patient route of the link.
    pub(super) longest_wait: Duration,
    /// Where the request may be sent.
    pub(super) peers: Peers,
    /// What its connection asks for after it waits for its end.
    in_order: Option<InOrder>,
    /// Of its route; `None` for an event loop.
    withdrawal: Option<Arc<Withdrawal>>,
    _place: Place,
}

/// Who gets a reply.
pub(crate) enum Receiver {
    /// The client of a listener.
    Client(ReplyTo),
    EventLoop(Waiting),
}

/// The source of a request.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asker {
    /// A number of its own for each connection.
    pub(crate) source: u64,
    /// `None` on a serial line.
    pub(crate) peer: Option<IpAddr>,
}

/// Of the routes to one device, before and after reloads: whether it was removed or changed.
#[derive(Debug, Default)]
pub struct Withdrawal(AtomicBool);

impl Withdrawal {
    /// What still waits for its turn is not sent any more, and gets 0A.
    pub fn withdraw(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    fn is_withdrawn(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
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
    pub withdrawal: Arc<Withdrawal>,
}

impl SharedLink {
    pub(crate) fn new(settings: &LinkSettings, calls: mpsc::UnboundedSender<Call>) -> SharedLink {
        SharedLink {
            counters: LinkCounters::default(),
            calls,
            queue: QueueShare::new(settings.queue),
            has_broadcasts: matches!(settings.endpoint.place, client::Place::Serial(_)),
            strays: OnceLock::new(),
            error: Mutex::default(),
            preferred: settings.preferred.clone(),
            tolerance: settings.endpoint.tolerance,
            longest_wait: AtomicU64::new(0),
        }
    }

    /// Sets what counts the strays of its connection.
    pub(super) fn connect_counters(&self, strays: &Arc<StrayCounters>) {
        let _ = self.strays.set(Arc::clone(strays));
    }

    /// What its connection has received without a request, or late; `None` until the link is served.
    pub fn strays(&self) -> Option<&StrayCounters> {
        self.strays.get().map(|strays| &**strays)
    }

    /// Why requests of clients fail: the address can't be reached, or several in a row had no answer, for a
    /// while. `None` while something behind the link answers them. Polls do not count.
    pub fn error(&self) -> Option<Arc<ClientError>> {
        lock(&self.error).clone()
    }

    pub(super) fn set_error(&self, error: Option<&Arc<ClientError>>) {
        *lock(&self.error) = error.cloned();
    }

    /// Requests that wait or are in flight, without those of the poller.
    pub fn waiting(&self) -> usize {
        self.queue.waiting()
    }

    /// Sets how long an event loop may keep the line waiting for one reply: no longer than clients of its
    /// routes, who wait for it meanwhile. `None`: it has no routes.
    pub fn set_longest_wait(&self, wait: Option<Duration>) {
        let nanos = wait.map_or(0, |wait| u64::try_from(wait.as_nanos()).unwrap_or(u64::MAX));
        self.longest_wait.store(nanos, Ordering::Relaxed);
    }

    fn longest_wait(&self) -> Duration {
        match self.longest_wait.load(Ordering::Relaxed) {
            0 => Duration::MAX,
            nanos => Duration::from_nanos(nanos),
        }
    }

    /// Sends a request of an event loop on its way. `timeout` includes the wait for the turn. A
    /// broadcast ends without a reply. If the connection leads to none of the `peers`, it ends as
    /// [`ClientError::Elsewhere`]. Returns the ticket of the call; `None` when the queue is full.
    pub fn call(
        &self,
        caller: &Arc<Caller>,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        is_broadcast: bool,
        peers: Peers,
    ) -> Option<u64> {
        self.counters.requests.add();
        let place = self.admitted(self.queue.place(Source::EventLoops))?;
        // Its reply is parsed as one to the request that is sent.
        let adapted = self.tolerance.adapted(request);
        let request = adapted.as_ref().unwrap_or(request);
        let priority = Priority::of(request, None, &self.preferred);
        let (ticket, waiting) = caller.begin(request, timeout, is_broadcast);
        let longest_wait = self.longest_wait();
        let to = Receiver::EventLoop(waiting.at_most(longest_wait));
        let (request, queued, source) = (request.clone(), suspend_aware_time(), caller.source);
        let reply =
            Reply { to, longest_wait, peers, in_order: None, withdrawal: None, _place: place };
        // If the link has ended, the call ends as lost.
        let _ = self.calls.send(Call { unit_id, request, queued, source, priority, reply });
        Some(ticket)
    }

    /// Notes whether a request has a place in the queue.
    fn admitted(&self, place: Option<Place>) -> Option<Place> {
        if place.is_none() {
            self.counters.refused_full.add();
        }
        place
    }
}

impl Route {
    /// Sends a request on its way, unchanged.
    ///
    /// # Errors
    /// The exception to refuse it with: the queue is full, or the link has ended.
    pub(crate) fn ask(
        &self,
        asker: &Asker,
        unit_id: u8,
        pdu: &[u8],
    ) -> Result<PendingReply, ExceptionCode> {
        let link = &self.link;
        link.counters.requests.add();
        let unit_id = self.unit_id.unwrap_or(unit_id);
        // No unit may answer it. The reply of one that does would be taken for the reply to the next request.
        if link.has_broadcasts
            && unit_id == 0
            && !Function::from_pdu(pdu).is_some_and(Function::can_be_broadcast)
        {
            return Err(ExceptionCode::IllegalFunction);
        }
        let request = EncodedRequest::opaque(pdu).ok_or(ExceptionCode::IllegalFunction)?;
        let place = link.admitted(link.queue.place(Source::client(asker.peer)));
        let place = place.ok_or(ExceptionCode::ServerDeviceBusy)?;
        let priority = Priority::of(&request, asker.peer, &link.preferred);
        let (to, pending) = pending_reply();
        let call = Call {
            unit_id,
            request,
            queued: suspend_aware_time(),
            source: asker.source,
            priority,
            reply: Reply {
                to: Receiver::Client(to),
                longest_wait: self.timeout,
                peers: Peers::default(),
                in_order: None,
                withdrawal: Some(Arc::clone(&self.withdrawal)),
                _place: place,
            },
        };
        match link.calls.send(call) {
            Ok(()) => Ok(pending),
            Err(_) => Err(ExceptionCode::GatewayPathUnavailable),
        }
    }
}

impl Reply {
    /// Passes a reply on, or the error of a request, which is an exception for listeners.
    pub(super) fn send(self, outcome: Result<&[u8], (&Arc<ClientError>, &[u8])>) {
        match (self.to, outcome) {
            (Receiver::EventLoop(to), Err((error, _))) => to.end(Err(Arc::clone(error))),
            (to, Ok(pdu) | Err((_, pdu))) => to.send(pdu.to_vec()),
        }
    }

    /// Its connection keeps its requests in order until this ends.
    pub(super) fn hold(&mut self, in_order: InOrder) {
        self.in_order = Some(in_order);
    }

    pub(super) fn is_unwanted(&self) -> bool {
        self.to.is_unwanted()
    }

    /// Waits until the client of a listener has disconnected.
    pub(super) fn client_gone(&self) -> impl Future<Output = ()> + use<> {
        let gone = match &self.to {
            Receiver::Client(to) => Some(to.gone()),
            Receiver::EventLoop(_) => None,
        };
        async move {
            match gone {
                Some(gone) => gone.await,
                None => future::pending().await,
            }
        }
    }

    pub(super) fn is_of_listener(&self) -> bool {
        matches!(self.to, Receiver::Client(_))
    }

    /// How long to wait for a reply to a request that is sent now.
    pub(super) fn timeout(&self) -> Duration {
        match &self.to {
            Receiver::Client(_) => self.longest_wait,
            Receiver::EventLoop(to) => to.reply_timeout(),
        }
    }

    pub(super) fn wanted(&self) -> Wanted {
        let wanted = self.to.wanted();
        match self.withdrawal.clone() {
            Some(withdrawal) => {
                Arc::new(move |moment| !withdrawal.is_withdrawn() && wanted(moment))
            }
            None => wanted,
        }
    }
}

impl Receiver {
    pub(crate) fn send(self, pdu: Vec<u8>) {
        match self {
            Receiver::Client(to) => to.send(pdu),
            Receiver::EventLoop(to) => to.end(match exception_in(&pdu) {
                Some(code) => Err(Arc::new(ClientError::Exception(code))),
                None => Ok(pdu),
            }),
        }
    }

    /// Whether the caller has given up.
    pub(crate) fn is_unwanted(&self) -> bool {
        match self {
            Receiver::Client(to) => to.is_unwanted(),
            Receiver::EventLoop(to) => to.is_unwanted(),
        }
    }

    /// What is asked at the last moment before the request is sent: it may have waited for its turn until then.
    pub(crate) fn wanted(&self) -> Wanted {
        match self {
            Receiver::Client(to) => to.wanted(),
            Receiver::EventLoop(to) => to.wanted(),
        }
    }
}
