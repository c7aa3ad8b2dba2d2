//! Whether a write waited while its thread stood still: the process was stopped, the machine suspended, or there was
//! no processor for it. Its client may have given up meanwhile, and sent another one; what it says about that is
//! noticed by other threads, perhaps too late.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_protocol::client::MAX_READ_DELAY;
use holdfast_runtime::{lock, suspend_aware_time};
use tokio::time::{MissedTickBehavior, interval};

use super::permit::Wanted;

/// The time between two looks at the clock, while the thread runs.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);

thread_local! {
    static OWN: Arc<Standstills> = Arc::new(Standstills::from(suspend_aware_time()));
}

/// Detects standstills of this thread, for ever.
pub(crate) async fn watch() {
    let own = OWN.with(Arc::clone);
    let mut ticks = interval(LOOK_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        own.look(suspend_aware_time());
    }
}

/// Whether this thread, which must [`watch`], has run since a write was `queued`, by [`suspend_aware_time`]. A device that
/// is slow holds up no thread.
pub(crate) fn none_since(queued: Duration) -> Wanted {
    let own = OWN.with(Arc::clone);
    Arc::new(move |_| !own.held_up(queued, suspend_aware_time()))
}

#[derive(Debug)]
struct Standstills(Mutex<Looks>);

#[derive(Debug)]
struct Looks {
    last: Duration,
    /// The looks before and after the last standstill.
    around: (Duration, Duration),
}

impl Standstills {
    fn from(now: Duration) -> Standstills {
        Standstills(Mutex::new(Looks { last: now, around: (now, now) }))
    }

    fn look(&self, now: Duration) {
        let mut looks = lock(&self.0);
        if is_standstill(looks.last, now) {
            looks.around = (looks.last, now);
        }
        looks.last = now;
    }

    /// Whether a standstill has held up a write for as long as makes a reply late.
    fn held_up(&self, queued: Duration, now: Duration) -> bool {
        let Looks { last, around } = *lock(&self.0);
        // The thread may go on with the write before it looks.
        [around, (last, now)].into_iter().any(|(before, after)| {
            is_standstill(before, after)
                && after.saturating_sub(queued.max(before)) > MAX_READ_DELAY
        })
    }
}

fn is_standstill(before: Duration, after: Duration) -> bool {
    after.saturating_sub(before) > LOOK_INTERVAL + MAX_READ_DELAY
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEGAN: Duration = Duration::from_secs(100);
    const MS: Duration = Duration::from_millis(1);

    /// A thread that has run for 10 s.
    fn running() -> (Standstills, Duration) {
        let standstills = Standstills::from(BEGAN);
        let mut now = BEGAN;
        for _ in 0..40 {
            now += LOOK_INTERVAL;
            standstills.look(now);
        }
        (standstills, now)
    }

    #[test]
    fn a_write_that_waits_for_a_slow_device_was_not_held_up() {
        let (standstills, now) = running();
        assert!(!standstills.held_up(BEGAN, now));
        standstills.look(now + MAX_READ_DELAY);
        assert!(!standstills.held_up(BEGAN, now + MAX_READ_DELAY), "a busy machine");
    }

    #[test]
    fn a_write_that_waits_through_a_standstill_was_held_up_also_before_the_thread_looks() {
        let (standstills, stopped) = running();
        let goes_on = stopped + LOOK_INTERVAL + MAX_READ_DELAY + MS;
        for looked in [false, true] {
            for (queued, expected) in [(BEGAN, true), (stopped, true), (goes_on - MS, false)] {
                assert_eq!(standstills.held_up(queued, goes_on), expected, "{looked} {queued:?}");
            }
            standstills.look(goes_on);
        }
        let later = goes_on + LOOK_INTERVAL;
        standstills.look(later);
        assert!(standstills.held_up(BEGAN, later));
        assert!(!standstills.held_up(goes_on, later), "it came after the standstill");
    }
}
