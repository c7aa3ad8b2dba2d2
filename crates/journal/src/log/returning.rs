//! How a node whose contents were wrong returns: from a snapshot, and only when a comparison behind
//! everything that the log has shows that its contents are right. Until then it serves nothing.

use std::time::{Duration, Instant};

use super::digests::Digests;
use super::error::LogError;
use super::node::{Doubt, LogSession, Node};
use super::snapshots::ALONE;
use super::status::Event;

impl Node {
    /// Whether the node returns by itself after an error: not if it has done so lately, because then
    /// something goes on making its contents wrong.
    pub(super) fn may_return(&self, error: &LogError) -> bool {
        let is_long_ago =
            |least: Duration| self.returned.is_none_or(|last| last.elapsed() >= least);
        matches!(error, LogError::Differs { .. })
            && self.settings.return_after.is_some_and(is_long_ago)
    }

    /// Lets the next session load a snapshot. What was compared before is void.
    pub(super) fn drop_contents(&mut self, error: LogError) {
        self.shared.drop_contents(error);
        self.digests = Digests::new(&self.settings.node);
        self.returned = Some(Instant::now());
        self.doubt = Some(Doubt::default());
    }

    /// Serves again, if the contents were in doubt, and were right at this sequence.
    pub(super) fn confirmed(&mut self, sequence: u64) {
        let compared = self.doubt.as_ref().and_then(|doubt| doubt.compared);
        if compared.is_some_and(|(at, _)| at <= sequence) {
            self.doubt = None;
            let sequence = sequence.to_string();
            self.shared.event(Event::new("log_contents_restored", &[("sequence", &sequence)]));
            self.shared.restored();
        }
    }

    /// If no other node compares itself, the log decides.
    pub(super) fn consider_return(&mut self, session: &mut LogSession, now: Instant) {
        let Some((sequence, since)) = self.doubt.as_ref().and_then(|doubt| doubt.compared) else {
            return;
        };
        if now.saturating_duration_since(since) >= ALONE {
            self.replay(session, sequence);
        }
    }

    /// The log could not be asked. It is asked again later.
    pub(super) fn put_off_return(&mut self) {
        if let Some((_, since)) = self.doubt.as_mut().and_then(|doubt| doubt.compared.as_mut()) {
            *since = Instant::now();
        }
    }
}
