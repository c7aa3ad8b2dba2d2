//! How a node whose contents were wrong rejoins: from a snapshot, and only when a comparison behind
//! everything that the log has shows that its contents are right. Until then it serves nothing.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::log::error::LogError;
use crate::log::parts::snapshotter::DIGESTS_TIMEOUT;
use crate::log::settings::Settings;
use crate::log::shared::Shared;
use crate::log::status::Event;

/// A node that has rejoined does so again only after this time.
pub(in crate::log) const REJOIN_AFTER: Duration = Duration::from_secs(24 * 3600);

/// Whether the contents of this node are right.
pub(in crate::log) struct Rejoin {
    settings: Arc<Settings>,
    shared: Arc<Shared>,
    contents: Contents,
    /// When contents were last found wrong.
    last: Option<Instant>,
}

enum Contents {
    /// As far as this node knows.
    Right,
    /// To be replaced by a snapshot.
    Wrong,
    /// A snapshot was loaded. What the log has behind it is being applied.
    Reloaded,
    /// All nodes were asked to compare themselves at this sequence, at this time.
    Comparing { sequence: u64, since: Instant },
}

impl Rejoin {
    pub(in crate::log) fn new(settings: &Arc<Settings>, shared: &Arc<Shared>) -> Rejoin {
        let (settings, shared) = (Arc::clone(settings), Arc::clone(shared));
        Rejoin { settings, shared, contents: Contents::Right, last: None }
    }

    pub(in crate::log) fn contents_are_right(&self) -> bool {
        matches!(self.contents, Contents::Right)
    }

    /// Whether the next session has to load a snapshot.
    pub(in crate::log) fn needs_snapshot(&self) -> bool {
        matches!(self.contents, Contents::Wrong)
    }

    /// Whether the node rejoins by itself after an error: not if it has done so lately, because then
    /// something goes on making its contents wrong.
    pub(in crate::log) fn may_rejoin(&self, error: &LogError) -> bool {
        let is_long_ago = |least: Duration| self.last.is_none_or(|last| last.elapsed() >= least);
        matches!(error, LogError::Differs { .. })
            && self.settings.rejoin_after.is_some_and(is_long_ago)
    }

    /// The contents are wrong: the next session loads a snapshot.
    pub(in crate::log) fn drop_contents(&mut self, error: LogError) {
        self.shared.drop_contents(error);
        self.last = Some(Instant::now());
        self.contents = Contents::Wrong;
    }

    /// A snapshot has replaced the contents. What was compared before is void.
    pub(in crate::log) fn reloaded(&mut self) {
        if !self.contents_are_right() {
            self.contents = Contents::Reloaded;
        }
    }

    /// The node has applied all that the log had. Returns whether it serves from now on.
    pub(in crate::log) fn caught_up(&mut self, sequence: u64) -> bool {
        let contents_are_right = self.contents_are_right();
        // Each session compares anew: a digest from an earlier one proves nothing about what came since.
        if !contents_are_right {
            self.contents = Contents::Comparing { sequence, since: Instant::now() };
        }
        contents_are_right
    }

    /// The contents were right at this sequence. The node serves again, if that shows it for those that it
    /// has caught up with.
    pub(in crate::log) fn confirm(&mut self, confirmed: u64) {
        if let Contents::Comparing { sequence, .. } = self.contents
            && sequence <= confirmed
        {
            self.contents = Contents::Right;
            let sequence = confirmed.to_string();
            self.shared.event(Event::new("log_contents_restored", &[("sequence", &sequence)]));
            self.shared.restored();
        }
    }

    /// The sequence at which the log itself has to be replayed, since no other node compares itself.
    pub(in crate::log) fn overdue(&self, now: Instant) -> Option<u64> {
        match self.contents {
            Contents::Comparing { sequence, since }
                if now.saturating_duration_since(since) >= DIGESTS_TIMEOUT =>
            {
                Some(sequence)
            }
            _ => None,
        }
    }

    /// The log could not be replayed. It is tried again later.
    pub(in crate::log) fn postpone(&mut self) {
        if let Contents::Comparing { since, .. } = &mut self.contents {
            *since = Instant::now();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rejoin() -> Rejoin {
        let settings = Arc::new(Settings::new("site", "a", Vec::new()));
        let shared = Arc::new(Shared::new(&settings));
        Rejoin::new(&settings, &shared)
    }

    fn differs() -> LogError {
        LogError::Differs { sequence: 7, found: String::new(), other: String::new() }
    }

    #[test]
    fn contents_that_were_wrong_are_right_after_a_comparison_behind_all_that_the_log_had() {
        let mut rejoin = rejoin();
        rejoin.drop_contents(differs());
        assert!(rejoin.needs_snapshot());
        rejoin.reloaded();
        assert!(!rejoin.needs_snapshot());
        rejoin.confirm(10);
        assert!(!rejoin.contents_are_right(), "the node has not caught up");
        assert!(!rejoin.caught_up(10));
        rejoin.confirm(9);
        assert!(!rejoin.contents_are_right(), "a comparison before it has caught up");
        rejoin.confirm(10);
        assert!(rejoin.contents_are_right());
    }

    #[test]
    fn a_comparison_is_void_when_a_snapshot_replaces_the_contents_again() {
        let mut rejoin = rejoin();
        rejoin.drop_contents(differs());
        rejoin.reloaded();
        rejoin.caught_up(10);
        rejoin.reloaded();
        rejoin.confirm(10);
        assert!(!rejoin.contents_are_right());
    }

    #[test]
    fn only_a_node_that_has_not_rejoined_lately_rejoins() {
        let mut rejoin = rejoin();
        assert!(!rejoin.may_rejoin(&LogError::NameTaken("a".to_owned())));
        assert!(rejoin.may_rejoin(&differs()));
        rejoin.drop_contents(differs());
        assert!(!rejoin.may_rejoin(&differs()));
    }
}
