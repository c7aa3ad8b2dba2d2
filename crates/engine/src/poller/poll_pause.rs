//! When a device that does not answer is polled again: after the third poll without an answer, the pauses
//! double, until it answers. How long they are is in `holdfast_runtime::Retry`. While its address cannot be reached, the
//! link decides.

use std::cell::Cell;

use holdfast_runtime::Retry;
use tokio::time::Instant;

/// The number of consecutive polls without an answer after which a unit counts as dead.
const DEAD_AFTER_POLLS: u32 = 3;

#[derive(Default)]
pub(super) struct PollPause {
    /// Consecutive ones.
    count: Cell<u32>,
    /// Whether the next poll is delayed because the device does not answer.
    is_delaying: Cell<bool>,
}

impl PollPause {
    /// A poll has ended, with or without an answer.
    pub(super) fn note(&self, was_silent: bool) {
        let unanswered = if was_silent { self.count.get().saturating_add(1) } else { 0 };
        self.count.set(unanswered);
    }

    /// Whether the last poll had no answer.
    pub(super) fn is_doubtful(&self) -> bool {
        self.count.get() > 0
    }

    /// Until when the device is left alone after a poll, if it is. `address_retry` is when an address that
    /// cannot be reached is tried again.
    pub(super) fn after_poll(
        &self,
        address_retry: Option<Instant>,
        retry: Retry,
    ) -> Option<Instant> {
        let until = address_retry.or_else(|| {
            let earlier_pauses = self.count.get().checked_sub(DEAD_AFTER_POLLS)?;
            Some(Instant::now() + retry.pause(earlier_pauses + 1))
        });
        self.is_delaying.set(until.is_some());
        until
    }

    /// Whether the next poll is delayed because the device does not answer.
    pub(super) fn is_delaying(&self) -> bool {
        self.is_delaying.get()
    }

    /// The device has answered, or another node has polled it meanwhile.
    pub(super) fn end(&self) {
        self.count.set(0);
        self.is_delaying.set(false);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn pauses_begin_with_the_third_poll_without_an_answer_and_double() {
        let (first, most) = (Duration::from_secs(1), Duration::from_secs(4));
        let retry = Retry { first, most, jitter: false };
        let polls = PollPause::default();
        let pauses = [false, true, true, true, true, true, true].map(|was_silent| {
            polls.note(was_silent);
            let until = polls.after_poll(None, retry);
            assert_eq!((polls.is_delaying(), polls.is_doubtful()), (until.is_some(), was_silent));
            // The time between the two looks at the clock is missing.
            until.map_or(0, |until| (until - Instant::now()).as_secs_f64().ceil() as u64)
        });
        assert_eq!(pauses, [0, 0, 0, 1, 2, 4, 4]);
        polls.note(false);
        assert_eq!(polls.after_poll(None, retry), None);
        let unreachable_until = Instant::now() + most;
        assert_eq!(polls.after_poll(Some(unreachable_until), retry), Some(unreachable_until));
        assert!(polls.is_delaying() && !polls.is_doubtful());
    }
}
