//! Digests of this node and of the others: when they are compared, and what a difference leads to.

use std::sync::Arc;

use holdfast_memory::Memory;
use serde::{Deserialize, Serialize};

use crate::log::digests::{Digests, Verdict};
use crate::log::error::{End, LogError};
use crate::log::log_reader::digest_at;
use crate::log::parts::background::{Background, Report};
use crate::log::settings::{Settings, is_word};
use crate::log::shared::Shared;
use crate::log::state::State;
use crate::log::status::{Digest, Event};
use crate::log::stream::store::{DIGEST_KEY_PREFIX, Pointer};

/// Nodes compare their digests at sequences that are multiples of this.
pub(in crate::log) const DIGEST_STEPS: u64 = 10_000;

/// The length of a digest as text.
const DIGEST_CHARS: usize = 64;

/// Compares the digests of all nodes.
pub(in crate::log) struct Comparer {
    settings: Arc<Settings>,
    shared: Arc<Shared>,
    digests: Digests,
    /// The digest of this node that a replay checks: many other sequences may be compared meanwhile.
    replaying: Option<String>,
}

/// What a node stores as its digest.
#[derive(Serialize, Deserialize)]
struct Published {
    sequence: u64,
    digest: String,
}

/// What a replay of the log says about the digest of this node.
pub(in crate::log) enum Replayed {
    Agrees,
    Failed,
}

impl Comparer {
    pub(in crate::log) fn new(settings: &Arc<Settings>, shared: &Arc<Shared>) -> Comparer {
        let digests = Digests::new(&settings.node);
        let (settings, shared) = (Arc::clone(settings), Arc::clone(shared));
        Comparer { settings, shared, digests, replaying: None }
    }

    /// A replay ends with the session that has begun it.
    pub(in crate::log) fn begin_session(&mut self) {
        self.replaying = None;
    }

    /// What was compared before is void: the contents were wrong.
    pub(in crate::log) fn forget(&mut self) {
        self.digests = Digests::new(&self.settings.node);
    }

    /// Whether all nodes compare their digests at this sequence, although none of them asks for it.
    pub(in crate::log) fn is_due(&self, sequence: u64) -> bool {
        sequence.is_multiple_of(self.settings.digest_steps)
    }

    /// Stores the digest of this node for the others, and compares it.
    pub(in crate::log) fn publish(
        &mut self,
        background: &Background,
        sequence: u64,
        digest: &str,
    ) -> Verdict {
        let published = Published { sequence, digest: digest.to_owned() };
        if let Ok(value) = serde_json::to_vec(&published) {
            let keys = background.store().keys.clone();
            let key = format!("{DIGEST_KEY_PREFIX}{}", self.settings.node);
            // If this fails, other nodes see the next digest.
            tokio::spawn(async move { keys.put(key, value.into()).await.map(drop) });
        }
        let own = Digest { sequence, digest: digest.to_owned(), agrees: None };
        self.shared.update(|view| view.digest = Some(own));
        self.digests.add(&self.settings.node, sequence, digest)
    }

    /// Compares the digest of another node. `None` if that is not one.
    pub(in crate::log) fn receive(
        &mut self,
        state: &State,
        key: &str,
        value: &[u8],
    ) -> Option<(u64, Verdict)> {
        let node = key.strip_prefix(DIGEST_KEY_PREFIX).unwrap_or_default();
        let Published { sequence, digest } = serde_json::from_slice(value).ok()?;
        let is_digest = is_word(node) && digest.len() == DIGEST_CHARS;
        // Anyone may write the key. Only nodes that have sent a message have a vote.
        if !is_digest || node == self.settings.node || !state.knows(node) {
            return None;
        }
        let verdict = self.digests.add(node, sequence, &digest);
        self.shared.update_node(node, |node| node.digest = Some((sequence, digest)));
        Some((sequence, verdict))
    }

    /// Shows in the status whether other nodes have the same digest.
    pub(in crate::log) fn show(&self, sequence: u64, agrees: bool) {
        self.shared.update(|view| {
            if let Some(digest) = view.digest.as_mut().filter(|digest| digest.sequence == sequence)
            {
                digest.agrees = Some(agrees);
            }
        });
    }

    /// The error of a node whose contents are wrong.
    pub(in crate::log) fn differs(&self, sequence: u64, other: String) -> End {
        let found = self.digests.own(sequence).unwrap_or_default().to_owned();
        LogError::Differs { sequence, found, other }.into()
    }

    /// The last sequence from this one on at which this node has a digest.
    pub(in crate::log) fn last_compared(&self, from: u64) -> Option<u64> {
        self.digests.last_own().filter(|last| *last >= from)
    }

    /// Finds out what the log leads to, beside the session: no majority of nodes says it. Returns
    /// whether that has begun.
    pub(in crate::log) fn replay(
        &mut self,
        background: &Background,
        pointer: Option<&Pointer>,
        members: &[Arc<Memory>],
        sequence: u64,
    ) -> bool {
        let Some(pointer) = pointer.cloned() else { return false };
        if !self.begin_replay(sequence) {
            return false;
        }
        // The memories themselves go on with the session.
        let members = members.iter().map(|memory| Arc::new(memory.blank())).collect();
        background.spawn(|store| async move {
            let digest = digest_at(&store, &pointer, members, sequence).await;
            Report::Replayed { sequence, digest }
        });
        true
    }

    /// Whether a replay can begin: none is running, and this node has a digest to check.
    fn begin_replay(&mut self, sequence: u64) -> bool {
        if self.replaying.is_some() {
            return false;
        }
        self.replaying = self.digests.own(sequence).map(str::to_owned);
        self.replaying.is_some()
    }

    /// A replay has ended.
    ///
    /// # Errors
    /// [`LogError::Differs`] if the log leads to other contents than those of this node.
    pub(in crate::log) fn replayed(
        &mut self,
        sequence: u64,
        digest: Result<String, String>,
    ) -> Result<Replayed, End> {
        let found = self.replaying.take().expect("a replay checks a digest of this node");
        match digest {
            Ok(digest) if digest == found => Ok(Replayed::Agrees),
            Ok(digest) => {
                let other = format!("the log leads to {digest}");
                Err(LogError::Differs { sequence, found, other }.into())
            }
            Err(reason) => {
                let fields = [("sequence", &*sequence.to_string()), ("reason", &reason)];
                self.shared.event(Event::new("log_replay_failed", &fields));
                Ok(Replayed::Failed)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn comparer() -> Comparer {
        let settings = Arc::new(Settings::new("site", "a", Vec::new()));
        let shared = Arc::new(Shared::new(&settings));
        Comparer::new(&settings, &shared)
    }

    #[test]
    fn a_replay_checks_the_digest_that_this_node_had_when_it_began() {
        for (of_log, agrees) in [("right", true), ("wrong", false)] {
            let mut comparer = comparer();
            comparer.digests.add("a", 7, "right");
            assert!(comparer.begin_replay(7));
            for sequence in 8..100 {
                comparer.digests.add("a", sequence, "later");
            }
            assert_eq!(comparer.digests.own(7), None, "it is forgotten");
            assert!(!comparer.begin_replay(99), "one at a time");
            match comparer.replayed(7, Ok(of_log.to_owned())) {
                Ok(replayed) => assert!(agrees && matches!(replayed, Replayed::Agrees)),
                Err(End::Fatal(LogError::Differs { sequence, found, .. })) => {
                    assert_eq!((agrees, sequence, &*found), (false, 7, "right"));
                }
                Err(_) => panic!("another error"),
            }
            assert!(comparer.begin_replay(99));
        }
    }

    #[test]
    fn a_replay_without_a_digest_to_check_does_not_begin() {
        let mut comparer = comparer();
        for sequence in 0..100 {
            comparer.digests.add("a", sequence, "right");
        }
        assert!(!comparer.begin_replay(7), "it is forgotten");
        assert_eq!((comparer.last_compared(7), comparer.last_compared(100)), (Some(99), None));
        assert!(comparer.begin_replay(99), "a later one is as good");
    }

    #[test]
    fn a_replay_that_fails_confirms_nothing() {
        let mut comparer = comparer();
        comparer.digests.add("a", 7, "right");
        assert!(comparer.begin_replay(7));
        let replayed = comparer.replayed(7, Err("the servers do not answer".to_owned()));
        assert!(matches!(replayed, Ok(Replayed::Failed)));
    }
}
