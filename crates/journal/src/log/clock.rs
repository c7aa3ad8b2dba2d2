//! The clock that tells how long ago the contents were current. It goes on while the machine is
//! suspended: after that, what was current before is old.

use std::time::Duration;

#[derive(Debug, Clone, Default)]
pub(super) enum Clock {
    #[default]
    Machine,
    #[cfg(test)]
    Test(std::sync::Arc<std::sync::Mutex<Duration>>),
}

/// A time of the clock: nanoseconds since a moment before the process began. Never 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Moment(u64);

impl Clock {
    pub(super) fn now(&self) -> Moment {
        let now = match self {
            Clock::Machine => time_since_boot(),
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

/// The time since the machine was started. [`std::time::Instant`] stands still during a suspend on Linux
/// and macOS.
#[cfg(any(target_os = "linux", target_os = "android", target_vendor = "apple"))]
pub fn time_since_boot() -> Duration {
    use rustix::time::{ClockId, clock_gettime};
    #[cfg(target_vendor = "apple")]
    let now = clock_gettime(ClockId::Monotonic);
    #[cfg(not(target_vendor = "apple"))]
    let now = clock_gettime(ClockId::Boottime);
    let seconds = u64::try_from(now.tv_sec).unwrap_or_default();
    Duration::new(seconds, u32::try_from(now.tv_nsec).unwrap_or_default())
}

/// The time since the process began. On Windows, [`std::time::Instant`] goes on during a suspend.
#[cfg(not(any(target_os = "linux", target_os = "android", target_vendor = "apple")))]
pub fn time_since_boot() -> Duration {
    use std::sync::LazyLock;
    use std::time::Instant;
    static BEGAN: LazyLock<Instant> = LazyLock::new(Instant::now);
    BEGAN.elapsed()
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

    #[test]
    #[cfg(target_os = "linux")]
    fn the_clock_counts_the_time_since_the_machine_was_started() {
        let uptime = || {
            let text = std::fs::read_to_string("/proc/uptime").unwrap();
            Duration::from_secs_f64(text.split(' ').next().unwrap().parse().unwrap())
        };
        let (before, now, after) = (uptime(), time_since_boot(), uptime());
        let hundredth = Duration::from_millis(10);
        assert!(before <= now && now <= after + hundredth, "{before:?} {now:?} {after:?}");
    }
}
