//! Limits on the requests and writes per second of each source.
//!
//! A source has a moment up to which its requests are paid for, and every request moves it on by its
//! share of a second. At most [`BURST`] can be used in advance. A stream that has used more is not read
//! until it has caught up, so no request is lost. A datagram of such a source is dropped.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::counter::Counter;

/// The time of which a source that was idle may send all requests at once.
const BURST: Duration = Duration::from_secs(1);

/// The longest pause before limits are looked up again: a reload may have changed them.
pub(crate) const MAX_PAUSE: Duration = Duration::from_secs(1);

/// The shortest time between two reports about the same source.
const REPORT_INTERVAL: Duration = Duration::from_secs(60);

/// Maximum number of UDP sources with limits of their own. Further sources share one limit, because
/// senders can forge addresses.
const MAX_SENDERS: usize = 4096;

/// Sources that are kept before the idle ones are looked for.
const FEW_SOURCES: usize = 64;

const SECOND: u64 = 1_000_000_000;

/// The most requests and writes per second of one source; 0 is no limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RateLimits {
    pub requests: u32,
    pub writes: u32,
}

/// What a source has too many of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Excess {
    Requests,
    Writes,
}

/// How often sources exceeded their limits.
#[derive(Debug, Default)]
pub struct RateCounters {
    /// Times that a connection was not read for a while.
    pub paused: ByExcess,
    /// Datagrams dropped.
    pub dropped: ByExcess,
}

#[derive(Debug, Default)]
pub struct ByExcess {
    pub requests: Counter,
    pub writes: Counter,
}

/// Requests to charge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Charge {
    pub(crate) requests: u32,
    /// Among those.
    pub(crate) writes: u32,
}

/// The limits of a listener, and what each source has used of them.
#[derive(Debug)]
pub(crate) struct Rates {
    epoch: Instant,
    requests: AtomicU32,
    writes: AtomicU32,
    sources: Mutex<Sources>,
    pub(crate) counters: RateCounters,
}

#[derive(Debug)]
struct Sources {
    known: HashMap<IpAddr, Arc<Source>>,
    /// The number at which idle sources are forgotten.
    most: usize,
    /// When they were last forgotten.
    forgotten: u64,
    others: Arc<Source>,
}

/// What one source has used, in nanoseconds since the epoch.
#[derive(Debug, Default)]
pub(crate) struct Source {
    requests: AtomicU64,
    writes: AtomicU64,
    /// When it was last reported; 0 for never.
    reported: AtomicU64,
}

impl Excess {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Excess::Requests => "requests",
            Excess::Writes => "writes",
        }
    }
}

impl ByExcess {
    fn add(&self, excess: Excess) {
        match excess {
            Excess::Requests => self.requests.add(),
            Excess::Writes => self.writes.add(),
        }
    }
}

impl Rates {
    pub(crate) fn new(limits: RateLimits) -> Rates {
        Rates {
            epoch: Instant::now(),
            requests: AtomicU32::new(limits.requests),
            writes: AtomicU32::new(limits.writes),
            sources: Mutex::new(Sources {
                known: HashMap::new(),
                most: FEW_SOURCES,
                forgotten: 0,
                others: Arc::default(),
            }),
            counters: RateCounters::default(),
        }
    }

    /// Changes the limits. What was used before is forgotten, so that no source waits for a limit that
    /// does not apply any more.
    pub(crate) fn set_limits(&self, limits: RateLimits) {
        let requests = self.requests.swap(limits.requests, Ordering::Relaxed);
        let writes = self.writes.swap(limits.writes, Ordering::Relaxed);
        if limits != (RateLimits { requests, writes }) {
            let sources = self.sources();
            for source in sources.known.values().chain([&sources.others]) {
                source.requests.store(0, Ordering::Relaxed);
                source.writes.store(0, Ordering::Relaxed);
            }
        }
    }

    #[inline]
    pub(crate) fn are_limited(&self) -> bool {
        self.limits() != RateLimits::default()
    }

    #[inline]
    fn limits(&self) -> RateLimits {
        RateLimits {
            requests: self.requests.load(Ordering::Relaxed),
            writes: self.writes.load(Ordering::Relaxed),
        }
    }

    /// The account of a source with connections. It outlives them, because a new connection must not
    /// begin anew.
    pub(crate) fn source(&self, peer: IpAddr) -> Arc<Source> {
        let mut sources = self.sources();
        if sources.known.len() >= sources.most {
            sources.forget(self.nanos(Instant::now()));
        }
        Arc::clone(sources.known.entry(peer.to_canonical()).or_default())
    }

    /// Charges what a source has sent.
    #[inline]
    pub(crate) fn charge(&self, source: &Source, charge: Charge, now: Instant) {
        let (limits, now) = (self.limits(), self.nanos(now));
        use_up(&source.requests, charge.requests, limits.requests, now);
        use_up(&source.writes, charge.writes, limits.writes, now);
    }

    /// How long a source must wait, and for what. One that only reads does not wait for its writes.
    #[inline]
    pub(crate) fn wait(
        &self,
        source: &Source,
        writes: bool,
        now: Instant,
    ) -> Option<(Duration, Excess)> {
        let (limits, now) = (self.limits(), self.nanos(now));
        let requests = excess(&source.requests, limits.requests, now);
        let writes = if writes { excess(&source.writes, limits.writes, now) } else { 0 };
        let (wait, excess) =
            if writes > requests { (writes, Excess::Writes) } else { (requests, Excess::Requests) };
        (wait > 0).then(|| (Duration::from_nanos(wait), excess))
    }

    /// Charges a datagram, unless its source has sent too many. Returns whether to report that, too.
    pub(crate) fn admit(&self, peer: IpAddr, is_write: bool) -> Result<(), (Excess, bool)> {
        if !self.are_limited() {
            return Ok(());
        }
        let (now, limits) = (Instant::now(), self.limits());
        let (source, nanos) = (self.sender(peer, now), self.nanos(now));
        let found = if excess(&source.requests, limits.requests, nanos) > 0 {
            Excess::Requests
        } else if is_write && excess(&source.writes, limits.writes, nanos) > 0 {
            Excess::Writes
        } else {
            self.charge(&source, Charge { requests: 1, writes: u32::from(is_write) }, now);
            return Ok(());
        };
        self.counters.dropped.add(found);
        Err((found, self.is_to_report(&source, now)))
    }

    /// The account of a source of datagrams.
    fn sender(&self, peer: IpAddr, now: Instant) -> Arc<Source> {
        let (mut sources, peer) = (self.sources(), peer.to_canonical());
        if let Some(known) = sources.known.get(&peer) {
            return Arc::clone(known);
        }
        if sources.known.len() >= sources.most.min(MAX_SENDERS) {
            let nanos = self.nanos(now);
            // With forged addresses, each datagram may be from a new one.
            if nanos >= sources.forgotten + SECOND {
                sources.forget(nanos);
            }
            if sources.known.len() >= MAX_SENDERS {
                return Arc::clone(&sources.others);
            }
        }
        Arc::clone(sources.known.entry(peer).or_default())
    }

    /// Counts a pause of a connection. Returns whether to report it.
    pub(crate) fn note_pause(&self, source: &Source, excess: Excess, now: Instant) -> bool {
        self.counters.paused.add(excess);
        self.is_to_report(source, now)
    }

    fn is_to_report(&self, source: &Source, now: Instant) -> bool {
        let (now, before) = (self.nanos(now).max(1), source.reported.load(Ordering::Relaxed));
        let is_due = before == 0 || now.saturating_sub(before) >= nanos(REPORT_INTERVAL);
        is_due
            && source
                .reported
                .compare_exchange(before, now, Ordering::Relaxed, Ordering::Relaxed)
                .is_ok()
    }

    #[inline]
    fn nanos(&self, now: Instant) -> u64 {
        nanos(now.saturating_duration_since(self.epoch))
    }

    fn sources(&self) -> MutexGuard<'_, Sources> {
        self.sources.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Sources {
    /// Forgets sources that nobody holds and that have nothing to wait for.
    fn forget(&mut self, now: u64) {
        self.known.retain(|_, source| {
            let used = source.requests.load(Ordering::Relaxed);
            let is_idle = used.max(source.writes.load(Ordering::Relaxed)) <= now;
            Arc::strong_count(source) > 1 || !is_idle
        });
        self.forgotten = now;
        self.most = (2 * self.known.len()).max(FEW_SOURCES);
    }
}

#[inline]
fn nanos(time: Duration) -> u64 {
    time.as_secs() * SECOND + u64::from(time.subsec_nanos())
}

/// Moves the moment up to which an account is paid for.
#[inline]
fn use_up(paid: &AtomicU64, count: u32, limit: u32, now: u64) {
    if count == 0 || limit == 0 {
        return;
    }
    let cost = u64::from(count) * SECOND / u64::from(limit);
    let moved = |paid: u64| Some(paid.max(now) + cost);
    let _ = paid.fetch_update(Ordering::Relaxed, Ordering::Relaxed, moved);
}

/// Nanoseconds until an account has caught up.
#[inline]
fn excess(paid: &AtomicU64, limit: u32, now: u64) -> u64 {
    if limit == 0 {
        return 0;
    }
    paid.load(Ordering::Relaxed).saturating_sub(now + nanos(BURST))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates(requests: u32, writes: u32) -> Rates {
        Rates::new(RateLimits { requests, writes })
    }

    fn address(last: u8) -> IpAddr {
        IpAddr::from([192, 0, 2, last])
    }

    const ONE: Charge = Charge { requests: 1, writes: 0 };

    #[test]
    fn a_source_may_use_one_second_in_advance_and_then_its_rate() {
        let rates = rates(100, 0);
        let (source, begin) = (rates.source(address(1)), rates.epoch + Duration::from_secs(5));
        for _ in 0..100 {
            assert_eq!(rates.wait(&source, true, begin), None);
            rates.charge(&source, ONE, begin);
        }
        assert_eq!(rates.wait(&source, true, begin), None);
        rates.charge(&source, ONE, begin);
        let wait = Duration::from_millis(10);
        assert_eq!(rates.wait(&source, true, begin), Some((wait, Excess::Requests)));
        assert_eq!(rates.wait(&source, true, begin + wait), None);
        rates.charge(&source, ONE, begin + wait);
        assert_eq!(rates.wait(&source, true, begin + wait), Some((wait, Excess::Requests)));
    }

    #[test]
    fn writes_have_a_limit_of_their_own() {
        let rates = rates(0, 10);
        let (source, begin) = (rates.source(address(1)), rates.epoch);
        rates.charge(&source, Charge { requests: 9999, writes: 10 }, begin);
        assert_eq!(rates.wait(&source, true, begin), None);
        rates.charge(&source, Charge { requests: 1, writes: 1 }, begin);
        let wait = Duration::from_millis(100);
        assert_eq!(rates.wait(&source, true, begin), Some((wait, Excess::Writes)));
        assert_eq!(rates.wait(&source, false, begin), None);
    }

    #[test]
    fn connections_of_a_source_share_its_account_and_sources_share_none() {
        let rates = rates(1, 0);
        let begin = rates.epoch;
        rates.charge(&rates.source(address(1)), Charge { requests: 3, writes: 0 }, begin);
        let again = rates.source("::ffff:192.0.2.1".parse().unwrap());
        assert!(rates.wait(&again, true, begin).is_some(), "it outlives its connections");
        assert!(rates.wait(&rates.source(address(2)), true, begin).is_none());
    }

    #[test]
    fn no_source_waits_for_a_limit_that_does_not_apply_any_more() {
        let rates = rates(1, 1);
        let (source, begin) = (rates.source(address(1)), rates.epoch);
        rates.charge(&source, Charge { requests: 1000, writes: 1000 }, begin);
        rates.set_limits(RateLimits { requests: 1, writes: 1 });
        assert!(rates.wait(&source, true, begin).is_some(), "nothing has changed");
        rates.set_limits(RateLimits { requests: 2, writes: 1 });
        assert_eq!(rates.wait(&source, true, begin), None);
        rates.set_limits(RateLimits::default());
        rates.charge(&source, Charge { requests: 1000, writes: 1000 }, begin);
        assert_eq!(rates.wait(&source, true, begin), None);
    }

    #[test]
    fn idle_sources_are_forgotten_and_those_that_wait_are_not() {
        let rates = rates(1, 0);
        let waiting = rates.source(address(255));
        let long = Charge { requests: 4_000_000, writes: 0 };
        rates.charge(&waiting, long, Instant::now());
        drop(waiting);
        for number in 0..10_000_u32 {
            let source = rates.source(IpAddr::from(number.to_be_bytes()));
            assert_eq!(source.requests.load(Ordering::Relaxed), 0);
        }
        assert!(rates.sources().known.len() <= 2 * FEW_SOURCES);
        assert!(rates.wait(&rates.source(address(255)), true, Instant::now()).is_some());
    }

    #[test]
    fn forged_senders_do_not_fill_the_memory() {
        let rates = rates(1, 0);
        for number in 0..3 * MAX_SENDERS as u32 {
            let _ = rates.admit(IpAddr::from(number.to_be_bytes()), false);
        }
        assert!(rates.sources().known.len() <= MAX_SENDERS);
        assert!(rates.counters.dropped.requests.get() > 0, "further ones share one limit");
    }

    #[test]
    fn a_source_is_reported_at_most_once_a_minute() {
        let rates = rates(1, 0);
        let (source, begin) = (rates.source(address(1)), rates.epoch + Duration::from_secs(9));
        let reported = [0, 1, 59, 60, 61].map(|second| {
            rates.note_pause(&source, Excess::Requests, begin + Duration::from_secs(second))
        });
        assert_eq!(reported, [true, false, false, true, false]);
        assert_eq!(rates.counters.paused.requests.get(), 5);
    }
}
