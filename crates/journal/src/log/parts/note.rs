//! What a file beside the memories keeps of a log, so that a node knows after a restart what it has applied.

use std::collections::BTreeMap;

use holdfast_memory::{Contents, Memory, Term};
use serde::{Deserialize, Serialize};

use crate::log::error::LogError;
use crate::log::shared::Checkpoint;
use crate::log::state::{State, StreamPosition, digest_of};
use crate::log::stream::message::{FIRST_VERSION, WITH_LEASES};

/// Which message of which log contents come from, and what a node has to know to go on from there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::log) struct Note {
    version: u8,
    pub(in crate::log) log: String,
    /// Tells the stream from another one with the same name.
    pub(in crate::log) stream: String,
    sequence: u64,
    stored: i64,
    steps: u64,
    origins: BTreeMap<String, (u64, u64)>,
    #[serde(default)]
    terms: BTreeMap<u64, (u64, u64)>,
    sealed: Vec<bool>,
    /// The digest of the contents and all of the above, as nodes compare it.
    digest: String,
}

impl Note {
    /// # Errors
    /// [`LogError::Version`] or [`LogError::Snapshot`].
    pub(in crate::log) fn parse(bytes: &[u8]) -> Result<Note, LogError> {
        #[derive(Deserialize)]
        struct Versioned {
            version: u8,
        }
        let malformed = |_| LogError::Snapshot("the note of the log is malformed".to_owned());
        let Versioned { version: found } = serde_json::from_slice(bytes).map_err(malformed)?;
        if !(FIRST_VERSION..=WITH_LEASES).contains(&found) {
            let what = "the note of the log";
            return Err(LogError::Version { what, found, supported: WITH_LEASES });
        }
        serde_json::from_slice(bytes).map_err(malformed)
    }

    /// The contents of this state, and the note about them. `None` if the note can't be encoded.
    pub(in crate::log) fn checkpoint(state: &State, log: &str, stream: &str) -> Option<Checkpoint> {
        let contents = Memory::contents(&state.members);
        let numbers = state.terms.iter().map(|(lease, term)| (lease, (term.epoch, term.since)));
        let note = Note {
            version: state.version(),
            log: log.to_owned(),
            stream: stream.to_owned(),
            sequence: state.position.sequence,
            stored: state.position.stored,
            steps: state.steps,
            origins: state.origins.clone(),
            terms: numbers.collect(),
            sealed: contents.iter().map(|contents| contents.sealed).collect(),
            digest: digest_of(&state.encode()),
        };
        Some((contents, serde_json::to_vec(&note).ok()?))
    }

    /// Makes this note's state from the contents that the memories have now.
    ///
    /// # Errors
    /// [`LogError::Snapshot`] if they are not those of the note.
    pub(in crate::log) fn restore(&self, state: &mut State) -> Result<(), LogError> {
        for (memory, sealed) in state.members.iter().zip(&self.sealed) {
            let contents = Memory::contents(std::slice::from_ref(memory));
            for Contents { areas, .. } in contents {
                let sealed = *sealed && memory.gate().is_some();
                memory.restore(&Contents { areas, sealed });
            }
        }
        state.position = StreamPosition { sequence: self.sequence, stored: self.stored };
        state.steps = self.steps;
        state.origins = self.origins.clone();
        let terms = self.terms.iter();
        state.terms =
            terms.map(|(lease, &(epoch, since))| (*lease, Term { epoch, since })).collect();
        let found = digest_of(&state.encode());
        if found == self.digest {
            return Ok(());
        }
        let (position, expected) = (state.position, &self.digest);
        Err(LogError::Snapshot(format!(
            "the contents of {position} have digest {found}, expected is {expected}: something else has \
             changed the file. Move it away to start with the contents of the log"
        )))
    }
}
