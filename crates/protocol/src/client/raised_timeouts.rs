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

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(times: u64) -> Duration {
        Duration::from_millis(times)
    }

    #[test]
    fn a_timeout_is_half_as_long_again_as_the_latest_of_two_late_replies() {
        let mut lateness = Lateness::default();
        lateness.late(1, ms(200));
        assert_eq!(lateness.timeout(1, ms(180)), ms(180), "one is no habit");
        lateness.late(1, ms(190));
        assert_eq!(lateness.timeout(1, ms(180)), ms(300));
        assert_eq!(lateness.timeout(1, ms(400)), ms(400), "it is never shorter");
        assert_eq!(lateness.timeout(1, ms(50)), ms(200), "four times as long at most");
        assert_eq!(lateness.timeout(2, ms(180)), ms(180));
    }

    #[test]
    fn thirty_two_replies_in_a_row_within_the_timeout_end_it() {
        let mut lateness = Lateness::default();
        (0..2).for_each(|_| lateness.late(1, ms(200)));
        (0..31).for_each(|_| lateness.answered(1, ms(100), ms(100)));
        lateness.answered(1, ms(220), ms(100));
        assert_eq!(lateness.timeout(1, ms(180)), ms(330), "they begin again");
        (0..31).for_each(|_| lateness.answered(1, ms(100), ms(100)));
        assert_eq!(lateness.timeout(1, ms(180)), ms(330));
        lateness.answered(1, ms(100), ms(100));
        assert_eq!(lateness.timeout(1, ms(180)), ms(180));
        assert_eq!((lateness.longest(1), lateness.latest(1)), (Some(ms(100)), ms(0)));
    }

    #[test]
    fn the_longest_reply_and_timeout_of_a_unit_are_known() {
        let mut lateness = Lateness::default();
        assert_eq!((lateness.longest(1), lateness.latest(1)), (None, ms(0)));
        lateness.answered(1, ms(30), ms(100));
        lateness.answered(1, ms(20), ms(50));
        assert_eq!((lateness.longest(1), lateness.latest(1)), (Some(ms(30)), ms(0)));
        lateness.answered(1, ms(150), ms(100));
        assert_eq!((lateness.longest(1), lateness.latest(1)), (Some(ms(100)), ms(150)));
        assert_eq!(lateness.note_timeout(1, ms(10)), ms(100));
        (0..32).for_each(|_| lateness.answered(1, ms(1), ms(10)));
        assert_eq!(lateness.note_timeout(1, ms(10)), ms(100), "that of before counts");
        (0..32).for_each(|_| lateness.answered(1, ms(1), ms(10)));
        assert_eq!(lateness.note_timeout(1, ms(10)), ms(10));
    }
}
