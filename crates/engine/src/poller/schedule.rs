//! When a device is polled: at whole intervals from the start, without drift. A poll that cannot begin in
//! time is skipped and counted. On demand, one poll comes outside the schedule.

use std::cell::Cell;
use std::time::Duration;

use tokio::time::Instant;

/// The shortest interval between polls outside the schedule, unless the interval of the device is
/// shorter.
const OFF_SCHEDULE_INTERVAL: Duration = Duration::from_secs(1);

pub(super) struct Schedule {
    interval: Duration,
    /// The due time of the next poll.
    due: Cell<Instant>,
    /// The due time of a poll outside the schedule, and the time of the last one.
    off_schedule: Cell<Option<Instant>>,
    last_off_schedule: Cell<Option<Instant>>,
}

impl Schedule {
    pub(super) fn new(interval: Duration) -> Schedule {
        let (due, off_schedule) = (Cell::new(Instant::now()), Cell::new(None));
        Schedule { interval, due, off_schedule, last_off_schedule: Cell::new(None) }
    }

    /// The next poll is due then, and the following ones from there.
    pub(super) fn begin_at(&self, due: Instant) {
        self.due.set(due);
    }

    /// The next poll is due at once. A request for one outside the schedule is served by it.
    pub(super) fn begin_now(&self) {
        self.off_schedule.set(None);
        self.due.set(Instant::now());
    }

    /// Requests a poll soon, outside the schedule.
    pub(super) fn want_soon(&self) {
        self.off_schedule.set(Some(Instant::now()));
    }

    /// Whether a poll outside the schedule was requested and has not begun.
    pub(super) fn is_wanted_soon(&self) -> bool {
        self.off_schedule.get().is_some()
    }

    /// When the next poll begins.
    pub(super) fn next(&self) -> Instant {
        let due = self.due.get();
        self.off_schedule.get().map_or(due, |off_schedule| off_schedule.min(due))
    }

    /// The poll that was next begins. Returns when it was due; outside the schedule, that is now.
    pub(super) fn begin_poll(&self) -> Instant {
        let (due, next) = (self.due.get(), self.next());
        self.off_schedule.set(None);
        if next < due {
            let now = Instant::now();
            self.last_off_schedule.set(Some(now));
            return now;
        }
        self.due.set(due + self.interval);
        due
    }

    /// Skips the polls that were due before this time. Returns their number.
    pub(super) fn skip_until(&self, time: Instant) -> u64 {
        let (due, skipped) = first_from(time, self.due.get(), self.interval);
        self.due.set(due);
        skipped
    }

    /// Goes on with the schedule of the device before. While that was left alone, this one is too.
    pub(super) fn take_over(&self, before: &Schedule, is_backing_off: bool) {
        self.last_off_schedule.set(before.last_off_schedule.get());
        if is_backing_off {
            self.off_schedule.set(None);
            return self.due.set(before.due.get());
        }
        let apart = self.interval.min(OFF_SCHEDULE_INTERVAL);
        let not_before = before.last_off_schedule.get().map(|last| last + apart);
        let wanted = self.off_schedule.get().or(before.off_schedule.get());
        let off_schedule = wanted.map(|wanted| not_before.map_or(wanted, |time| time.max(wanted)));
        self.off_schedule.set(off_schedule);
        self.due.set(before.due.get().min(Instant::now() + self.interval));
    }
}

/// The longest time over which the first polls of devices are spread.
const MAX_FIRST_POLL_SPREAD: Duration = Duration::from_secs(10);

/// Over which time the first polls of devices are spread, where no other is set (`start_within`).
pub fn first_poll_spread(interval: Duration) -> Duration {
    interval.min(MAX_FIRST_POLL_SPREAD)
}

/// When the device with this number is polled first, after the start: the golden ratio spreads any number
/// of devices evenly.
pub(super) fn first_poll(within: Duration, number: u32) -> Duration {
    within.mul_f64((f64::from(number) * 0.618_033_988_749_895).fract())
}

/// The first due time that is not before `now`, and the number of due times before it.
fn first_from(now: Instant, due: Instant, interval: Duration) -> (Instant, u64) {
    let late = now.saturating_duration_since(due).as_nanos();
    let passed = late.div_ceil(interval.as_nanos().max(1));
    let skipped = interval.as_nanos() * passed;
    (due + Duration::from_nanos(skipped as u64), if interval.is_zero() { 0 } else { passed as u64 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polls_stay_due_at_whole_intervals_after_missed_polls() {
        let (due, interval) = (Instant::now(), Duration::from_millis(100));
        let of = |now: u64| {
            let (next, missed) = first_from(due + Duration::from_millis(now), due, interval);
            ((next - due).as_millis(), missed)
        };
        assert_eq!(of(0), (0, 0));
        assert_eq!(of(1), (100, 1));
        assert_eq!(of(100), (100, 1));
        assert_eq!(of(101), (200, 2));
        assert_eq!(of(86_400_000), (86_400_000, 864_000));
        assert_eq!(first_from(due - interval, due, interval), (due, 0));
        assert_eq!(first_from(due + interval, due, Duration::ZERO), (due, 0));
    }

    #[test]
    fn a_poll_outside_the_schedule_leaves_it_and_the_next_one_keeps_a_distance() {
        let interval = Duration::from_secs(60);
        let (schedule, due) = (Schedule::new(interval), Instant::now() + interval);
        schedule.begin_at(due);
        schedule.want_soon();
        let last = schedule.begin_poll();
        assert!(last < due, "it comes before the next one of the schedule");
        assert_eq!((schedule.next(), schedule.begin_poll()), (due, due));
        assert_eq!(schedule.next(), due + interval);
        for (is_backing_off, expected) in
            [(false, last + OFF_SCHEDULE_INTERVAL), (true, due + interval)]
        {
            let successor = Schedule::new(interval);
            successor.want_soon();
            successor.take_over(&schedule, is_backing_off);
            assert_eq!(successor.next(), expected);
        }
    }
}
