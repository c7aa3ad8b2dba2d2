//! Which connection of a full listener or HTTP host is closed for a new one.
//!
//! A session that has had its last reply always gives way. With
//! [`WhenFull::Evict`](super::admission::WhenFull::Evict), the others give way in the order of
//! [`Standing`].

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use tokio::task::AbortHandle;

use crate::server::connections::peer::Peer;

/// A connection without any request so far counts as idle for this much longer, so that connections
/// that never send anything do not displace those that do.
const LONGER_WITHOUT_REQUEST: Duration = Duration::from_secs(60);

/// The time that the first bytes of a new connection of HTTP have to arrive before it can be closed for
/// another.
const FIRST_BYTES_TIME: Duration = Duration::from_millis(100);

/// Among which connections one gives way, because together they leave no place for another one.
#[derive(Debug, Clone, Copy)]
pub(super) enum EvictionScope {
    Source(IpAddr),
    All,
}

impl EvictionScope {
    pub(super) fn has(self, held: &Held) -> bool {
        match self {
            EvictionScope::Source(source) => held.peer.ip() == source,
            EvictionScope::All => true,
        }
    }

    /// The first of these sessions that has had its last reply.
    pub(super) fn answered(self, sessions: &HashMap<u64, Held>) -> Option<u64> {
        let is_answered = |held: &Held| {
            held.task.is_some()
                && self.has(held)
                && held.activity.is_answered.load(Ordering::Relaxed)
        };
        sessions.iter().filter(|(_, held)| is_answered(held)).map(|(id, _)| *id).min()
    }

    /// The first of these handshakes to give way. It is the oldest: one that takes its time is more likely a
    /// peer that never completes it.
    pub(super) fn first_handshake_to_go(self, handshakes: &BTreeMap<u64, Held>) -> Option<u64> {
        let may_go = |held: &Held| held.task.is_some() && self.has(held);
        handshakes.iter().find(|(_, held)| may_go(held)).map(|(id, _)| *id)
    }

    /// The first of these sessions to give way; `None` if none may. `next_unserved` is when one that had no
    /// response may, as [`Activity::last_request`].
    pub(super) fn first_to_go(
        self,
        sessions: &HashMap<u64, Held>,
        now: u64,
        grace: u64,
        next_unserved: u64,
    ) -> Option<u64> {
        let sessions = || sessions.iter().filter(|(_, held)| self.has(held));
        // A flood of connections that never complete a request has half of the places at most.
        let in_use = sessions().filter(|(_, held)| held.is_in_use(now, grace)).count();
        let spares = 2 * in_use < sessions().count();
        let candidates = sessions().filter(|(_, held)| {
            held.task.is_some()
                && held.may_go(now, grace)
                && !(spares && held.is_in_use(now, grace))
                && (held.is_served() || now >= next_unserved)
        });
        candidates.min_by_key(|(id, held)| held.rank(**id, now, grace)).map(|(id, _)| *id)
    }
}

/// In the order in which sessions give way; of the same standing, the one that has been idle longest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Standing {
    Idle,
    AmidExchange,
    /// It has just had its response.
    JustServed,
}

#[derive(Debug)]
pub(super) struct Held {
    pub(super) peer: Peer,
    pub(super) opened: SystemTime,
    /// When it was admitted, as [`Activity::last_request`].
    pub(super) admitted: u64,
    pub(super) activity: Arc<Activity>,
    /// Set once the task of the connection runs.
    pub(super) task: Option<AbortHandle>,
}

/// What a connection and the table of connections tell each other without waiting.
#[derive(Debug, Default)]
pub(super) struct Activity {
    /// In microseconds since the epoch of the admission. A reply that comes later counts as a request. Before any,
    /// when it was admitted.
    pub(super) last_request: AtomicU64,
    /// Whether part of a packet or of a request of HTTP has arrived, or a reply of Modbus comes later.
    pub(super) is_amid_exchange: AtomicBool,
    /// Whether the peer waits for a response of HTTP that takes its time.
    pub(super) is_busy: AtomicBool,
    /// Whether `last_request` is the time of the last response.
    pub(super) is_served: AtomicBool,
    /// Whether the connection has had its last reply, and waits for its peer to close.
    pub(super) is_answered: AtomicBool,
    /// [`CURRENT`], [`OUTDATED`] or [`ENDED`].
    pub(super) validity: AtomicU8,
}

/// A connection may go on with the rights that it has. Each of these values outweighs the one before it.
pub(super) const CURRENT: u8 = 0;
/// The connection must look up its rights again.
pub(super) const OUTDATED: u8 = 1;
/// The connection has been ended. Its task may not have noticed.
pub(super) const ENDED: u8 = 2;

impl Held {
    /// The order in which sessions give way. Only those of HTTP have a `grace`: one that has just had its
    /// response does not give way to those that never complete a request.
    fn rank(&self, id: u64, now: u64, grace: u64) -> (Standing, i128, u64) {
        let last_request = self.activity.last_request.load(Ordering::Relaxed);
        let has_no_request = last_request == self.admitted;
        let longer = if has_no_request { LONGER_WITHOUT_REQUEST.as_micros() as i128 } else { 0 };
        let standing = if self.activity.is_amid_exchange.load(Ordering::Relaxed) {
            Standing::AmidExchange
        } else if self.waited(now) < grace {
            Standing::JustServed
        } else {
            Standing::Idle
        };
        (standing, i128::from(last_request) - longer, id)
    }

    /// Whether it may be closed for another connection now.
    fn may_go(&self, now: u64, grace: u64) -> bool {
        let Activity { is_amid_exchange, is_busy, .. } = &*self.activity;
        let grace = match is_amid_exchange.load(Ordering::Relaxed) {
            true => grace,
            false if self.is_served() => 0,
            false => grace.min(FIRST_BYTES_TIME.as_micros() as u64),
        };
        !is_busy.load(Ordering::Relaxed) && self.waited(now) >= grace
    }

    /// Whether a request is being answered, or was within the grace.
    fn is_in_use(&self, now: u64, grace: u64) -> bool {
        let is_busy = self.activity.is_busy.load(Ordering::Relaxed);
        is_busy || self.is_served() && self.waited(now) < grace
    }

    pub(super) fn is_served(&self) -> bool {
        self.activity.is_served.load(Ordering::Relaxed)
    }

    fn waited(&self, now: u64) -> u64 {
        now.saturating_sub(self.activity.last_request.load(Ordering::Relaxed))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use crate::server::connections::admission::tests::{
        admission, begin, older, peer, session, task,
    };
    use crate::server::connections::admission::{
        Evicted, Full, Ticket, WaitingFor, WhenFull, attach,
    };

    /// Which of several connections of HTTP gives way, given what each waits for, and for how long.
    fn http_evicts(waiting: &[(WaitingFor, Duration)]) -> Option<usize> {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = admission(waiting.len(), None, WhenFull::Evict);
        let admission = older(admission, Duration::from_secs(200), Duration::from_secs(1));
        let now = Instant::now();
        let tickets: Vec<Ticket> = waiting
            .iter()
            .zip(0..)
            .map(|((waiting, long), port)| {
                let (ticket, _) = begin(&admission, &runtime, peer(1, port));
                ticket.wait(*waiting, now - *long);
                ticket
            })
            .collect();
        let evicted = admission.admit(peer(2, 0)).ok()?.1;
        assert_eq!(tickets.len(), waiting.len());
        (0..waiting.len()).find(|port| evicted == Some(session(1, *port as u16)))
    }

    #[test]
    fn connections_of_http_give_way_that_wait_longest_for_a_request_then_those_within_one() {
        use WaitingFor::{FirstRequest as Request, Handler, Rest};
        let of = |seconds: u64| Duration::from_millis(seconds * 1000 + 500);
        type Case<'a> = (&'a [(WaitingFor, Duration)], Option<usize>);
        let cases: [Case<'_>; 10] = [
            (&[(Request, of(2)), (Request, of(3)), (Request, of(1))], Some(1)),
            (&[(Request, of(0)), (Rest, of(99))], Some(1)),
            (&[(Request, of(2)), (Rest, of(99))], Some(0)),
            (&[(Request, of(0)), (Rest, of(0))], Some(0)),
            (&[(Rest, of(99)), (Request, of(1))], Some(1)),
            (&[(Rest, of(91)), (Rest, of(92)), (Rest, of(0))], Some(1)),
            (&[(Handler, of(99)), (Rest, of(1))], Some(1)),
            (&[(Handler, of(99)), (Handler, of(99))], None),
            (&[(Rest, of(0))], None),
            (&[(Handler, of(99)), (Rest, of(0))], None),
        ];
        for (waiting, evicted) in cases {
            assert_eq!(http_evicts(waiting), evicted, "{waiting:?}");
        }
    }

    #[test]
    fn connections_of_http_in_use_have_half_of_the_places() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = admission(3, None, WhenFull::Evict);
        let admission = older(admission, Duration::from_secs(1), Duration::from_secs(60));
        let begin = |port, waiting| {
            let (ticket, evicted) = admission.admit(peer(1, port))?;
            attach(&admission, ticket.id(), task(&runtime));
            ticket.wait(waiting, Instant::now());
            Ok::<_, Full>((ticket, evicted))
        };
        let _used = [1, 2, 3].map(|port| begin(port, WaitingFor::NextRequest).unwrap());
        let (silent, evicted) = begin(4, WaitingFor::FirstRequest).unwrap();
        assert_eq!(evicted, Some(session(1, 1)), "all are in use");
        let (other, evicted) = begin(5, WaitingFor::FirstRequest).unwrap();
        assert_eq!(evicted, Some(session(1, 2)), "two of three are in use");
        assert_eq!(begin(6, WaitingFor::Rest).unwrap_err(), Full, "its first bytes may arrive");
        silent.wait(WaitingFor::FirstRequest, Instant::now() - 2 * FIRST_BYTES_TIME);
        other.wait(WaitingFor::FirstRequest, Instant::now() - 2 * FIRST_BYTES_TIME);
        let (_last, evicted) = begin(7, WaitingFor::Rest).unwrap();
        assert_eq!(evicted, Some(session(1, 4)), "it is silent");
        assert_eq!(begin(8, WaitingFor::Rest).unwrap_err(), Full, "the next place is free later");
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
        assert_eq!(evicted, Some(session(1, 2)));
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
        tickets[0].set_amid_exchange(true);
        tickets[2].set_amid_exchange(true);
        let (_fourth, evicted) = admit(4);
        assert_eq!(evicted, Some(session(1, 2)));
        let (fifth, evicted) = admit(5);
        assert_eq!(evicted, Some(session(1, 4)), "the silent one, although it is the newest");
        fifth.set_amid_exchange(true);
        let (sixth, evicted) = admit(6);
        assert_eq!(evicted, Some(session(1, 1)), "all are in the middle of a packet");
        sixth.set_amid_exchange(true);
        fifth.set_amid_exchange(false);
        assert_eq!(admit(7).1, Some(session(1, 5)), "its packet is complete");
    }

    #[test]
    fn a_connection_that_was_answered_gives_its_place_to_any_other() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        for when_full in [WhenFull::Refuse, WhenFull::Evict] {
            let admission = admission(3, Some(2), when_full);
            let admit = |last, port| {
                let (ticket, evicted) = admission.admit(peer(last, port))?;
                attach(&admission, ticket.id(), task(&runtime));
                Ok::<_, Full>((ticket, evicted))
            };
            let answered = |last, port| Some(Evicted::Answered(peer(last, port).into()));
            let tickets = [(1, 1), (2, 1), (1, 2)].map(|(last, port)| admit(last, port).unwrap().0);
            tickets[1].set_answered();
            let (_fourth, evicted) = admit(3, 1).unwrap();
            assert_eq!(evicted, answered(2, 1));
            tickets[2].set_answered();
            let (_fifth, evicted) = admit(1, 3).unwrap();
            assert_eq!(evicted, answered(1, 2), "the limit of the source");
            let next = admit(1, 4).map(|(_, evicted)| evicted);
            let expected =
                if when_full == WhenFull::Evict { Ok(Some(session(1, 1))) } else { Err(Full) };
            assert_eq!(next, expected, "no other one was answered");
        }
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
        assert_eq!(evicted, Some(session(2, 2)));
    }

    #[test]
    fn a_connection_without_a_request_gives_way_to_those_with_requests() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let admission = admission(3, None, WhenFull::Evict);
        let busy = [1, 2].map(|port| begin(&admission, &runtime, peer(1, port)).0);
        busy.iter().for_each(|ticket| ticket.touch(Instant::now()));
        let mut silent = vec![begin(&admission, &runtime, peer(1, 3)).0];
        for port in 4..20 {
            let (ticket, evicted) = begin(&admission, &runtime, peer(1, port));
            assert_eq!(evicted, Some(session(1, port - 1)));
            silent.push(ticket);
        }
    }

    #[test]
    fn connections_that_were_idle_for_long_give_way_to_new_ones_without_a_request() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        // The others sent their last requests before the silence that a new connection has ahead.
        let age = LONGER_WITHOUT_REQUEST + Duration::from_secs(10);
        let admission = older(admission(3, None, WhenFull::Evict), age, Duration::ZERO);
        let begun = Instant::now() - age;
        let _dead = [1, 2, 3].map(|port| {
            let ticket = begin(&admission, &runtime, peer(1, port)).0;
            ticket.touch(begun + Duration::from_secs(u64::from(port)));
            ticket
        });
        let evicted = [4, 5, 6].map(|port| begin(&admission, &runtime, peer(1, port)));
        let evicted = evicted.each_ref().map(|(_, evicted)| evicted.clone());
        assert_eq!(evicted, [1, 2, 3].map(|port| Some(session(1, port))));
    }
}
