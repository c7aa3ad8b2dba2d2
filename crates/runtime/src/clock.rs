//! A clock that goes on while the machine is suspended: after that, what was current before is old.

use std::time::{Duration, Instant};

/// A moment, such as the zero of the clock of a connection.
#[derive(Debug, Clone, Copy)]
pub struct Epoch(Duration);

impl Epoch {
    pub fn now() -> Epoch {
        Epoch(suspend_aware_time())
    }

    pub fn elapsed(self) -> Duration {
        suspend_aware_time().saturating_sub(self.0)
    }

    /// The moment this long after it, for what waits. It is now if that has passed.
    pub fn at(self, time: Duration) -> Instant {
        let left = time.saturating_sub(self.elapsed());
        // Read last: who waits until then finds that the time has come.
        Instant::now() + left
    }
}

/// The time since some moment, which stays the same while the process runs: only differences mean something. It goes on
/// during a suspend. [`Instant`] stands still then on Linux and macOS.
#[cfg(any(target_os = "linux", target_os = "android", target_vendor = "apple"))]
pub fn suspend_aware_time() -> Duration {
    use rustix::time::{ClockId, clock_gettime};
    #[cfg(target_vendor = "apple")]
    let now = clock_gettime(ClockId::Monotonic);
    #[cfg(not(target_vendor = "apple"))]
    let now = clock_gettime(ClockId::Boottime);
    let seconds = u64::try_from(now.tv_sec).unwrap_or_default();
    Duration::new(seconds, u32::try_from(now.tv_nsec).unwrap_or_default())
}

/// The time since some moment, which stays the same while the process runs: only differences mean something. It goes on
/// during a suspend, as [`Instant`] does on Windows.
#[cfg(not(any(target_os = "linux", target_os = "android", target_vendor = "apple")))]
pub fn suspend_aware_time() -> Duration {
    use std::sync::LazyLock;
    static FIRST_CALL: LazyLock<Instant> = LazyLock::new(Instant::now);
    FIRST_CALL.elapsed()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_waits_until_a_time_finds_that_it_has_come() {
        let epoch = Epoch::now();
        let time = epoch.elapsed() + Duration::from_millis(1);
        let until = epoch.at(time);
        while Instant::now() < until {}
        assert!(epoch.elapsed() >= time);
        assert!(epoch.at(Duration::ZERO) <= Instant::now());
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn on_linux_the_clock_counts_the_time_since_the_machine_was_started() {
        let uptime = || {
            let text = std::fs::read_to_string("/proc/uptime").unwrap();
            Duration::from_secs_f64(text.split(' ').next().unwrap().parse().unwrap())
        };
        let (before, now, after) = (uptime(), suspend_aware_time(), uptime());
        let hundredth = Duration::from_millis(10);
        assert!(before <= now && now <= after + hundredth, "{before:?} {now:?} {after:?}");
    }
}
