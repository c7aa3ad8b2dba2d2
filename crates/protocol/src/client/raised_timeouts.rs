//! How late the replies of each unit are, and how much longer its requests wait for them then.

use alloc::collections::BTreeMap;
use core::time::Duration;

/// Late replies after which the timeout of a unit is raised.
const RAISE_AFTER_LATE_REPLIES: u8 = 2;

/// A raised timeout is at most this many times the timeout.
pub(super) const MAX_RAISED_FACTOR: u32 = 4;

/// Replies within the timeout after which it is no longer raised.
const RESET_AFTER_TIMELY_REPLIES: u8 = 32;

/// How late the replies of all units are.
#[derive(Debug, Default)]
pub(super) struct Lateness {
    units: BTreeMap<u8, Unit>,
}

/// How long a unit takes.
#[derive(Debug, Default)]
struct Unit {
    /// The longest time of a reply that was not late.
    longest: Duration,
    /// The longest time of a late reply.
    latest: Duration,
    /// Late replies since the last of [`RESET_AFTER_TIMELY_REPLIES`] that were not.
    late: u8,
    in_time: u8,
    /// The longest timeout of its requests meanwhile, and of those before.
    timeout: Duration,
    former_timeout: Duration,
}

impl Unit {
    /// How long it may take by the timeouts of its requests. One of them may have had little time.
    fn note_timeout(&mut self, timeout: Duration) -> Duration {
        self.timeout = self.timeout.max(timeout);
        self.timeout.max(self.former_timeout)
    }
}

impl Lateness {
    /// The timeout of a request to this unit: more than `timeout` if late replies repeat.
    pub(super) fn timeout(&self, unit_id: u8, timeout: Duration) -> Duration {
        match self.units.get(&unit_id) {
            Some(unit) if unit.late >= RAISE_AFTER_LATE_REPLIES => {
                // Half as long again as the latest reply, so that the next one is most likely in time.
                timeout.max((unit.latest * 3 / 2).min(timeout * MAX_RAISED_FACTOR))
            }
            _ => timeout,
        }
    }

    /// Notes the timeout of a request. Returns the longest one of the unit's last requests.
    pub(super) fn note_timeout(&mut self, unit_id: u8, timeout: Duration) -> Duration {
        self.units.entry(unit_id).or_default().note_timeout(timeout)
    }

    /// The longest time of a reply of this unit that was not late; `None` if there was none.
    pub(super) fn longest(&self, unit_id: u8) -> Option<Duration> {
        self.units.get(&unit_id).map(|unit| unit.longest).filter(|longest| !longest.is_zero())
    }

    /// The longest time of a late reply of this unit.
    pub(super) fn latest(&self, unit_id: u8) -> Duration {
        self.units.get(&unit_id).map_or(Duration::ZERO, |unit| unit.latest)
    }

    /// Notes a late reply, which took this time.
    pub(super) fn late(&mut self, unit_id: u8, took: Duration) {
        let unit = self.units.entry(unit_id).or_default();
        unit.latest = unit.latest.max(took);
        unit.late = unit.late.saturating_add(1);
        unit.in_time = 0;
    }

    /// Notes a reply that was asked for, and took this time.
    pub(super) fn answered(&mut self, unit_id: u8, took: Duration, timeout: Duration) {
        let unit = self.units.entry(unit_id).or_default();
        unit.note_timeout(timeout);
        unit.longest = unit.longest.max(took.min(timeout));
        if took > timeout {
            unit.in_time = 0;
            unit.latest = unit.latest.max(took);
            return;
        }
        unit.in_time += 1;
        if unit.in_time == RESET_AFTER_TIMELY_REPLIES {
            let former_timeout = unit.timeout;
            *unit = Unit { longest: took, former_timeout, ..Unit::default() };
        }
    }
}
