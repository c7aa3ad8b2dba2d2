//! Whether the caller of a blocking call wants to end it early.

use std::thread;
use std::time::{Duration, Instant};

/// The longest wait between two looks at whether the caller is interrupted.
pub(super) const SIGNAL_CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Asks the caller every [`SIGNAL_CHECK_INTERVAL`] whether it is interrupted. Once it is, it remains so.
pub(super) struct Interrupt<'c> {
    check: Option<&'c mut dyn FnMut() -> bool>,
    next: Instant,
    hit: bool,
}

impl<'c> Interrupt<'c> {
    /// `check` is asked; `None` never ends a call.
    pub(super) fn new(check: Option<&'c mut dyn FnMut() -> bool>) -> Interrupt<'c> {
        Interrupt { check, next: Instant::now() + SIGNAL_CHECK_INTERVAL, hit: false }
    }

    pub(super) fn is_possible(&self) -> bool {
        self.check.is_some()
    }

    /// Whether the call ends.
    pub(super) fn is_hit(&mut self) -> bool {
        if let Some(check) = &mut self.check
            && !self.hit
            && Instant::now() >= self.next
        {
            self.hit = check();
            self.next = Instant::now() + SIGNAL_CHECK_INTERVAL;
        }
        self.hit
    }

    /// The end of the next wait that may last until `deadline`.
    pub(super) fn slice(&self, deadline: Instant) -> Instant {
        if self.is_possible() {
            deadline.min(Instant::now() + SIGNAL_CHECK_INTERVAL)
        } else {
            deadline
        }
    }

    /// Sleeps until then, or until the call ends.
    pub(super) fn sleep_until(&mut self, end: Instant) {
        while !self.is_hit() {
            let left = self.slice(end).saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            thread::sleep(left);
        }
    }
}
