//! Pauses after failures: doubled with each failure up to a limit, and usually randomized.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// How long to wait before a failed device or server is retried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retry {
    /// The pause after the first failure.
    pub first: Duration,
    /// The longest pause.
    pub most: Duration,
    /// Whether each pause is up to a quarter shorter at random, so that what failed together is not
    /// retried together.
    pub jitter: bool,
}

impl Default for Retry {
    fn default() -> Retry {
        Retry { first: Duration::from_secs(1), most: Duration::from_secs(60), jitter: true }
    }
}

impl Retry {
    /// The same, with no pause longer than `most`.
    #[must_use]
    pub fn up_to(self, most: Duration) -> Retry {
        Retry { most: self.most.min(most), ..self }
    }

    /// The pause after `failures` consecutive failures, at least one.
    #[must_use]
    pub fn pause(self, failures: u32) -> Duration {
        let doubled = self.first.saturating_mul(1 << failures.saturating_sub(1).min(31));
        let pause = doubled.min(self.most);
        if !self.jitter {
            return pause;
        }
        // The keys of a hasher are random, which suffices here.
        let chance = RandomState::new().hash_one(failures) as u32;
        pause.mul_f64(1.0 - 0.25 * f64::from(chance) / f64::from(u32::MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(retry: Retry, failures: u32, most: Duration) {
        let found = retry.pause(failures);
        assert!(found <= most && found >= most.mul_f64(0.75), "{failures}: {found:?}");
    }

    #[test]
    fn pauses_double_up_to_a_limit() {
        for (failures, most) in [(1, 1), (2, 2), (3, 4), (6, 32), (7, 60), (8, 60), (4000, 60)] {
            check(Retry::default(), failures, Duration::from_secs(most));
        }
        let most = Duration::from_secs(3600);
        let quick = Retry { first: Duration::from_millis(50), most, jitter: true };
        for (failures, most) in [(1, 50), (5, 800), (13, 204_800), (32, 3_600_000)] {
            check(quick, failures, Duration::from_millis(most));
            check(quick.up_to(quick.first), failures, quick.first);
        }
    }

    #[test]
    fn pauses_without_jitter_are_exact() {
        let retry = Retry { first: Duration::from_secs(2), jitter: false, ..Retry::default() };
        let seconds: Vec<u64> = (1..9).map(|failures| retry.pause(failures).as_secs()).collect();
        assert_eq!(seconds, [2, 4, 8, 16, 32, 60, 60, 60]);
        assert_eq!(retry.pause(3), Duration::from_secs(8));
    }
}
