//! The age of values that are read from a device. Each reader compares the time, so values become stale
//! even if the poller hangs.
//!
//! What renews an age must know whose values they are: a range may have those of another device until a reload
//! has reached the poller. So the device that has an age in its [`Destination`](super::Destination)
//! renews it, and on other nodes the lease of the device does.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use holdfast_memory::Freshness;

/// The time since some moment. It goes on while the machine is suspended: values from before are old.
pub type Clock = fn() -> Duration;

/// The age of the values of a range. They are stale from the start, until a device was read.
#[derive(Debug)]
pub struct MirrorAge {
    clock: Clock,
    /// Since when the range is read from its device.
    began: Duration,
    /// The number of the lease of the device, if several nodes share the memory.
    lease: Option<u64>,
    /// The time of the last values; 0 if there are none yet.
    renewed_ns: AtomicU64,
    stale_after_ns: AtomicU64,
    refuses: AtomicBool,
}

impl MirrorAge {
    /// Values are stale after this time. Stale values are refused, or only shown as stale.
    pub fn new(
        clock: Clock,
        stale_after: Duration,
        refuses: bool,
        lease: Option<u64>,
    ) -> MirrorAge {
        MirrorAge {
            clock,
            began: clock(),
            lease,
            renewed_ns: AtomicU64::new(0),
            stale_after_ns: AtomicU64::new(nanos(stale_after)),
            refuses: AtomicBool::new(refuses),
        }
    }

    /// Changes the settings. The age of the values stays.
    pub fn set(&self, stale_after: Duration, refuses: bool) {
        self.stale_after_ns.store(nanos(stale_after), Ordering::Relaxed);
        self.refuses.store(refuses, Ordering::Relaxed);
    }

    /// The time of its clock.
    pub(super) fn now(&self) -> Duration {
        (self.clock)()
    }

    /// The range has values that its device has sent at this time of [`now`](MirrorAge::now), or later.
    pub(super) fn renew_since(&self, time: Duration) {
        // Values that are written later are no older, also if less is known of their age.
        self.renewed_ns.fetch_max(nanos(time).max(1), Ordering::Relaxed);
    }

    /// The age of the last values, if there are any.
    pub fn age(&self) -> Option<Duration> {
        let renewed =
            Some(self.renewed_ns.load(Ordering::Relaxed)).filter(|renewed| *renewed > 0)?;
        Some(self.now().saturating_sub(Duration::from_nanos(renewed)))
    }

    /// For how long the values have been stale; `None` if they are not.
    pub fn stale_for(&self) -> Option<Duration> {
        let stale_after = Duration::from_nanos(self.stale_after_ns.load(Ordering::Relaxed));
        match self.age() {
            None => Some(self.now().saturating_sub(self.began)),
            Some(age) => age.checked_sub(stale_after),
        }
    }
}

impl Freshness for MirrorAge {
    fn renew(&self, age: Duration, lease: Option<u64>) {
        // A node that is not reloaded yet may read another device into the range.
        if lease.is_some() && self.lease == lease {
            self.renew_since(self.now().saturating_sub(age));
        }
    }

    fn must_refuse(&self) -> bool {
        self.refuses.load(Ordering::Relaxed) && self.stale_for().is_some()
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    thread_local! {
        static NOW: Cell<u64> = const { Cell::new(100) };
    }

    fn pass(seconds: u64) {
        NOW.set(NOW.get() + seconds);
    }

    const LEASE: u64 = 7;

    fn of(refuses: bool) -> MirrorAge {
        let clock = || Duration::from_secs(NOW.get());
        MirrorAge::new(clock, Duration::from_secs(10), refuses, Some(LEASE))
    }

    #[test]
    fn values_are_stale_before_the_first_read_and_after_a_time_without_one() {
        let age = of(true);
        pass(3);
        assert_eq!((age.age(), age.stale_for()), (None, Some(Duration::from_secs(3))));
        assert!(age.must_refuse());
        age.renew_since(age.now());
        assert_eq!((age.age(), age.stale_for()), (Some(Duration::ZERO), None));
        pass(9);
        assert!(!age.must_refuse());
        pass(1);
        assert_eq!(age.stale_for(), Some(Duration::ZERO));
        assert!(age.must_refuse());
        age.set(Duration::from_secs(11), true);
        assert!(!age.must_refuse());
        pass(60);
        assert!(age.must_refuse());
        age.renew_since(age.now());
        assert!(!age.must_refuse());
    }

    #[test]
    fn values_are_as_old_as_they_were_when_they_came() {
        let age = of(true);
        pass(8);
        age.renew(Duration::from_secs(8), Some(LEASE));
        assert_eq!((age.age(), age.must_refuse()), (Some(Duration::from_secs(8)), false));
        pass(2);
        assert!(age.must_refuse());
        age.renew_since(age.now() - Duration::from_secs(3));
        age.renew(Duration::from_secs(9), Some(LEASE));
        assert_eq!(age.age(), Some(Duration::from_secs(3)), "later values are no older");
    }

    #[test]
    fn values_of_another_device_are_not_fresh() {
        let age = of(true);
        age.renew(Duration::ZERO, Some(LEASE + 1));
        assert!(age.must_refuse(), "another node reads another device into the range");
        age.renew(Duration::ZERO, None);
        assert!(age.must_refuse(), "they may be of the device before this one");
        age.renew(Duration::from_secs(4), Some(LEASE));
        assert!(!age.must_refuse(), "a node that follows knows only how old they are at most");
    }

    #[test]
    fn values_that_are_kept_are_shown_as_stale_and_not_refused() {
        let age = of(false);
        assert!(!age.must_refuse());
        assert!(age.stale_for().is_some());
        age.set(Duration::from_secs(10), true);
        assert!(age.must_refuse());
    }
}
