//! The clock that tells how long ago the contents were current. It goes on while the machine is
//! suspended: after that, what was current before is old.

use std::time::Duration;

use holdfast_runtime::suspend_aware_time;

#[derive(Debug, Clone, Default)]
pub(super) enum Clock {
    #[default]
    Machine,
    #[cfg(test)]
    Test(std::sync::Arc<std::sync::Mutex<Duration>>),
}

/// A time of the clock: nanoseconds since an arbitrary moment, so only differences mean something. Never 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Moment(u64);

impl Clock {
    pub(super) fn now(&self) -> Moment {
        let now = match self {
            Clock::Machine => suspend_aware_time(),
            #[cfg(test)]
            Clock::Test(now) => *now.lock().unwrap(),
        };
        Moment(u64::try_from(now.as_nanos()).unwrap_or(u64::MAX).max(1))
    }
}

impl Moment {
    pub(super) const fn as_nanos(self) -> u64 {
        self.0
    }

    /// The moment of these nanoseconds; `None` for 0.
    pub(super) const fn from_nanos(nanos: u64) -> Option<Moment> {
        if nanos == 0 { None } else { Some(Moment(nanos)) }
    }

    pub(super) const fn since(self, earlier: Moment) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_of_the_machine_goes_on() {
        let clock = Clock::default();
        let before = clock.now();
        while clock.now() == before {}
        assert!(clock.now() > before);
        assert_eq!(before.since(clock.now()), Duration::ZERO);
    }
}
