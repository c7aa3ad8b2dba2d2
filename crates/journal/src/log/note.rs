//! What a file beside the memories keeps of a log, so that a node knows after a restart what it has applied.

use std::collections::BTreeMap;

use holdfast_memory::{Contents, Memory};
use serde::{Deserialize, Serialize};

use super::error::LogError;
use super::node::Node;
use super::shared::Kept;
use super::state::{Place, State, digest_of};

const VERSION: u8 = 1;

/// Which message of which log contents come from, and what a node has to know to go on from there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Note {
    version: u8,
    pub(super) log: String,
    /// Tells the stream from another one with the same name.
    pub(super) stream: String,
    sequence: u64,
    stored: i64,
    steps: u64,
    origins: BTreeMap<String, (u64, u64)>,
    sealed: Vec<bool>,
    /// The digest of the contents and all of the above, as nodes compare it.
    digest: String,
}

impl Note {
    /// # Errors
    /// [`LogError::Version`] or [`LogError::Snapshot`].
    pub(super) fn parse(bytes: &[u8]) -> Result<Note, LogError> {
        #[derive(Deserialize)]
        struct Versioned {
            version: u8,
        }
        let malformed = |_| LogError::Snapshot("the note of the log is malformed".to_owned());
        let Versioned { version: found } = serde_json::from_slice(bytes).map_err(malformed)?;
        if found != VERSION {
            let what = "the note of the log";
            return Err(LogError::Version { what, found, supported: VERSION });
        }
        serde_json::from_slice(bytes).map_err(malformed)
    }
}

impl State {
    fn kept(&self, log: &str, stream: &str) -> Option<Kept> {
        let contents = Memory::contents(&self.members);
        let note = Note {
            version: VERSION,
            log: log.to_owned(),
            stream: stream.to_owned(),
            sequence: self.place.sequence,
            stored: self.place.stored,
            steps: self.steps,
            origins: self.origins.clone(),
            sealed: contents.iter().map(|contents| contents.sealed).collect(),
            digest: digest_of(&self.encode()),
        };
        Some((contents, serde_json::to_vec(&note).ok()?))
    }

    /// Goes on from the contents that the memories have now.
    fn resume(&mut self, note: &Note) -> Result<(), LogError> {
        for (memory, sealed) in self.members.iter().zip(&note.sealed) {
            let contents = Memory::contents(std::slice::from_ref(memory));
            for Contents { areas, .. } in contents {
                let sealed = *sealed && memory.gate().is_some();
                memory.restore(&Contents { areas, sealed });
            }
        }
        self.place = Place { sequence: note.sequence, stored: note.stored };
        self.steps = note.steps;
        self.origins = note.origins.clone();
        let found = digest_of(&self.encode());
        if found == note.digest {
            return Ok(());
        }
        let (place, expected) = (self.place, &note.digest);
        Err(LogError::Snapshot(format!(
            "the contents of {place} have digest {found}, expected is {expected}: something else has \
             changed the file. Move it away to start with the contents of the log"
        )))
    }
}

impl Node {
    /// Begins with the contents of the file.
    ///
    /// # Errors
    /// [`LogError::Snapshot`] if they are not those of the note.
    pub(super) fn resume(&mut self, note: Note) -> Result<(), LogError> {
        self.state.resume(&note)?;
        self.shared.counters.sequence.set(note.sequence);
        self.id = Some(note.stream);
        Ok(())
    }

    /// What the file is to keep, unless the contents are wrong or not there yet.
    pub(super) fn kept(&self) -> Option<Kept> {
        let is_right = self.doubt.is_none() && !self.state.members.is_empty();
        let stream = self.id.as_deref().filter(|_| is_right)?;
        self.state.kept(&self.settings.name, stream)
    }

    /// Gives the file what it asks for, unless contents are being loaded: then it waits.
    pub(super) fn keep(&self) {
        if self.shared.is_kept_asked() && !self.state.members.is_empty() {
            self.shared.give_kept(self.kept(), false);
        }
    }

    /// The servers have not what this node has applied. Says what to do.
    pub(super) fn replaced(&self, text: String) -> LogError {
        let Some(file) = &self.settings.kept_file else { return LogError::Replaced(text) };
        let place = self.state.place;
        LogError::Replaced(format!(
            "{text}. The contents of this node at {place} are kept in {file}. Stop all nodes and \
             decide which contents are right. Those of this node: 'holdfast memory export', then a \
             new log, under another name, with these values as 'initial'. Those of the log: go on \
             with it. In both cases move {file} away afterwards"
        ))
    }
}
