//! Until when the stream may store the steps of a message: no node carries out what it stores later.
//!
//! A cut network can deliver a message long after its writers were answered `not_confirmed`, as the system goes on
//! sending what this process has handed over. Newer writes may have been confirmed since.

use std::time::Duration;

use super::clock::Moment;

/// A lower bound of how far the clock of the stream is ahead of that of this machine, in nanoseconds. `None` before
/// the first message.
#[derive(Debug, Default)]
pub(super) struct StreamLead(Option<i64>);

impl StreamLead {
    /// The stream had stored a message before it was applied: a lower bound. Of these, the highest counts, as the
    /// message that was on its way for the shortest time gives it.
    pub(super) fn applied(&mut self, stored: i64, now: Moment) {
        self.0 = self.0.max(Some(lead_over(stored, now)));
    }

    /// The stream has stored a message after this node sent it: an upper bound. A bound above it is from before the
    /// clock of the stream was set back.
    pub(super) fn sent(&mut self, stored: i64, at: Moment) {
        self.0 = self.0.min(Some(lead_over(stored, at)));
    }

    /// The time in `left`, by the clock of the stream. With a lower bound of the lead it comes early: by the time
    /// that the fastest message took from the stream to this node.
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
