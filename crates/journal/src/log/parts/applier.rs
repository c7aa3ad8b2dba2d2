//! Applies the messages of the stream to the contents of this node, in their order.

use std::sync::Arc;

use holdfast_memory::Memory;

use crate::log::clock::Moment;
use crate::log::error::{End, LogError};
use crate::log::parts::note::Note;
use crate::log::settings::Settings;
use crate::log::shared::{Checkpoint, Shared};
use crate::log::state::{Applied, State};
use crate::log::status::{Event, NodeStatus};
use crate::log::stream::message::Origin;
use crate::log::stream::raw_message::Received;

/// The contents of this node, and which stream they come from.
pub(in crate::log) struct Applier {
    settings: Arc<Settings>,
    shared: Arc<Shared>,
    state: State,
    /// Distinguishes the stream that was applied from another one with the same name. `None` before the
    /// first session has joined.
    stream_id: Option<String>,
}

impl Applier {
    pub(in crate::log) fn new(
        settings: &Arc<Settings>,
        shared: &Arc<Shared>,
        members: Vec<Arc<Memory>>,
    ) -> Applier {
        let (settings, shared) = (Arc::clone(settings), Arc::clone(shared));
        Applier { settings, shared, state: State::new(members), stream_id: None }
    }

    /// Begins with the contents of the file.
    ///
    /// # Errors
    /// [`LogError::Snapshot`] if they are not those of the note.
    pub(in crate::log) fn resume(&mut self, note: Note) -> Result<(), LogError> {
        note.restore(&mut self.state)?;
        self.shared.counters.sequence.set(self.state.position.sequence);
        self.stream_id = Some(note.stream);
        Ok(())
    }

    pub(in crate::log) fn state(&self) -> &State {
        &self.state
    }

    pub(in crate::log) fn sequence(&self) -> u64 {
        self.state.position.sequence
    }

    pub(in crate::log) fn stream_id(&self) -> Option<&str> {
        self.stream_id.as_deref()
    }

    pub(in crate::log) fn joined(&mut self, stream_id: Option<String>) {
        self.stream_id = stream_id;
    }

    /// Applies a message, if it is the next one. `None` if it was applied before.
    ///
    /// # Errors
    /// [`End`], also if the servers have another message in place of one that was applied.
    pub(in crate::log) fn receive(
        &mut self,
        received: &Received,
        first_sent: impl FnOnce(&Origin) -> Option<Moment>,
    ) -> Result<Option<Applied>, End> {
        let position = received.position;
        self.shared.counters.last_sequence.set(received.last);
        let applied = self.state.position;
        // A session reads the last message again. If the servers were set back and have taken other
        // messages since, it has another time.
        if position.sequence == applied.sequence && position != applied {
            let text = format!(
                "the message at {position} is not the one that this node has applied, {applied}: the \
                 servers have lost messages"
            );
            return Err(self.replaced(text).into());
        }
        if position.sequence <= applied.sequence {
            return Ok(None);
        }
        if position.sequence != applied.sequence + 1 {
            return Err(End::missing(applied.sequence + 1, position.sequence - 1));
        }
        self.apply(received, first_sent).map(Some)
    }

    fn apply(
        &mut self,
        received: &Received,
        first_sent: impl FnOnce(&Origin) -> Option<Moment>,
    ) -> Result<Applied, End> {
        let (shared, position) = (&self.shared, received.position);
        let age = |origin: &Origin| shared.age_since(first_sent(origin));
        let applied = received.apply_to(&mut self.state, self.stream_id.as_deref(), age)?;
        shared.counters.sequence.set(position.sequence);
        match &applied {
            Applied::Fresh { origin, .. } => {
                shared.update_node(&origin.node, |node: &mut NodeStatus| {
                    node.sequence = position.sequence;
                    node.stored = position.stored;
                });
            }
            Applied::Stale(_) => shared.counters.stale.add(),
            Applied::Ignored(error) => {
                shared.counters.ignored.add();
                let sequence = position.sequence.to_string();
                let fields = [("sequence", sequence.as_str()), ("reason", &error.to_string())];
                shared.event(Event::new("log_message_ignored", &fields));
            }
        }
        Ok(applied)
    }

    /// Begins to load a snapshot. Reads are refused until [`Applier::end_load`].
    pub(in crate::log) fn begin_load(&mut self) -> State {
        self.shared.set_loading(true);
        State::new(std::mem::take(&mut self.state.members))
    }

    /// Takes over a state that was loaded, or goes on from the one before.
    pub(in crate::log) fn end_load(&mut self, state: State, is_loaded: bool) {
        if is_loaded {
            self.state = state;
        } else {
            self.state.members = state.members;
        }
        self.shared.set_loading(false);
        self.shared.counters.sequence.set(self.state.position.sequence);
    }

    /// While a snapshot is loaded, there are none.
    pub(in crate::log) fn has_contents(&self) -> bool {
        !self.state.members.is_empty()
    }

    /// What the file is to keep, unless the contents are not there yet.
    pub(in crate::log) fn checkpoint(&self) -> Option<Checkpoint> {
        let stream = self.stream_id.as_deref().filter(|_| self.has_contents())?;
        Note::checkpoint(&self.state, &self.settings.name, stream)
    }

    /// The servers do not have what this node has applied. Says what to do.
    pub(in crate::log) fn replaced(&self, text: String) -> LogError {
        let Some(file) = &self.settings.memory_file else { return LogError::Replaced(text) };
        let position = self.state.position;
        LogError::Replaced(format!(
            "{text}. The contents of this node at {position} are kept in {file}. Stop all nodes and \
             decide which contents are right. Those of this node: 'holdfast memory export', then a \
             new log, under another name, with these values as 'initial'. Those of the log: go on \
             with it. In both cases move {file} away afterwards"
        ))
    }
}
