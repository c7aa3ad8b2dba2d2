//! When a connection is given up: after some timeouts in a row without a byte, because the other side may have
//! gone without a word.

use core::time::Duration;

use super::Time;

/// The number of consecutive timeouts, without a received byte, after which a connection ends.
/// Requests in flight at the same time count as one.
pub const MAX_CONSECUTIVE_TIMEOUTS: u32 = 3;

/// The timeouts since the last received byte.
#[derive(Debug, Default)]
pub(super) struct ConsecutiveTimeouts {
    count: u32,
    first: Time,
    last: Time,
    /// The next deadline of a request whose caller has not waited for it, and when the request was sent.
    cut_short: Option<(Time, Time)>,
}

impl ConsecutiveTimeouts {
    /// A byte was received: the other side is there.
    pub(super) fn clear(&mut self) {
        (self.count, self.cut_short) = (0, None);
    }

    /// Counts the timeout of a request, unless one before was already counted while it was in flight.
    pub(super) fn add(&mut self, sent: Time, now: Time) {
        if self.count == 0 {
            self.first = now;
        } else if sent < self.last {
            return;
        }
        self.count += 1;
        self.last = now;
    }

    /// Notes a request whose caller does not wait for its deadline: it is still counted then, because callers with
    /// less time than that must not stay on a dead connection.
    pub(super) fn cut_short(&mut self, deadline: Time, sent: Time) {
        // Requests in flight at the same time count as one: the first deadline is enough.
        let next = (deadline, sent);
        self.cut_short = Some(self.cut_short.map_or(next, |first| first.min(next)));
    }

    /// When the next request that was cut short is counted.
    pub(super) fn deadline(&self) -> Option<Time> {
        self.cut_short.map(|(deadline, _)| deadline)
    }

    /// Counts the request that was cut short, if its deadline has come. Returns whether it has.
    pub(super) fn add_cut_short(&mut self, now: Time) -> bool {
        let due = self.cut_short.take_if(|(deadline, _)| *deadline <= now);
        if let Some((_, sent)) = due {
            self.add(sent, now);
        }
        due.is_some()
    }

    /// Whether the connection is given up. A request with a longer timeout has all of it.
    pub(super) fn are_too_many(&self, longest_timeout: Duration, now: Time) -> bool {
        self.count >= MAX_CONSECUTIVE_TIMEOUTS && longest_timeout <= now.saturating_sub(self.first)
    }
}
