//! A log of writes that several machines share, in NATS JetStream.
//!
//! A write is a step, and the stream of the log has all steps in one order. Each node applies them in
//! that order. The node where a step comes from answers when it has applied it:
//!
//! ```text
//! submit ─► shared.rs     waits, with other steps
//!           sender.rs     publishes all that wait as one message
//!                         the stream: one place in the order
//!           applier.rs    applies the message, on all nodes
//! done   ◄─ in_flight.rs  the outcome of the step
//! ```
//!
//! In `parts`, `thread.rs` runs sessions, and `session.rs` joins the parts of a node (`node.rs`): `applier.rs`,
//! `sender.rs`, `snapshotter.rs`, `comparer.rs`, `continuity.rs` for seals after a restart, and
//! `rejoin.rs` for a node whose contents were wrong. `session_start.rs` is for the beginning of a session,
//! and `note.rs` for a node with a file. `stream/messages.rs` reads the stream.

mod clock;
mod defaults;
mod digests;
mod error;
mod late_messages;
mod layout;
mod lease_terms;
mod log_reader;
mod parts;
#[cfg(feature = "fuzz")]
pub mod replica;
mod settings;
mod shared;
mod state;
mod status;
mod stream;

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_memory::{Journal, Memory};
use holdfast_runtime::{OwnThreads, lock};

pub use defaults::{MAX_LAG, WRITE_TIMEOUT};
pub use error::LogError;
pub use log_reader::{LogReader, Record, Until};
pub use settings::{
    CONTACTS_PER_LAG, ClientIdentity, Login, Servers, Settings, Tls, check_name, check_node,
};
pub use shared::Checkpoint;
pub use status::{Digest, Event, NodeStatus, Phase, Status};
pub use stream::message::Origin;

use parts::node::Node;
use parts::note::Note;
use shared::Shared;

/// The journal of memories that several nodes share.
#[derive(Debug)]
pub struct Log {
    settings: Arc<Settings>,
    members: Vec<(String, Arc<Memory>)>,
    shared: Arc<Shared>,
    thread: OwnThreads,
    /// What the contents come from that the memories have before the start.
    note: Mutex<Option<Note>>,
}

/// How long the thread of a log may take to give what a file keeps.
const CHECKPOINT_TIMEOUT: Duration = Duration::from_secs(10);

impl Log {
    /// Makes the log the journal of these memories. Until it has caught up, writes are refused.
    ///
    /// What the memories contain now is what a new log begins with. The contents of an existing log
    /// replace it.
    ///
    /// # Errors
    /// [`LogError::Settings`].
    pub fn new(settings: Settings, memories: Vec<(String, Arc<Memory>)>) -> Result<Log, LogError> {
        settings.check()?;
        let mut members = memories;
        members.sort_by(|(one, _), (other, _)| one.cmp(other));
        check(&members)?;
        let settings = Arc::new(settings);
        let shared = Arc::new(Shared::new(&settings));
        for (member, (_, memory)) in members.iter().enumerate() {
            let journal: Arc<dyn Journal> = Arc::clone(&shared) as _;
            memory.keep_in(journal, member as u16);
        }
        let (thread, note) = (OwnThreads::default(), Mutex::default());
        Ok(Log { settings, members, shared, thread, note })
    }

    /// Begins with the contents that the memories have now, and the note that came with them. The log fails
    /// later if these contents do not follow from its messages.
    ///
    /// # Errors
    /// [`LogError`] for a note that is not of this log.
    pub fn resume(&self, note: &[u8]) -> Result<(), LogError> {
        let note = Note::parse(note)?;
        if note.log != self.settings.name {
            let (found, name) = (&note.log, &self.settings.name);
            return Err(LogError::Settings(format!(
                "the file has contents of the log {found:?}, not of {name:?}: move it away"
            )));
        }
        *lock(&self.note) = Some(note);
        Ok(())
    }

    /// The contents after one message, and a note for [`Log::resume`]. `None` while there are no contents
    /// that are right.
    pub fn checkpoint(&self) -> Option<Checkpoint> {
        self.shared.checkpoint(CHECKPOINT_TIMEOUT)
    }

    /// Starts the thread of the log. A second call does nothing.
    ///
    /// # Errors
    /// [`LogError::Thread`], and [`LogError::Snapshot`] for contents that are not those of the note.
    pub fn start(&self) -> Result<(), LogError> {
        let mut note = lock(&self.note);
        if self.thread.are_running() {
            return Ok(());
        }
        let members = self.members.iter().map(|(_, memory)| Arc::clone(memory)).collect();
        let fingerprint = layout::fingerprint(&self.members);
        let (settings, shared) = (Arc::clone(&self.settings), Arc::clone(&self.shared));
        let mut node = Node::new(settings, fingerprint, shared, members);
        if let Some(note) = note.take() {
            node.applier.resume(note)?;
        }
        let name = format!("log {}", self.settings.name);
        let started =
            std::thread::Builder::new().name(name).spawn(move || parts::thread::run(node));
        self.thread.push(started.map_err(|error| LogError::Thread(error.to_string()))?);
        Ok(())
    }

    /// Waits until the log has caught up, at most for this time. Returns whether it has.
    ///
    /// # Errors
    /// The error with which it failed.
    pub fn wait_until_caught_up(&self, timeout: Duration) -> Result<bool, LogError> {
        let view = self
            .shared
            .wait(timeout, |view| !matches!(view.phase, Phase::Starting | Phase::Returning(_)));
        match view.phase {
            Phase::Failed(error) => Err(error),
            Phase::Running => Ok(true),
            Phase::Starting | Phase::Returning(_) | Phase::Stopped => Ok(false),
        }
    }

    /// Whether it has applied all that the log had, and waits for other nodes to say whether seals stay open.
    pub fn awaits_seal_answer(&self) -> bool {
        let view = self.shared.view();
        view.awaits_seal_answer && view.server.is_some()
    }

    /// The error of a start in which the log did not catch up within this time: it says why.
    pub fn startup_timeout_error(&self, within: Duration) -> LogError {
        let last = if self.awaits_seal_answer() {
            "no other node has said whether seals stay open, and they could not be closed"
                .to_owned()
        } else {
            let last = self.shared.view().last_error;
            last.unwrap_or_else(|| "it has more messages".to_owned())
        };
        LogError::NoConnection { within, last }
    }

    /// Refuses writes from now on, waits for those that were sent, and ends the thread.
    pub fn stop(&self) {
        if self.thread.are_of_another_process() {
            return;
        }
        self.shared.stop();
        self.thread.join();
    }

    pub fn status(&self) -> Status {
        let (view, counters) = (self.shared.view(), &self.shared.counters);
        let sequence = counters.sequence.get();
        Status {
            phase: view.phase,
            server: view.server,
            last_error: view.last_error,
            contact_age: self.shared.contact_age(),
            sequence,
            last_sequence: counters.last_sequence.get().max(sequence),
            steps: counters.steps.get(),
            unavailable: counters.unavailable.get(),
            not_confirmed: counters.not_confirmed.get(),
            too_large: counters.too_large.get(),
            refused: counters.refused.get(),
            stale: counters.stale.get(),
            ignored: counters.ignored.get(),
            replicas: view.replicas,
            digest: view.digest,
            snapshot: view.snapshot,
            nodes: view.nodes,
        }
    }

    /// Takes what has happened. If that is nothing, waits for it, at most for this time.
    pub fn take_events(&self, timeout: Duration) -> Vec<Event> {
        self.shared.take_events(timeout)
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        self.stop();
    }
}

fn check(members: &[(String, Arc<Memory>)]) -> Result<(), LogError> {
    let refused = |text: String| Err(LogError::Settings(text));
    if members.is_empty() {
        return refused("memories are empty, at least one is required".to_owned());
    }
    if members.len() > usize::from(u16::MAX) {
        return refused(format!("there are {} memories, 65535 are allowed", members.len()));
    }
    let mut names = BTreeSet::new();
    for (name, memory) in members {
        if name.is_empty() || name.contains(['\n', ':']) {
            return refused(format!("memory {name:?}: a name with a colon or a line break"));
        }
        if !names.insert(name) {
            return refused(format!("memory {name:?} is named twice"));
        }
        if memory.has_journal() {
            return refused(format!("memory {name:?} is kept elsewhere already"));
        }
    }
    Ok(())
}
