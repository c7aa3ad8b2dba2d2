//! With a `sync` above 0: what has changed is stored each time that `sync` has passed.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use holdfast_memory::{Contents, Memory};

use super::error::FileError;
use super::image::{Changes, NoteChange};
use super::queue::{Next, Queue};
use super::store::Store;

/// A log that changes the memories of a file.
pub trait CheckpointSource: fmt::Debug + Send + Sync {
    /// The contents of all memories after one message, in the order of their names, and what the log has
    /// to know to go on from there. `None` while there are no contents that are right.
    fn checkpoint(&self) -> Option<(Vec<Contents>, Vec<u8>)>;
}

pub(super) struct Periodic {
    pub store: Store,
    pub memories: Vec<Arc<Memory>>,
    /// Their numbers in the file.
    pub ids: Vec<u16>,
    /// Of which only the stop is needed: no step ever waits in it.
    pub queue: Arc<Queue>,
    pub sync: Duration,
    /// How many writes to the memories are in the file.
    pub stored_writes: Arc<AtomicU64>,
    /// What changes the memories, if a log does.
    pub log: Option<Arc<dyn CheckpointSource>>,
}

impl Periodic {
    pub fn run(mut self) -> Result<(), FileError> {
        while let Next::Idle = self.queue.next(self.sync) {
            // The status has the error, and the next attempt may succeed.
            let _ = self.store_changes();
        }
        self.store_changes()?;
        self.store.close()
    }

    fn store_changes(&mut self) -> Result<(), FileError> {
        // Writes after this are in the contents, perhaps, and stored again.
        let written = writes(&self.memories);
        if written == self.stored_writes.load(Ordering::Relaxed) {
            // The file may be gone, or in doubt.
            return self.store.store(Changes::default());
        }
        let (contents, note) = match &self.log {
            None => (Memory::contents(&self.memories), NoteChange::Keep),
            Some(log) => match log.checkpoint() {
                Some((contents, note)) => (contents, NoteChange::Set(note)),
                // What the file has stays the last that was right.
                None => return Ok(()),
            },
        };
        let image = self.store.image();
        let pages = self.ids.iter().zip(&contents);
        let pages = pages.flat_map(|(id, contents)| image.differing(*id, contents)).collect();
        self.store.store(Changes { pages, note, ..Changes::default() })?;
        self.stored_writes.store(written, Ordering::Relaxed);
        Ok(())
    }
}

/// How many writes were carried out.
pub(super) fn writes(memories: &[Arc<Memory>]) -> u64 {
    memories.iter().map(|memory| memory.writes()).sum()
}
