//! Digests of this node and of the others: when they are compared, and what a difference leads to.

use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::digests::Verdict;
use super::error::{End, LogError};
use super::follower::digest_at;
use super::layout::copies;
use super::node::{LogSession, Node, Prepared, Report};
use super::settings::is_word;
use super::state::digest_of;
use super::status::{Digest, Event};
use super::store::{DIGEST, POINTER, parsed};

/// The length of a digest as text.
const DIGEST_LEN: usize = 64;

/// What a node stores as its digest.
#[derive(Serialize, Deserialize)]
struct Told {
    sequence: u64,
    digest: String,
}

impl Node {
    pub(super) fn tell_digest(
        &mut self,
        session: &mut LogSession,
        for_snapshot: bool,
    ) -> Result<(), End> {
        let sequence = self.state.place.sequence;
        let encoded = self.state.encode();
        let digest = digest_of(&encoded);
        if for_snapshot {
            let (snapshot, since) = (self.snapshot_of(digest.clone()), Instant::now());
            session.prepared = Some(Prepared { encoded, snapshot, since, is_disputed: false });
        }
        let told = Told { sequence, digest: digest.clone() };
        if let Ok(value) = serde_json::to_vec(&told) {
            let (keys, key) =
                (session.store.keys.clone(), format!("{DIGEST}{}", self.settings.node));
            // If this fails, the next digest tells as much.
            tokio::spawn(async move { keys.put(key, value.into()).await.map(drop) });
        }
        let own = Digest { sequence, digest: digest.clone(), agrees: None };
        self.shared.update(|view| view.digest = Some(own));
        let verdict = self.digests.add(&self.settings.node, sequence, &digest);
        self.judged(session, sequence, verdict)
    }

    pub(super) fn watched(
        &mut self,
        session: &mut LogSession,
        key: &str,
        revision: u64,
        value: &[u8],
    ) -> Result<(), End> {
        if key == POINTER {
            self.note_pointer(revision, parsed(value)?);
            return Ok(());
        }
        let node = key.strip_prefix(DIGEST).unwrap_or_default();
        let Ok(told) = serde_json::from_slice::<Told>(value) else { return Ok(()) };
        let is_digest = is_word(node) && told.digest.len() == DIGEST_LEN;
        if !is_digest || node == self.settings.node || !self.state.knows(node) {
            return Ok(());
        }
        let verdict = self.digests.add(node, told.sequence, &told.digest);
        let sequence = told.sequence;
        self.shared.update_node(node.to_owned(), |node| {
            node.digest = Some((told.sequence, told.digest));
        });
        self.judged(session, sequence, verdict)
    }

    fn judged(
        &mut self,
        session: &mut LogSession,
        sequence: u64,
        verdict: Verdict,
    ) -> Result<(), End> {
        let agrees = match verdict {
            Verdict::Alone => return Ok(()),
            Verdict::Agrees => {
                self.store_snapshot(session, sequence);
                self.confirmed(sequence);
                true
            }
            Verdict::Differs(other) => {
                return Err(self.differs(sequence, format!("most nodes have {other}")));
            }
            Verdict::Unclear(_) => {
                let mut prepared = session.prepared.iter_mut();
                if let Some(own) = prepared.find(|own| own.snapshot.sequence == sequence) {
                    own.is_disputed = true;
                }
                if self.replay(session, sequence) {
                    let at = sequence.to_string();
                    self.shared.event(Event::new("log_digests_differ", &[("sequence", &at)]));
                }
                false
            }
        };
        self.shared.update(|view| {
            if let Some(digest) = view.digest.as_mut().filter(|digest| digest.sequence == sequence)
            {
                digest.agrees = Some(agrees);
            }
        });
        Ok(())
    }

    fn differs(&self, sequence: u64, other: String) -> End {
        let found = self.digests.own(sequence).unwrap_or_default().to_owned();
        LogError::Differs { sequence, found, other }.into()
    }

    /// Finds out what the log leads to, beside the session: no majority of nodes says it. Returns
    /// whether that has begun.
    pub(super) fn replay(&mut self, session: &mut LogSession, sequence: u64) -> bool {
        let Some((_, pointer)) = self.pointer.clone() else { return false };
        if std::mem::replace(&mut session.replays, true) {
            return false;
        }
        let (store, reports) = (session.store.clone(), session.reports.clone());
        let members = copies(&self.state.members);
        tokio::spawn(async move {
            let digest = match members {
                Ok(members) => digest_at(&store, &pointer, members, sequence).await,
                Err(error) => Err(error.to_string()),
            };
            // If the session has ended, the next difference is looked at.
            let _ = reports.send(Report::Replayed { sequence, digest });
        });
        true
    }

    pub(super) fn replayed(
        &mut self,
        session: &mut LogSession,
        sequence: u64,
        digest: Result<String, String>,
    ) -> Result<(), End> {
        session.replays = false;
        match digest {
            Ok(digest) => {
                let is_right = self.digests.own(sequence).map(|own| own == digest);
                if is_right == Some(false) {
                    return Err(self.differs(sequence, format!("the log leads to {digest}")));
                }
                self.store_snapshot(session, sequence);
                if is_right.is_some() {
                    self.confirmed(sequence);
                }
            }
            Err(reason) => {
                let fields = [("sequence", &*sequence.to_string()), ("reason", &reason)];
                self.shared.event(Event::new("log_replay_failed", &fields));
                self.put_off_return();
            }
        }
        self.drop_disputed(session);
        Ok(())
    }
}
