//! A node of a log: the parts that outlast a session, and what they owe to others meanwhile.
//!
//! | part | decides |
//! | --- | --- |
//! | [`Applier`] | what a message of the stream does |
//! | [`Sender`] | what is sent, and the outcome that writers see |
//! | [`Snapshotter`] | when a snapshot is taken and stored |
//! | [`Comparer`] | whether digests of nodes agree |
//! | [`Recovery`] | whether the contents are right |
//! | [`ServerLag`] | whether the servers have lost messages |
//!
//! The parts do not know each other. A session passes on what one of them finds out.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holdfast_memory::Memory;

use super::applier::Applier;
use super::comparer::Comparer;
use super::error::{End, LogError};
use super::note::Note;
use super::recovery::Recovery;
use super::sender::Sender;
use super::server_lag::ServerLag;
use super::settings::Settings;
use super::shared::{Checkpoint, Shared};
use super::snapshotter::Snapshotter;

/// How often deadlines are checked.
pub(super) const CHECK_INTERVAL: Duration = Duration::from_millis(20);

/// What lasts from one session to the next.
pub(super) struct Node {
    pub(super) settings: Arc<Settings>,
    pub(super) shared: Arc<Shared>,
    /// The layout of the memories.
    pub(super) fingerprint: String,
    pub(super) applier: Applier,
    pub(super) sender: Sender,
    pub(super) snapshotter: Snapshotter,
    pub(super) comparer: Comparer,
    pub(super) recovery: Recovery,
    pub(super) lag: ServerLag,
}

impl Node {
    pub(super) fn new(
        settings: Arc<Settings>,
        fingerprint: String,
        shared: Arc<Shared>,
        members: Vec<Arc<Memory>>,
    ) -> Node {
        Node {
            applier: Applier::new(&settings, &shared, members),
            sender: Sender::new(&settings, &shared),
            snapshotter: Snapshotter::new(&settings, &shared),
            comparer: Comparer::new(&settings, &shared),
            recovery: Recovery::new(&settings, &shared),
            lag: ServerLag::new(settings.max_cut_off),
            fingerprint,
            settings,
            shared,
        }
    }

    /// Begins with the contents of the file.
    ///
    /// # Errors
    /// [`LogError::Snapshot`] if they are not those of the note.
    pub(super) fn resume(&mut self, note: Note) -> Result<(), LogError> {
        self.applier.resume(note)
    }

    pub(super) fn begin_session(&mut self) {
        self.lag.begin_session();
        self.snapshotter.begin_session();
        self.comparer.begin_session();
    }

    /// The contents are wrong: the next session loads a snapshot.
    pub(super) fn drop_contents(&mut self, error: LogError) {
        self.comparer.forget();
        self.recovery.drop_contents(error);
    }

    /// What the file is to keep, unless the contents are wrong or not there yet.
    pub(super) fn checkpoint(&self) -> Option<Checkpoint> {
        self.applier.checkpoint().filter(|_| self.recovery.is_right())
    }

    /// What has to be done in time, whatever this node waits for: the file is given what it asks for, and
    /// writers learn that their steps were not confirmed.
    pub(super) fn keep_deadlines(&mut self, now: Instant) {
        // While a snapshot is loaded, the file waits.
        if self.shared.is_checkpoint_requested() && self.applier.has_contents() {
            self.shared.give_checkpoint(self.checkpoint());
        }
        self.sender.expire(now);
    }

    /// Waits for something, and meanwhile keeps the deadlines.
    pub(super) async fn run_with_expiry<T>(
        &mut self,
        work: impl Future<Output = T>,
    ) -> Result<T, End> {
        let mut work = std::pin::pin!(work);
        loop {
            tokio::select! {
                done = &mut work => return Ok(done),
                () = tokio::time::sleep(CHECK_INTERVAL) => {
                    self.keep_deadlines(Instant::now());
                    if self.shared.is_stopping() {
                        return Err(End::Stopped);
                    }
                }
            }
        }
    }
}
