//! The open connections of a listener or an HTTP host, and their limits. Which one is closed for a new one:
//! [`EvictionScope`].
//!
//! With TLS, a connection takes a place among the sessions only once its handshake has authenticated
//! the peer. Until then it has a place among the handshakes, and only handshakes give way to it.

use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::task::Poll;
use std::time::{Duration, Instant, SystemTime};

use holdfast_runtime::lock;
use tokio::task::AbortHandle;

use crate::server::connections::eviction::{
    Activity, CURRENT, ENDED, EvictionScope, Held, OUTDATED,
};
use crate::server::connections::peer::Peer;
use crate::tls::server::PeerCertificate;

/// What happens to a new connection when a limit is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The new connection is closed.
    Refuse,
    /// The connection that has been idle longest is closed. One that waits for a reply of Modbus, or is in the
    /// middle of a Raw Ingest packet, is closed only if all do or are.
    Evict,
}

/// The limits on open connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionLimits {
    pub max_connections: usize,
    pub max_connections_per_source: Option<usize>,
    pub when_full: WhenFull,
    /// The most connections whose handshake is not complete. They are not among
    /// `max_connections`. `None`: connections begin without a handshake.
    pub max_handshakes: Option<usize>,
    /// How long a connection in the middle of a request is never closed for another. One that had a
    /// response within this time is in use.
    pub grace: Duration,
}

impl ConnectionLimits {
    /// For a listener without connections.
    pub(in crate::server) const NONE: ConnectionLimits = ConnectionLimits {
        max_connections: 0,
        max_connections_per_source: None,
        when_full: WhenFull::Refuse,
        max_handshakes: None,
        grace: Duration::ZERO,
    };
}

/// What a connection of HTTP waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WaitingFor {
    /// The peer has not begun a request yet.
    FirstRequest,
    /// The peer has had a response, and may begin another request.
    NextRequest,
    /// The peer has begun a request, or has not taken a response.
    Rest,
    /// The peer waits. Such a connection is never closed for another.
    Handler,
}

#[derive(Debug)]
pub(crate) struct Admission {
    epoch: Instant,
    table: Mutex<Table>,
}

#[derive(Debug)]
struct Table {
    limits: ConnectionLimits,
    /// Whether the listener has ended, and admits none.
    is_closed: bool,
    next_id: u64,
    sessions: HashMap<u64, Held>,
    /// In order of age.
    handshakes: BTreeMap<u64, Held>,
    per_source: HashMap<IpAddr, Places>,
    /// When a connection that had no response may be evicted next, as [`Activity::last_request`].
    next_unserved: u64,
}

/// The places that a source has taken.
#[derive(Debug, Clone, Copy, Default)]
struct Places {
    sessions: usize,
    handshakes: usize,
}

/// An open connection.
#[derive(Debug, Clone)]
pub struct OpenConnection {
    /// Its number among the connections of its listener.
    pub id: u64,
    pub peer: Peer,
    pub opened: SystemTime,
    /// The time since the last request or late reply, or since it was opened.
    pub idle: Duration,
}

/// The limit is reached, and no connection can be evicted.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Full;

/// A connection that was closed in favour of another.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Evicted {
    Connection(Peer),
    Handshake(Peer),
    /// It had its last reply: nothing was lost.
    Answered(Peer),
}

/// The place of one connection. Dropping it frees the place.
#[derive(Debug)]
pub(crate) struct Ticket {
    id: u64,
    activity: Arc<Activity>,
    admission: Arc<Admission>,
}

impl Admission {
    pub(crate) fn new(limits: ConnectionLimits) -> Admission {
        let table = Table {
            limits,
            is_closed: false,
            next_id: 0,
            sessions: HashMap::new(),
            handshakes: BTreeMap::new(),
            per_source: HashMap::new(),
            next_unserved: 0,
        };
        Admission { epoch: Instant::now(), table: Mutex::new(table) }
    }

    /// Changes the limits. Open connections stay.
    pub(crate) fn set_limits(&self, limits: ConnectionLimits) {
        lock(&self.table).limits = limits;
    }

    /// Admits a connection from `peer`. Also returns the connection that was evicted for it.
    pub(crate) fn admit(
        self: &Arc<Self>,
        peer: SocketAddr,
    ) -> Result<(Ticket, Option<Evicted>), Full> {
        let peer = Peer::from(peer);
        let mut table = lock(&self.table);
        let max_handshakes = table.limits.max_handshakes;
        let evicted = match max_handshakes {
            None => table.clear_session(peer.ip(), self.since(Instant::now()))?,
            Some(most) => table.clear_handshake(peer.ip(), most)?,
        };
        let id = table.next_id;
        table.next_id += 1;
        let admitted = self.since(Instant::now());
        let activity =
            Arc::new(Activity { last_request: AtomicU64::new(admitted), ..Activity::default() });
        let opened = SystemTime::now();
        let held = Held { peer, opened, admitted, activity: Arc::clone(&activity), task: None };
        match max_handshakes {
            None => table.insert_session(id, held),
            Some(_) => table.insert_handshake(id, held),
        }
        Ok((Ticket { id, activity, admission: Arc::clone(self) }, evicted))
    }

    /// Ends the connections for which `ends` has a reason. Returns the reasons, and whom they concern.
    pub(crate) fn review<R>(&self, ends: impl Fn(&Peer) -> Option<R>) -> Vec<(Peer, R)> {
        self.judge(ends, |_| ())
    }

    /// The same after a reload: the others look up their rights again, before they answer the next request.
    pub(crate) fn apply_reload<R>(&self, ends: impl Fn(&Peer) -> Option<R>) -> Vec<(Peer, R)> {
        self.judge(ends, |activity| {
            activity.validity.fetch_max(OUTDATED, Ordering::Release);
        })
    }

    /// Ends connections. The others stay. Judges without the lock: that may take long, and workers need it for each
    /// connection that begins or ends.
    fn judge<R>(
        &self,
        ends: impl Fn(&Peer) -> Option<R>,
        stays: impl Fn(&Activity),
    ) -> Vec<(Peer, R)> {
        let copy = |(id, held): (&u64, &Held)| (*id, held.peer.clone(), Arc::clone(&held.activity));
        let open: Vec<_> = lock(&self.table).held().map(copy).collect();
        let judged = open.into_iter().filter_map(|(id, peer, activity)| match ends(&peer) {
            // `None` if it has ended meanwhile.
            Some(reason) => self.end(id).map(|peer| (peer, reason)),
            None => {
                stays(&activity);
                None
            }
        });
        judged.collect()
    }

    /// Ends all connections. From now on, none is admitted. Returns their peers.
    pub(crate) fn close(&self) -> Vec<Peer> {
        let mut table = lock(&self.table);
        (table.limits, table.is_closed) = (ConnectionLimits::NONE, true);
        let ids: Vec<u64> = table.held().map(|(id, _)| *id).collect();
        ids.into_iter().filter_map(|id| table.end(id)).map(|held| held.peer).collect()
    }

    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.table).is_closed
    }

    /// Ends one connection. Returns its peer, `None` if there is no such connection.
    pub(crate) fn end(&self, id: u64) -> Option<Peer> {
        lock(&self.table).end(id).map(|held| held.peer)
    }

    /// The open connections, in the order in which they were opened.
    pub(crate) fn open_connections(&self) -> Vec<OpenConnection> {
        let now = self.since(Instant::now());
        let connection = |(id, held): (&u64, &Held)| OpenConnection {
            id: *id,
            peer: held.peer.clone(),
            opened: held.opened,
            idle: Duration::from_micros(
                now.saturating_sub(held.activity.last_request.load(Ordering::Relaxed)),
            ),
        };
        let mut open: Vec<OpenConnection> = lock(&self.table).held().map(connection).collect();
        open.sort_unstable_by_key(|connection| connection.id);
        open
    }

    pub(crate) fn open(&self) -> usize {
        let table = lock(&self.table);
        table.sessions.len() + table.handshakes.len()
    }

    fn since(&self, now: Instant) -> u64 {
        now.saturating_duration_since(self.epoch).as_micros() as u64
    }
}

impl Table {
    /// Makes sure that there is a place for a session.
    fn clear_session(&mut self, source: IpAddr, now: u64) -> Result<Option<Evicted>, Full> {
        let Some(scope) = self.full_scope(source) else {
            return Ok(None);
        };
        if let Some(id) = scope.answered(&self.sessions) {
            return Ok(self.end(id).map(|held| Evicted::Answered(held.peer)));
        }
        self.evict(scope, now).map(Some)
    }

    /// The sessions that leave no place for one of `source`. `None`: there is a place.
    fn full_scope(&self, source: IpAddr) -> Option<EvictionScope> {
        if self.source_is_full(self.places(source).sessions) {
            Some(EvictionScope::Source(source))
        } else {
            (self.sessions.len() >= self.limits.max_connections).then_some(EvictionScope::All)
        }
    }

    /// Makes sure that there is a place for a handshake.
    fn clear_handshake(&mut self, source: IpAddr, most: usize) -> Result<Option<Evicted>, Full> {
        let places = self.places(source);
        if let Some(scope) = self.full_scope(source)
            && self.limits.when_full == WhenFull::Refuse
            && scope.answered(&self.sessions).is_none()
        {
            return Err(Full);
        }
        let scope = if self.source_is_full(places.handshakes) {
            EvictionScope::Source(source)
        } else if self.handshakes.len() < most {
            return Ok(None);
        } else {
            EvictionScope::All
        };
        let id = scope.first_handshake_to_go(&self.handshakes).ok_or(Full)?;
        Ok(self.end(id).map(|held| Evicted::Handshake(held.peer)))
    }

    /// Closes the session that gives way first.
    fn evict(&mut self, scope: EvictionScope, now: u64) -> Result<Evicted, Full> {
        if self.limits.when_full == WhenFull::Refuse {
            return Err(Full);
        }
        let grace = self.limits.grace.as_micros() as u64;
        let id = scope.first_to_go(&self.sessions, now, grace, self.next_unserved);
        let held = self.end(id.ok_or(Full)?).ok_or(Full)?;
        if !held.is_served() {
            // Places become free one by one, so that a flood that comes in waves does not get them all.
            self.next_unserved = now + grace / self.limits.max_connections.max(1) as u64;
        }
        Ok(Evicted::Connection(held.peer))
    }

    /// Whether a source that has so many places of a kind may not have another one.
    fn source_is_full(&self, count: usize) -> bool {
        self.limits.max_connections_per_source.is_some_and(|most| count >= most)
    }

    /// All connections.
    fn held(&self) -> impl Iterator<Item = (&u64, &Held)> {
        self.sessions.iter().chain(&self.handshakes)
    }

    fn held_mut(&mut self, id: u64) -> Option<&mut Held> {
        self.sessions.get_mut(&id).or_else(|| self.handshakes.get_mut(&id))
    }

    fn places(&self, source: IpAddr) -> Places {
        self.per_source.get(&source).copied().unwrap_or_default()
    }

    fn insert_session(&mut self, id: u64, held: Held) {
        self.per_source.entry(held.peer.ip()).or_default().sessions += 1;
        self.sessions.insert(id, held);
    }

    fn insert_handshake(&mut self, id: u64, held: Held) {
        self.per_source.entry(held.peer.ip()).or_default().handshakes += 1;
        self.handshakes.insert(id, held);
    }

    fn remove(&mut self, id: u64) -> Option<Held> {
        let session = self.sessions.remove(&id);
        let was_session = session.is_some();
        let held = session.or_else(|| self.handshakes.remove(&id))?;
        let mut places = self.places(held.peer.ip());
        match was_session {
            true => places.sessions -= 1,
            false => places.handshakes -= 1,
        }
        match places.sessions + places.handshakes {
            0 => self.per_source.remove(&held.peer.ip()),
            _ => self.per_source.insert(held.peer.ip(), places),
        };
        Some(held)
    }

    /// Removes a connection and aborts its task, which drops the socket. A task that runs ends only when it has
    /// to wait, so it looks at its validity before.
    fn end(&mut self, id: u64) -> Option<Held> {
        let held = self.remove(id)?;
        held.activity.validity.store(ENDED, Ordering::Release);
        if let Some(task) = &held.task {
            task.abort();
        }
        Some(held)
    }
}

impl Ticket {
    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    /// Moves the connection to the sessions: its peer is authenticated. Also returns the session
    /// that was evicted for it.
    ///
    /// # Errors
    /// There is no place.
    pub(crate) fn establish(&self) -> Result<Option<Evicted>, Full> {
        let mut table = lock(&self.admission.table);
        let Some(source) = table.handshakes.get(&self.id).map(|held| held.peer.ip()) else {
            // It has just been evicted, and ends at the next await.
            return Ok(None);
        };
        let evicted = table.clear_session(source, self.admission.since(Instant::now()))?;
        if let Some(held) = table.remove(self.id) {
            let now = self.admission.since(Instant::now());
            // Never the time of its admission: that stands for a connection which has sent nothing yet.
            self.activity.last_request.store(now.max(held.admitted + 1), Ordering::Relaxed);
            table.insert_session(self.id, held);
        }
        Ok(evicted)
    }

    /// Records the time of a request.
    #[inline]
    pub(crate) fn touch(&self, now: Instant) {
        self.activity.last_request.store(self.admission.since(now), Ordering::Relaxed);
    }

    /// Records the time of a request of Modbus, or of a reply that came later, and whether more are to come.
    #[inline]
    pub(crate) fn touch_modbus(&self, now: Instant, awaits_reply: bool) {
        self.touch(now);
        self.set_amid_exchange(awaits_reply);
    }

    /// Records the certificate that the peer has proved to own.
    pub(crate) fn identify(&self, certificate: Arc<PeerCertificate>) {
        if let Some(held) = lock(&self.admission.table).held_mut(self.id) {
            held.peer.certificate = Some(certificate);
        }
    }

    /// Whether the connection may go on with the rights that it has.
    pub(crate) fn is_current(&self) -> bool {
        self.activity.validity.load(Ordering::Acquire) == CURRENT
    }

    /// Whether rights must be looked up again. The next call returns false. Pending for ever if the connection has
    /// been ended: whoever did so has reported it, and aborts its task, which must answer nothing more.
    #[inline]
    pub(crate) fn poll_outdated(&self) -> Poll<bool> {
        let validity = &self.activity.validity;
        if validity.load(Ordering::Relaxed) == CURRENT {
            return Poll::Ready(false);
        }
        let taken =
            validity.compare_exchange(OUTDATED, CURRENT, Ordering::Acquire, Ordering::Relaxed);
        if taken.is_ok() { Poll::Ready(true) } else { Poll::Pending }
    }

    /// Records what a connection of HTTP waits for, and since when.
    pub(crate) fn wait(&self, waiting: WaitingFor, since: Instant) {
        self.touch(since);
        self.set_amid_exchange(waiting == WaitingFor::Rest);
        self.activity.is_busy.store(waiting == WaitingFor::Handler, Ordering::Relaxed);
        self.activity.is_served.store(waiting == WaitingFor::NextRequest, Ordering::Relaxed);
    }

    /// Records whether part of a packet has arrived, or a reply comes later.
    pub(crate) fn set_amid_exchange(&self, is_amid_exchange: bool) {
        self.activity.is_amid_exchange.store(is_amid_exchange, Ordering::Relaxed);
    }

    /// Records that the connection has had its last reply: it gives its place to any other one.
    pub(crate) fn set_answered(&self) {
        self.activity.is_answered.store(true, Ordering::Relaxed);
    }

    pub(crate) fn is_answered(&self) -> bool {
        self.activity.is_answered.load(Ordering::Relaxed)
    }
}

/// Sets the task of a connection, so that it can be evicted.
pub(crate) fn attach(admission: &Admission, id: u64, task: AbortHandle) {
    match lock(&admission.table).held_mut(id) {
        Some(held) => held.task = Some(task),
        // It was ended before its task ran, or its task has ended.
        None => task.abort(),
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        lock(&self.admission.table).remove(self.id);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::cell::{Cell, RefCell};
    use std::time::Duration;

    use super::*;

    pub(in crate::server) fn peer(last: u8, port: u16) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, last], port))
    }

    pub(in crate::server) fn session(last: u8, port: u16) -> Evicted {
        Evicted::Connection(peer(last, port).into())
    }

    pub(in crate::server) fn admission(
        max_connections: usize,
        max_connections_per_source: Option<usize>,
        when_full: WhenFull,
    ) -> Arc<Admission> {
        Arc::new(Admission::new(ConnectionLimits {
            max_connections,
            max_connections_per_source,
            when_full,
            max_handshakes: None,
            grace: Duration::ZERO,
        }))
    }

    /// One that has existed for some time, with a grace as for HTTP.
    pub(in crate::server) fn older(
        mut admission: Arc<Admission>,
        age: Duration,
        grace: Duration,
    ) -> Arc<Admission> {
        Arc::get_mut(&mut admission).unwrap().epoch -= age;
        lock(&admission.table).limits.grace = grace;
        admission
    }

    /// A listener with TLS.
    fn with_handshakes(
        max_handshakes: usize,
        max_connections: usize,
        max_connections_per_source: Option<usize>,
        when_full: WhenFull,
    ) -> Arc<Admission> {
        let admission = admission(max_connections, max_connections_per_source, when_full);
        lock(&admission.table).limits.max_handshakes = Some(max_handshakes);
        admission
    }

    /// Begins a handshake.
    pub(in crate::server) fn begin(
        admission: &Arc<Admission>,
        runtime: &tokio::runtime::Runtime,
        peer: SocketAddr,
    ) -> (Ticket, Option<Evicted>) {
        let (ticket, evicted) = admission.admit(peer).unwrap();
        attach(admission, ticket.id(), task(runtime));
        (ticket, evicted)
    }

    pub(in crate::server) fn task(runtime: &tokio::runtime::Runtime) -> AbortHandle {
        runtime.spawn(std::future::pending::<()>()).abort_handle()
    }

    #[test]
    fn dropping_a_ticket_frees_its_place() {
        let admission = admission(1, None, WhenFull::Refuse);
        let (ticket, _) = admission.admit(peer(1, 1)).unwrap();
        assert_eq!(admission.admit(peer(1, 2)).unwrap_err(), Full);
        drop(ticket);
        assert!(admission.admit(peer(1, 2)).is_ok());
    }

    #[test]
    fn a_closed_listener_ends_its_connections_and_admits_none() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        for (admission, when_full) in
            [WhenFull::Refuse, WhenFull::Evict].into_iter().flat_map(|when| {
                [(admission(9, None, when), when), (with_handshakes(9, 9, None, when), when)]
            })
        {
            let tickets = [1, 2, 3].map(|port| begin(&admission, &runtime, peer(1, port)).0);
            assert_eq!(tickets[0].establish(), Ok(None));
            tickets[0].set_answered();
            assert!(!admission.is_closed());
            let mut ended = admission.close();
            ended.sort_unstable_by_key(|peer| peer.address.port());
            assert_eq!(ended, [1, 2, 3].map(|port| peer(1, port).into()), "{when_full:?}");
            assert_eq!(admission.admit(peer(1, 4)).unwrap_err(), Full, "{when_full:?}");
            assert_eq!(tickets[1].establish(), Ok(None), "it ends at the next await");
            assert!(admission.is_closed() && admission.open() == 0);
        }
    }

    #[test]
    fn connections_begin_and_end_while_others_are_judged() {
        let admission = admission(9, None, WhenFull::Refuse);
        let tickets = [1, 2, 3].map(|port| admission.admit(peer(1, port)).unwrap().0);
        let begun = Cell::new(None);
        let left = RefCell::new(Some(tickets));
        let ended = admission.apply_reload(|judged| {
            assert!(admission.table.try_lock().is_ok(), "no worker waits for this");
            if let Some([first, second, third]) = left.take() {
                drop(first);
                begun.set(Some((second, third, admission.admit(peer(1, 4)).unwrap().0)));
            }
            (judged.address.port() != 3).then_some(())
        });
        assert_eq!(ended, [(peer(1, 2).into(), ())], "the first has left, the last is new");
        let (_second, third, _new) = begun.take().unwrap();
        assert_eq!([third.poll_outdated(), third.poll_outdated()], [true, false].map(Poll::Ready));
        assert_eq!(admission.open(), 2);
    }

    #[test]
    fn the_limit_of_a_source_counts_mapped_addresses_as_the_same() {
        let admission = admission(9, Some(1), WhenFull::Refuse);
        let mapped: SocketAddr = "[::ffff:127.0.0.1]:2".parse().unwrap();
        let held = admission.admit(peer(1, 1)).unwrap();
        assert_eq!(admission.admit(mapped).unwrap_err(), Full);
        assert!(admission.admit(peer(2, 1)).is_ok());
        drop(held);
        assert!(admission.admit(mapped).is_ok());
    }

    #[test]
    fn a_session_that_was_answered_keeps_no_handshake_out() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = with_handshakes(2, 1, None, WhenFull::Refuse);
        let (first, _) = begin(&admission, &runtime, peer(1, 1));
        assert_eq!(first.establish(), Ok(None));
        assert_eq!(admission.admit(peer(1, 2)).unwrap_err(), Full);
        first.set_answered();
        let (second, evicted) = begin(&admission, &runtime, peer(1, 2));
        assert_eq!(evicted, None, "only its session needs the place");
        assert_eq!(second.establish(), Ok(Some(Evicted::Answered(peer(1, 1).into()))));
    }

    #[test]
    fn handshakes_displace_each_other_and_no_session() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        for when_full in [WhenFull::Evict, WhenFull::Refuse] {
            let admission = with_handshakes(2, 3, None, when_full);
            let sessions = [1, 2].map(|port| begin(&admission, &runtime, peer(1, port)).0);
            sessions.iter().for_each(|ticket| assert_eq!(ticket.establish(), Ok(None)));
            let silent: Vec<_> =
                (10..40).map(|port| begin(&admission, &runtime, peer(1, port))).collect();
            let evicted: Vec<_> =
                silent.iter().filter_map(|(_, evicted)| evicted.clone()).collect();
            let oldest: Vec<_> =
                (10..38).map(|port| Evicted::Handshake(peer(1, port).into())).collect();
            assert_eq!(evicted, oldest);
            assert_eq!(admission.open(), 4, "{when_full:?}");
        }
    }

    #[test]
    fn an_authenticated_peer_takes_the_place_of_the_session_that_is_idle_longest() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = with_handshakes(9, 2, None, WhenFull::Evict);
        let tickets = [1, 2, 3].map(|port| {
            let (ticket, evicted) = begin(&admission, &runtime, peer(1, port));
            assert_eq!(evicted, None);
            ticket
        });
        assert_eq!(tickets[1].establish(), Ok(None));
        assert_eq!(tickets[0].establish(), Ok(None));
        assert_eq!(tickets[2].establish(), Ok(Some(session(1, 2))));
        assert_eq!(admission.open(), 2);
    }

    #[test]
    fn without_eviction_a_full_listener_refuses_a_peer_before_and_after_its_handshake() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = with_handshakes(9, 1, None, WhenFull::Refuse);
        let tickets = [1, 2].map(|port| begin(&admission, &runtime, peer(1, port)).0);
        assert_eq!(tickets[1].establish(), Ok(None));
        assert_eq!(tickets[0].establish(), Err(Full));
        assert_eq!(admission.admit(peer(2, 3)).unwrap_err(), Full);
        drop(tickets);
        assert_eq!((admission.open(), lock(&admission.table).per_source.len()), (0, 0));
    }

    #[test]
    fn handshakes_of_a_source_at_its_limit_displace_only_each_other() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = with_handshakes(9, 9, Some(2), WhenFull::Evict);
        let _other = begin(&admission, &runtime, peer(2, 1));
        let _held = [1, 2].map(|port| begin(&admission, &runtime, peer(1, port)));
        let (third, evicted) = begin(&admission, &runtime, peer(1, 3));
        assert_eq!(evicted, Some(Evicted::Handshake(peer(1, 1).into())));
        assert_eq!(third.establish(), Ok(None));
    }

    #[test]
    fn a_handshake_that_was_just_evicted_takes_no_place() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = with_handshakes(1, 1, None, WhenFull::Evict);
        let first = begin(&admission, &runtime, peer(1, 1)).0;
        let _second = begin(&admission, &runtime, peer(1, 2));
        assert_eq!(first.establish(), Ok(None));
        assert_eq!(admission.open(), 1);
    }
}
