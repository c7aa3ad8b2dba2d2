//! The open connections of a listener, and their limits.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::task::AbortHandle;

use super::peer::Peer;
use crate::tls::server::PeerCertificate;

/// What happens to a new connection when a limit is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The new connection is closed.
    Refuse,
    /// The connection that has been idle longest is closed. A connection in the middle of a Raw
    /// Ingest packet is closed only if all are.
    Evict,
}

/// The limits on open connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionLimits {
    pub max_connections: usize,
    pub max_connections_per_source: Option<usize>,
    pub when_full: WhenFull,
}

impl ConnectionLimits {
    /// For a listener without connections.
    pub(super) const NONE: ConnectionLimits = ConnectionLimits {
        max_connections: 0,
        max_connections_per_source: None,
        when_full: WhenFull::Refuse,
    };
}

#[derive(Debug)]
pub(crate) struct Admission {
    epoch: Instant,
    table: Mutex<Table>,
}

#[derive(Debug)]
struct Table {
    limits: ConnectionLimits,
    next_id: u64,
    held: HashMap<u64, Held>,
    per_source: HashMap<IpAddr, usize>,
}

#[derive(Debug)]
struct Held {
    peer: Peer,
    opened: SystemTime,
    activity: Arc<Activity>,
    /// Set once the task of the connection runs.
    task: Option<AbortHandle>,
}

/// What a connection and the table of connections tell each other without waiting.
#[derive(Debug)]
struct Activity {
    /// In microseconds since the epoch of the admission.
    last_request: AtomicU64,
    is_amid_packet: AtomicBool,
    /// Whether the connection must look up its rights again.
    is_outdated: AtomicBool,
}

/// An open connection.
#[derive(Debug, Clone)]
pub struct Session {
    /// Its number among the connections of its listener.
    pub id: u64,
    pub peer: Peer,
    pub opened: SystemTime,
    /// The time since the last request, or since it was opened.
    pub idle: Duration,
}

/// The limit is reached, and no connection can be evicted.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Full;

/// The place of one connection. Dropping it frees the place.
#[derive(Debug)]
pub(crate) struct Ticket {
    id: u64,
    activity: Arc<Activity>,
    admission: Arc<Admission>,
}

impl Admission {
    pub(crate) fn new(limits: ConnectionLimits) -> Admission {
        let table = Table { limits, next_id: 0, held: HashMap::new(), per_source: HashMap::new() };
        Admission { epoch: Instant::now(), table: Mutex::new(table) }
    }

    /// Changes the limits. Open connections stay.
    pub(crate) fn set_limits(&self, limits: ConnectionLimits) {
        self.table().limits = limits;
    }

    /// Admits a connection from `peer`. Also returns the peer that was evicted for it.
    pub(crate) fn admit(
        self: &Arc<Self>,
        peer: SocketAddr,
    ) -> Result<(Ticket, Option<Peer>), Full> {
        let source = peer.ip().to_canonical();
        let mut table = self.table();
        let from_source = table.per_source.get(&source).copied().unwrap_or_default();
        let ConnectionLimits { max_connections, max_connections_per_source, .. } = table.limits;
        let evicted = if max_connections_per_source.is_some_and(|most| from_source >= most) {
            Some(self.evict(&mut table, Some(source))?)
        } else if table.held.len() >= max_connections {
            Some(self.evict(&mut table, None)?)
        } else {
            None
        };
        let id = table.next_id;
        table.next_id += 1;
        let last_request = AtomicU64::new(self.now());
        let (is_amid_packet, is_outdated) = (AtomicBool::new(false), AtomicBool::new(false));
        let activity = Arc::new(Activity { last_request, is_amid_packet, is_outdated });
        let (peer, opened) = (peer.into(), SystemTime::now());
        let held = Held { peer, opened, activity: Arc::clone(&activity), task: None };
        table.held.insert(id, held);
        *table.per_source.entry(source).or_default() += 1;
        Ok((Ticket { id, activity, admission: Arc::clone(self) }, evicted))
    }

    /// Closes the connection that has been idle longest, of one source or of all; first those that are
    /// not in the middle of a packet.
    fn evict(&self, table: &mut Table, source: Option<IpAddr>) -> Result<Peer, Full> {
        if table.limits.when_full == WhenFull::Refuse {
            return Err(Full);
        }
        let of_source = |held: &Held| source.is_none_or(|ip| held.peer.ip().to_canonical() == ip);
        let candidates =
            table.held.iter().filter(|(_, held)| held.task.is_some() && of_source(held));
        let id = candidates
            .min_by_key(|(id, held)| {
                let Activity { last_request, is_amid_packet, .. } = &*held.activity;
                let is_amid_packet = is_amid_packet.load(Ordering::Relaxed);
                (is_amid_packet, last_request.load(Ordering::Relaxed), **id)
            })
            .map(|(id, _)| *id)
            .ok_or(Full)?;
        Ok(table.end(id).ok_or(Full)?.peer)
    }

    /// Ends the connections for which `ends` has a reason. The others look up their rights again,
    /// before they answer the next request. Returns the reasons, and whom they concern.
    pub(crate) fn review<R>(&self, ends: impl Fn(&Peer) -> Option<R>) -> Vec<(Peer, R)> {
        let mut table = self.table();
        let mut ending = Vec::new();
        for (id, held) in &table.held {
            match ends(&held.peer) {
                Some(reason) => ending.push((*id, reason)),
                None => held.activity.is_outdated.store(true, Ordering::Release),
            }
        }
        let ended = |(id, reason)| table.end(id).map(|held| (held.peer, reason));
        ending.into_iter().filter_map(ended).collect()
    }

    /// Ends one connection. Returns its peer, `None` if there is no such connection.
    pub(crate) fn end(&self, id: u64) -> Option<Peer> {
        self.table().end(id).map(|held| held.peer)
    }

    /// The open connections, in the order in which they were opened.
    pub(crate) fn sessions(&self) -> Vec<Session> {
        let now = self.now();
        let session = |(id, held): (&u64, &Held)| Session {
            id: *id,
            peer: held.peer.clone(),
            opened: held.opened,
            idle: Duration::from_micros(
                now.saturating_sub(held.activity.last_request.load(Ordering::Relaxed)),
            ),
        };
        let mut sessions: Vec<Session> = self.table().held.iter().map(session).collect();
        sessions.sort_unstable_by_key(|session| session.id);
        sessions
    }

    pub(crate) fn open(&self) -> usize {
        self.table().held.len()
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now(&self) -> u64 {
        self.epoch.elapsed().as_micros() as u64
    }
}

impl Table {
    /// Removes a connection and aborts its task, which drops the socket.
    fn end(&mut self, id: u64) -> Option<Held> {
        let held = self.remove(id)?;
        if let Some(task) = &held.task {
            task.abort();
        }
        Some(held)
    }

    fn remove(&mut self, id: u64) -> Option<Held> {
        let held = self.held.remove(&id)?;
        let source = held.peer.ip().to_canonical();
        if let Some(count) = self.per_source.get_mut(&source) {
            *count -= 1;
            if *count == 0 {
                self.per_source.remove(&source);
            }
        }
        Some(held)
    }
}

impl Ticket {
    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    /// Records the time of a request.
    #[inline]
    pub(crate) fn touch(&self, now: Instant) {
        let since = now.saturating_duration_since(self.admission.epoch);
        self.activity.last_request.store(since.as_micros() as u64, Ordering::Relaxed);
    }

    /// Records the certificate that the peer has proved to own.
    pub(crate) fn identify(&self, certificate: Arc<PeerCertificate>) {
        if let Some(held) = self.admission.table().held.get_mut(&self.id) {
            held.peer.certificate = Some(certificate);
        }
    }

    /// Whether rights must be looked up again. The next call returns false.
    #[inline]
    pub(crate) fn take_outdated(&self) -> bool {
        self.activity.is_outdated.load(Ordering::Relaxed)
            && self.activity.is_outdated.swap(false, Ordering::Acquire)
    }

    /// Records whether part of a packet has arrived.
    pub(crate) fn set_amid_packet(&self, is_amid_packet: bool) {
        self.activity.is_amid_packet.store(is_amid_packet, Ordering::Relaxed);
    }
}

/// Sets the task of a connection, so that it can be evicted.
pub(crate) fn attach(admission: &Admission, id: u64, task: AbortHandle) {
    match admission.table().held.get_mut(&id) {
        Some(held) => held.task = Some(task),
        // It was ended before its task ran, or its task has ended.
        None => task.abort(),
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.admission.table().remove(self.id);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn peer(last: u8, port: u16) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, last], port))
    }

    fn admission(
        max_connections: usize,
        max_connections_per_source: Option<usize>,
        when_full: WhenFull,
    ) -> Arc<Admission> {
        Arc::new(Admission::new(ConnectionLimits {
            max_connections,
            max_connections_per_source,
            when_full,
        }))
    }

    fn task(runtime: &tokio::runtime::Runtime) -> AbortHandle {
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
    fn the_connection_that_has_been_idle_longest_is_evicted() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = admission(3, None, WhenFull::Evict);
        let tickets = [1, 2, 3].map(|port| {
            let (ticket, evicted) = admission.admit(peer(1, port)).unwrap();
            assert_eq!(evicted, None);
            attach(&admission, ticket.id(), task(&runtime));
            ticket
        });
        let later = Instant::now() + Duration::from_secs(1);
        for (seconds, index) in [(3, 0), (1, 1), (2, 2)] {
            tickets[index].touch(later + Duration::from_secs(seconds));
        }
        let (_fourth, evicted) = admission.admit(peer(1, 4)).unwrap();
        assert_eq!(evicted, Some(peer(1, 2).into()));
        assert_eq!(admission.open(), 3);
    }

    #[test]
    fn a_connection_in_the_middle_of_a_packet_is_evicted_last() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = admission(3, None, WhenFull::Evict);
        let admit = |port| {
            let (ticket, evicted) = admission.admit(peer(1, port)).unwrap();
            attach(&admission, ticket.id(), task(&runtime));
            (ticket, evicted)
        };
        let tickets = [1, 2, 3].map(|port| admit(port).0);
        tickets[0].set_amid_packet(true);
        tickets[2].set_amid_packet(true);
        let (_fourth, evicted) = admit(4);
        assert_eq!(evicted, Some(peer(1, 2).into()));
        let (fifth, evicted) = admit(5);
        assert_eq!(evicted, Some(peer(1, 4).into()), "the silent one, although it is the newest");
        fifth.set_amid_packet(true);
        let (sixth, evicted) = admit(6);
        assert_eq!(evicted, Some(peer(1, 1).into()), "all are in the middle of a packet");
        sixth.set_amid_packet(true);
        fifth.set_amid_packet(false);
        assert_eq!(admit(7).1, Some(peer(1, 5).into()), "its packet is complete");
    }

    #[test]
    fn a_source_at_its_limit_evicts_only_its_own_connections() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = admission(9, Some(1), WhenFull::Evict);
        let _held = [(1, 1), (2, 2)].map(|(last, port)| {
            let (ticket, _) = admission.admit(peer(last, port)).unwrap();
            attach(&admission, ticket.id(), task(&runtime));
            ticket
        });
        let (_third, evicted) = admission.admit(peer(2, 3)).unwrap();
        assert_eq!(evicted, Some(peer(2, 2).into()));
    }
}
