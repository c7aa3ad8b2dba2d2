//! When this node takes a snapshot of its contents, and when the snapshot is stored.
//!
//! Nodes take turns by a lease. The node with the lease sends a message at which all nodes compare their
//! digests: its snapshot is stored only if none of them has another one.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::log::error::End;
use crate::log::parts::background::{Background, Report};
use crate::log::settings::Settings;
use crate::log::shared::Shared;
use crate::log::state::State;
use crate::log::status::Event;
use crate::log::stream::store::{Pointer, Snapshot};

/// A snapshot is taken after so many steps, or after this time if anything was applied since the last one.
pub(in crate::log) const SNAPSHOT_STEPS: u64 = 100_000;
const SNAPSHOT_AFTER: Duration = Duration::from_secs(600);

/// A snapshot is also taken after this many bytes of messages, or after this many times the contents if that
/// is more: it limits what the servers have to store.
pub(in crate::log) const SNAPSHOT_BYTES: u64 = 64 << 20;
const SNAPSHOT_CONTENTS: u64 = 4;

/// How long a snapshot, or a node that rejoins, waits for the digests of other nodes.
pub(in crate::log) const DIGESTS_TIMEOUT: Duration = Duration::from_secs(5);

/// After this time, a snapshot that failed, or that another node was about to take, is considered again.
const RETRY_DELAY: Duration = Duration::from_secs(5);

/// Takes snapshots.
pub(in crate::log) struct Snapshotter {
    settings: Arc<Settings>,
    shared: Arc<Shared>,
    known: Option<Known>,
    /// Of the messages that were applied since the newest snapshot was known.
    bytes: u64,
    /// The newest snapshot before which messages were removed to make room.
    freed: u64,
    stage: Stage,
}

/// The snapshots that the log has, as far as this node knows.
struct Known {
    /// Of the key that names them.
    revision: u64,
    pointer: Pointer,
    since: Instant,
}

/// How far this node's next snapshot is.
enum Stage {
    /// Nothing is under way. Another node may be about to store a snapshot, until this time.
    Idle {
        not_before: Instant,
    },
    /// The lease was requested.
    Leasing,
    /// This node has sent a message with this counter: the snapshot has the contents after it.
    Requested {
        counter: u64,
    },
    /// The contents are encoded. Digests of other nodes decide whether they are stored.
    Prepared(Prepared),
    Storing,
}

struct Prepared {
    encoded: Vec<u8>,
    snapshot: Snapshot,
    since: Instant,
    /// Another node has another digest, so this node replays the log.
    is_disputed: bool,
}

impl Stage {
    fn idle() -> Stage {
        Stage::Idle { not_before: Instant::now() }
    }
}

impl Snapshotter {
    pub(in crate::log) fn new(settings: &Arc<Settings>, shared: &Arc<Shared>) -> Snapshotter {
        let (settings, shared) = (Arc::clone(settings), Arc::clone(shared));
        let (known, stage) = (None, Stage::idle());
        Snapshotter { settings, shared, known, bytes: 0, freed: 0, stage }
    }

    /// What was under way has ended with the last session.
    pub(in crate::log) fn begin_session(&mut self) {
        self.stage = Stage::idle();
        self.freed = 0;
        self.doubt();
    }

    /// The key may be in another bucket than before, whose revisions begin anew: it is learnt again, whatever
    /// its revision is.
    fn doubt(&mut self) {
        if let Some(known) = &mut self.known {
            known.revision = 0;
        }
    }

    /// The snapshots that the log has, if it is known.
    pub(in crate::log) fn pointer(&self) -> Option<&Pointer> {
        self.known.as_ref().map(|known| &known.pointer)
    }

    /// The key that names the snapshots was read, or changed by this node.
    pub(in crate::log) fn learn(&mut self, revision: u64, pointer: Pointer) {
        if self.known.as_ref().is_none_or(|known| known.revision < revision) {
            let sequence = pointer.newest.sequence;
            self.shared.update(|view| view.snapshot = Some(sequence));
            // A snapshot that was known before is no newer now.
            let same = self.known.as_ref().filter(|known| known.pointer == pointer);
            let since = same.map_or_else(Instant::now, |known| known.since);
            if same.is_none() {
                self.bytes = 0;
            }
            self.known = Some(Known { revision, pointer, since });
        }
    }

    /// A message of this many bytes was applied.
    pub(in crate::log) fn applied(&mut self, bytes: usize) {
        self.bytes += bytes as u64;
    }

    /// Requests the lease if a snapshot is due.
    pub(in crate::log) fn consider(
        &mut self,
        background: &Background,
        state: &State,
        now: Instant,
    ) {
        let Stage::Idle { not_before } = self.stage else { return };
        if now < not_before || !self.is_due(state, now) {
            return;
        }
        self.stage = Stage::Leasing;
        let node = self.settings.node.clone();
        // If the session ends meanwhile, the lease expires.
        background.spawn(|store| async move { Report::Leased(store.lease(&node).await) });
    }

    fn is_due(&self, state: &State, now: Instant) -> bool {
        let Some(Known { pointer, since, .. }) = &self.known else { return false };
        let steps = state.steps.saturating_sub(pointer.newest.steps);
        let is_old = now.saturating_duration_since(*since) >= SNAPSHOT_AFTER;
        steps >= self.settings.snapshot_steps
            || self.bytes >= self.settings.snapshot_bytes
                && self.bytes >= SNAPSHOT_CONTENTS * state.contents_bytes()
            || is_old && state.position.sequence > pointer.newest.sequence
    }

    /// The servers have no room for further messages. Removes those that the newest snapshot replaces, once
    /// in a session: otherwise they stay until there is a newer one.
    pub(in crate::log) fn make_room(&mut self, background: &Background) {
        let Some(Known { pointer, .. }) = &self.known else { return };
        let newest = pointer.newest.clone();
        if newest.sequence > self.freed {
            self.freed = newest.sequence;
            background.spawn(|store| async move { Report::Freed(store.make_room(&newest).await) });
        }
    }

    /// Messages were removed to make room, or could not be: the next session tries it again.
    pub(in crate::log) fn freed(&self, freed: Result<u64, String>) {
        let reason = match freed {
            Ok(0) => return,
            Ok(count) => {
                format!("no room for messages: removed {count} before the newest snapshot")
            }
            Err(error) => format!("no room for messages: none was removed: {error}"),
        };
        self.shared.event(Event::new("log_error", &[("reason", &reason)]));
    }

    /// The lease was refused: another node takes a snapshot.
    pub(in crate::log) fn postpone(&mut self) {
        self.stage = Stage::Idle { not_before: Instant::now() + RETRY_DELAY };
    }

    /// The message at which the snapshot is taken was sent.
    pub(in crate::log) fn requested(&mut self, counter: u64) {
        self.stage = Stage::Requested { counter };
    }

    /// A message of this node was applied. Returns whether the snapshot is to be taken now.
    pub(in crate::log) fn is_requested_at(&mut self, counter: u64) -> bool {
        match self.stage {
            Stage::Requested { counter: requested } if requested < counter => {
                // The stream has not stored that message, and never will. The lease expires.
                self.stage = Stage::idle();
                false
            }
            Stage::Requested { counter: requested } => requested == counter,
            _ => false,
        }
    }

    /// Keeps the encoded contents until other nodes have compared theirs.
    pub(in crate::log) fn prepare(&mut self, state: &State, encoded: Vec<u8>, digest: String) {
        let snapshot = Snapshot::of(state, digest, &self.settings.node);
        let (since, is_disputed) = (Instant::now(), false);
        self.stage = Stage::Prepared(Prepared { encoded, snapshot, since, is_disputed });
    }

    /// Another node has another digest at this sequence.
    pub(in crate::log) fn dispute(&mut self, sequence: u64) {
        if let Stage::Prepared(prepared) = &mut self.stage
            && prepared.snapshot.sequence == sequence
        {
            prepared.is_disputed = true;
        }
    }

    /// Gives up a snapshot that nodes don't agree on. There will be another one.
    pub(in crate::log) fn drop_disputed(&mut self) {
        if matches!(self.stage, Stage::Prepared(Prepared { is_disputed: true, .. })) {
            self.postpone();
        }
    }

    /// Stores the snapshot that no other node has compared itself with for some time.
    pub(in crate::log) fn store_undisputed(&mut self, background: &Background, now: Instant) {
        if let Stage::Prepared(prepared) = &self.stage
            && !prepared.is_disputed
            && now.saturating_duration_since(prepared.since) >= DIGESTS_TIMEOUT
        {
            let sequence = prepared.snapshot.sequence;
            self.store(background, sequence);
        }
    }

    /// Stores the snapshot that was prepared at this sequence: its digest is right.
    pub(in crate::log) fn store(&mut self, background: &Background, sequence: u64) {
        let is_it = |prepared: &Prepared| prepared.snapshot.sequence == sequence;
        if !matches!(&self.stage, Stage::Prepared(prepared) if is_it(prepared)) {
            return;
        }
        let stage = std::mem::replace(&mut self.stage, Stage::Storing);
        let Stage::Prepared(Prepared { encoded, snapshot, .. }) = stage else { return };
        let seen = self.known.as_ref().map(|known| (known.revision, known.pointer.clone()));
        let known = seen.as_ref().map(|(revision, _)| *revision);
        let limit = self.shared.message_limit.clone();
        background.spawn(move |store| async move {
            let stored = store.put(&limit, seen, &encoded, snapshot).await;
            store.release().await;
            match stored {
                Ok(named) => Report::Stored(named),
                Err(reason) => Report::NotStored { reason, known, found: store.examine().await },
            }
        });
    }

    /// The snapshot was stored.
    pub(in crate::log) fn stored(&mut self, revision: u64, pointer: Pointer) {
        self.stage = Stage::idle();
        let sequence = pointer.newest.sequence.to_string();
        self.shared.event(Event::new("log_snapshot_stored", &[("sequence", &sequence)]));
        self.learn(revision, pointer);
    }

    /// The snapshot was not stored. What the key was known to name may have been wrong, unless more is known
    /// now.
    ///
    /// # Errors
    /// [`End`] if the log has lost the key, or what it was in: the next session makes it anew.
    pub(in crate::log) fn failed(
        &mut self,
        reason: &str,
        known: Option<u64>,
        found: Result<Option<(u64, Pointer)>, End>,
    ) -> Result<(), End> {
        self.postpone();
        self.shared.event(Event::new("log_snapshot_failed", &[("reason", reason)]));
        let Some((revision, pointer)) = found? else { return Ok(()) };
        if self.known.as_ref().map(|now| now.revision) == known {
            self.doubt();
        }
        self.learn(revision, pointer);
        Ok(())
    }
}
