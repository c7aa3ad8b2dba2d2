//! Applies the messages of the stream to the contents of this node, in their order.

use std::sync::Arc;

use holdfast_memory::Memory;

use super::clock::Moment;
use super::error::{End, LogError};
use super::message::Origin;
use super::note::Note;
use super::raw_message::Received;
use super::settings::Settings;
use super::shared::{Checkpoint, Shared};
use super::state::{Applied, Place, State};
use super::status::{Event, NodeView};

/// The contents of this node, and which stream they come from.
pub(super) struct Applier {
    settings: Arc<Settings>,
    shared: Arc<Shared>,
    state: State,
    /// Distinguishes the stream that was applied from another one with the same name. `None` before the
    /// first session has joined.
    stream_id: Option<String>,
}

impl Applier {
    pub(super) fn new(
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
    pub(super) fn resume(&mut self, note: Note) -> Result<(), LogError> {
        note.restore(&mut self.state)?;
        self.shared.counters.sequence.set(self.state.place.sequence);
        self.stream_id = Some(note.stream);
        Ok(())
    }

    pub(super) fn state(&self) -> &State {
        &self.state
    }

    pub(super) fn sequence(&self) -> u64 {
        self.state.place.sequence
    }

    pub(super) fn stream_id(&self) -> Option<&str> {
        self.stream_id.as_deref()
    }

    pub(super) fn joined(&mut self, stream_id: Option<String>) {
        self.stream_id = stream_id;
    }

    /// Applies a message, if it is the next one. `None` if it was applied before.
    ///
    /// # Errors
    /// [`End`], also if the servers have another message in place of one that was applied.
    pub(super) fn receive(
        &mut self,
        received: &Received,
        first_sent: impl FnOnce(&Origin) -> Option<Moment>,
    ) -> Result<Option<Applied>, End> {
        let place = received.place;
        self.shared.counters.last_sequence.set(received.last);
        let applied = self.state.place;
        // A session reads the last message again. If the servers were set back and have taken other
        // messages since, it has another time.
        if place.sequence == applied.sequence && place != applied {
            let text = format!(
                "the message at {place} is not the one that this node has applied, {applied}: the \
                 servers have lost messages"
            );
            return Err(self.replaced(text).into());
        }
        if place.sequence <= applied.sequence {
            return Ok(None);
        }
        if place.sequence != applied.sequence + 1 {
            let next = applied.sequence + 1;
            return Err(End::Lost(format!("sequence {} came in place of {next}", place.sequence)));
        }
        self.apply(place, &received.payload, first_sent).map(Some)
    }

    fn apply(
        &mut self,
        place: Place,
        payload: &[u8],
        first_sent: impl FnOnce(&Origin) -> Option<Moment>,
    ) -> Result<Applied, End> {
        let shared = &self.shared;
        let age = |origin: &Origin| shared.age_since(first_sent(origin));
        let applied = self.state.apply(place, payload, age)?;
        shared.counters.sequence.set(place.sequence);
        match &applied {
            Applied::Fresh { origin, .. } => {
                shared.update_node(&origin.node, |node: &mut NodeView| {
                    node.sequence = place.sequence;
                    node.stored = place.stored;
                });
            }
            Applied::Stale(_) => shared.counters.stale.add(1),
            Applied::Ignored(error) => {
                shared.counters.ignored.add(1);
                let sequence = place.sequence.to_string();
                let fields = [("sequence", sequence.as_str()), ("reason", &error.to_string())];
                shared.event(Event::new("log_message_ignored", &fields));
            }
        }
        Ok(applied)
    }

    /// Begins to load a snapshot. Reads are refused until [`Applier::end_load`].
    pub(super) fn begin_load(&mut self) -> State {
        self.shared.set_loading(true);
        State::new(std::mem::take(&mut self.state.members))
    }

    /// Takes over a state that was loaded, or goes on from the one before.
    pub(super) fn end_load(&mut self, state: State, is_loaded: bool) {
        if is_loaded {
            self.state = state;
        } else {
            self.state.members = state.members;
        }
        self.shared.set_loading(false);
        self.shared.counters.sequence.set(self.state.place.sequence);
    }

    /// While a snapshot is loaded, there are none.
    pub(super) fn has_contents(&self) -> bool {
        !self.state.members.is_empty()
    }

    /// What the file is to keep, unless the contents are not there yet.
    pub(super) fn checkpoint(&self) -> Option<Checkpoint> {
        let stream = self.stream_id.as_deref().filter(|_| self.has_contents())?;
        Note::checkpoint(&self.state, &self.settings.name, stream)
    }

    /// The servers do not have what this node has applied. Says what to do.
    pub(super) fn replaced(&self, text: String) -> LogError {
        let Some(file) = &self.settings.memory_file else { return LogError::Replaced(text) };
        let place = self.state.place;
        LogError::Replaced(format!(
            "{text}. The contents of this node at {place} are kept in {file}. Stop all nodes and \
             decide which contents are right. Those of this node: 'holdfast memory export', then a \
             new log, under another name, with these values as 'initial'. Those of the log: go on \
             with it. In both cases move {file} away afterwards"
        ))
    }
}
