//! Pauses after failures: 1 s, doubled with each failure up to a limit, and randomized.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

const FIRST: Duration = Duration::from_secs(1);

/// The longest pause before a device is asked again.
pub(crate) const MAX_PAUSE: Duration = Duration::from_secs(60);

/// The pause after `failures` consecutive failures, at least one. It is up to a quarter shorter at
/// random, so that devices that failed together are not retried together.
pub(crate) fn pause(failures: u32, longest: Duration) -> Duration {
    let doubled = FIRST.saturating_mul(1u32 << failures.saturating_sub(1).min(6)).min(longest);
    // The keys of a hasher are random, which suffices here.
    let chance = RandomState::new().hash_one(failures) as u32;
    doubled.mul_f64(1.0 - 0.25 * f64::from(chance) / f64::from(u32::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_a_limit() {
        for (failures, most) in [(1, 1), (2, 2), (3, 4), (6, 32), (7, 60), (8, 60), (4000, 60)] {
            let most = Duration::from_secs(most);
            let found = pause(failures, MAX_PAUSE);
            assert!(found <= most && found >= most.mul_f64(0.75), "{failures}: {found:?}");
        }
    }
}
