//! Pauses for a device that floods its link with unsolicited data.
//!
//! A connection in a stream ends with the first bytes that belong to no request, so a device can cost one
//! connection and one read of the socket for each poll. A flood is more than a faulty device sends. Over UDP,
//! a number of datagrams is one too (`MAX_STRAY_DATAGRAMS` in `holdfast_protocol::client`).

use std::cell::Cell;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use holdfast_runtime::Retry;

use crate::client::StrayCounters;

/// Unsolicited bytes that are tolerated at once.
const TOLERATED_BYTES: u64 = 64 * 1024;

/// The time in which `TOLERATED_BYTES` decay.
const DECAY_TIME: Duration = Duration::from_secs(10);

/// Unsolicited bytes of a link.
#[derive(Debug)]
pub(in crate::link) struct Flood {
    counters: Arc<StrayCounters>,
    retry: Retry,
    /// The decaying byte count, and when it was last updated.
    level: Cell<(u64, Instant)>,
    /// The bytes that the counters had then.
    counted: Cell<u64>,
    /// Consecutive floods, and when the last one began.
    floods: Cell<(u32, Option<Instant>)>,
}

impl Flood {
    pub(in crate::link) fn new(counters: Arc<StrayCounters>, retry: Retry) -> Flood {
        let counted = Cell::new(counters.bytes.get());
        let level = Cell::new((0, Instant::now()));
        Flood { counters, retry, level, counted, floods: Cell::default() }
    }

    /// Looks at what was counted since the last call. If the device has sent too much, returns when the
    /// next request may be sent.
    pub(in crate::link) fn until(&self, now: Instant) -> Option<Instant> {
        let counted = self.counters.bytes.get();
        let new = counted - self.counted.replace(counted);
        if new == 0 {
            return None;
        }
        let (level, at) = self.level.get();
        let decayed = TOLERATED_BYTES as f64 * (now - at).div_duration_f64(DECAY_TIME);
        let level = level.saturating_sub(decayed as u64) + new;
        // Capped: the count decays within `DECAY_TIME` after any flood.
        self.level.set((level.min(TOLERATED_BYTES), now));
        if level <= TOLERATED_BYTES {
            return None;
        }
        let (floods, last) = self.floods.get();
        // Consecutive: within twice the longest pause, and the time to decay.
        let is_again = last.is_some_and(|last| now - last <= 2 * self.retry.most + DECAY_TIME);
        let floods = if is_again { floods.saturating_add(1) } else { 1 };
        self.floods.set((floods, Some(now)));
        self.counters.floods.add();
        Some(now + self.retry.pause(floods))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flood() -> (Flood, Arc<StrayCounters>) {
        let counters = Arc::new(StrayCounters::default());
        (Flood::new(Arc::clone(&counters), Retry::default()), counters)
    }

    #[test]
    fn a_device_with_a_stray_reply_for_each_request_is_no_flood() {
        let (flood, counters) = flood();
        let mut now = Instant::now();
        for _ in 0..1000 {
            counters.bytes.add_many(260);
            now += Duration::from_millis(100);
            assert_eq!(flood.until(now), None);
        }
        assert_eq!(counters.floods.get(), 0);
    }

    #[test]
    fn pauses_between_floods_grow_up_to_the_longest_and_begin_anew_after_a_while() {
        let (flood, counters) = flood();
        let mut now = Instant::now();
        let mut pauses = Vec::new();
        for _ in 0..8 {
            let until = loop {
                counters.bytes.add_many(16 * 1024);
                if let Some(until) = flood.until(now) {
                    break until;
                }
                assert_eq!(flood.until(now), None, "it is counted once");
            };
            pauses.push((until - now).as_secs_f64());
            now = until;
        }
        for (pause, most) in pauses.iter().zip([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]) {
            assert!((0.75 * most..=most).contains(pause), "{pauses:?}");
        }
        assert_eq!(counters.floods.get(), 8);
        now += Duration::from_secs(600);
        counters.bytes.add_many(TOLERATED_BYTES + 1);
        assert!(flood.until(now).unwrap() - now <= Duration::from_secs(1));
    }
}
