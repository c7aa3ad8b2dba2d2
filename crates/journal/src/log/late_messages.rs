//! Until when the stream may store the steps of a message: no node carries out what it stores later.
//!
//! A cut network can deliver a message long after its writers were answered `not_confirmed`, as the system goes on
//! sending what this process has handed over. Newer writes may have been confirmed since.

use std::time::Duration;

use super::clock::Moment;

/// How far the clock of the stream is ahead of that of this machine, at least, in nanoseconds. `None` before the
/// first message.
#[derive(Debug, Default)]
pub(super) struct StreamLead(Option<i64>);

impl StreamLead {
    /// The stream had stored a message before it was applied. One that arrives late says less than one before.
    pub(super) fn applied(&mut self, stored: i64, now: Moment) {
        self.0 = self.0.max(Some(lead_over(stored, now)));
    }

    /// The stream has stored a message after this node sent it. The lead was longer before the clock of the stream
    /// was set back.
    pub(super) fn sent(&mut self, stored: i64, at: Moment) {
        self.0 = self.0.min(Some(lead_over(stored, at)));
    }

    /// When the stream may store steps at the latest for which this is left, by its own clock. It is short by what
    /// the fastest message took to arrive.
    pub(super) fn deadline(&self, now: Moment, left: Duration) -> i64 {
        let lead = self.0.expect("steps are taken once a message was applied");
        lead.saturating_add_unsigned(now.as_nanos())
            .saturating_add(i64::try_from(left.as_nanos()).unwrap_or(i64::MAX))
    }
}

/// Whether the stream has stored a message too late. Those of nodes of before have no deadline.
pub(super) fn is_late(stored: i64, deadline: Option<i64>) -> bool {
    deadline.is_some_and(|deadline| stored > deadline)
}

fn lead_over(stored: i64, moment: Moment) -> i64 {
    stored.saturating_sub_unsigned(moment.as_nanos())
}
