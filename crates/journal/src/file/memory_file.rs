//! Memories and their file: loading, and the thread that stores.

use std::io;
use std::mem;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use holdfast_memory::{Contents, Memory};
use holdfast_runtime::lock;

use super::before_reply::BeforeReply;
use super::disk::Disk;
use super::error::FileError;
use super::image::{Changes, Image, NoteChange, StoredMemory};
use super::periodic::{CheckpointSource, Periodic, writes};
use super::queue::{Queue, QueueLimits};
use super::shrunk_memory::SET_ASIDE;
use super::status::Status;
use super::store::Store;

/// A memory, and its name in the file.
#[derive(Debug, Clone)]
pub struct Member {
    pub name: String,
    pub memory: Arc<Memory>,
}

/// How contents are stored.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Contents are stored after this time; with 0, before a write is answered.
    pub sync: Duration,
    /// What may wait with `sync` 0.
    pub queue: QueueLimits,
    /// With `sync` 0 and no step for this time: the file is looked for, and after an I/O error the next attempt
    /// follows.
    pub retry: Duration,
    /// A disk that does not answer for longer is an error in the status.
    pub patience: Duration,
}

impl Options {
    pub const fn new(sync: Duration) -> Options {
        Options {
            sync,
            queue: QueueLimits::DEFAULT,
            retry: Duration::from_secs(1),
            patience: Duration::from_secs(5),
        }
    }

    /// Whether a write is stored before it is answered.
    const fn stores_before_reply(&self) -> bool {
        self.sync.is_zero()
    }
}

/// Memories that a file keeps.
#[derive(Debug)]
pub struct MemoryFile {
    members: Vec<Member>,
    options: Options,
    loaded: Vec<String>,
    warnings: Vec<String>,
    /// What the log had noted when the file was opened.
    note: Option<Vec<u8>>,
    queue: Arc<Queue>,
    status: Arc<Mutex<Status>>,
    /// How many writes there were at the start. To load contents counts as one.
    first_writes: AtomicU64,
    /// How many writes to the memories are in the file, with a `sync` above 0.
    stored_writes: Arc<AtomicU64>,
    /// The process that opened the file. A forked child must not touch it.
    process: u32,
    state: Mutex<State>,
}

#[derive(Debug)]
enum State {
    Loaded(Box<Store>),
    Running(JoinHandle<Result<(), FileError>>),
    Stopped,
}

impl MemoryFile {
    /// Opens or creates the file, and loads contents into the memories before anybody uses them. With
    /// `sync` 0 it becomes their journal; until [`MemoryFile::start`], it carries out writes at once.
    ///
    /// # Errors
    /// [`FileError`], for a file that can't be used, and for memories that can't be kept in one file.
    /// Nothing has changed then.
    pub fn open(
        disk: Arc<dyn Disk>,
        members: Vec<Member>,
        options: Options,
    ) -> Result<MemoryFile, FileError> {
        MemoryFile::load(disk, members, options, false)
    }

    /// As [`MemoryFile::open`], for all memories of a log. Whether they are sealed is in the note.
    ///
    /// # Errors
    /// As [`MemoryFile::open`], and [`FileError::OfLog`] for contents that are not of a log.
    pub fn open_of_log(
        disk: Arc<dyn Disk>,
        mut members: Vec<Member>,
        options: Options,
    ) -> Result<MemoryFile, FileError> {
        // A memory has one journal, and that is the log.
        if options.stores_before_reply() {
            return Err(FileError::Memories("sync is 0, but the log confirms writes".to_owned()));
        }
        members.sort_by(|one, other| one.name.cmp(&other.name));
        MemoryFile::load(disk, members, options, true)
    }

    fn load(
        disk: Arc<dyn Disk>,
        members: Vec<Member>,
        options: Options,
        is_of_log: bool,
    ) -> Result<MemoryFile, FileError> {
        check(&members)?;
        let status = Arc::new(Mutex::new(Status::default()));
        let store = Store::open(disk, Arc::clone(&status))?;
        let note =
            if is_of_log { note_of(store.image(), &members)? } else { store.image().note.clone() };
        let (mut loaded, mut warnings) = (Vec::new(), Vec::new());
        for Member { name, memory } in &members {
            let Some(stored) = store.image().named(name) else { continue };
            if is_of_log {
                let areas = stored.areas.clone();
                memory.restore(&Contents { areas, sealed: memory.sealed() });
            } else {
                let set_aside = store.image().set_aside_of(name);
                warnings.extend(stored.resizings(set_aside, memory.layout()));
                let mut areas = stored.with(set_aside).resized(memory.layout());
                let sealed = memory
                    .gate()
                    .is_some_and(|gate| gate.restore_seal(memory.layout(), &mut areas));
                memory.restore(&Contents { areas, sealed });
            }
            loaded.push(name.clone());
        }
        for stored in &store.image().memories {
            let name = &stored.name;
            if stored.set_aside_of().is_none() && members.iter().all(|member| member.name != *name)
            {
                warnings
                    .push(format!("{name}: is in the file but not configured, and stays there"));
            }
        }
        let memories: Vec<_> = members.iter().map(|member| Arc::clone(&member.memory)).collect();
        let queue = Arc::new(Queue::new(memories, options.queue, Arc::clone(&status)));
        if options.stores_before_reply() {
            for (number, member) in (0..).zip(&members) {
                member.memory.keep_in(Arc::clone(&queue) as _, number);
            }
        }
        let state = Mutex::new(State::Loaded(Box::new(store)));
        let (process, stored_writes) = (process::id(), Arc::default());
        Ok(MemoryFile {
            members,
            options,
            loaded,
            warnings,
            note,
            queue,
            status,
            first_writes: AtomicU64::new(0),
            stored_writes,
            process,
            state,
        })
    }

    /// The names of the memories whose contents come from the file.
    pub fn loaded(&self) -> &[String] {
        &self.loaded
    }

    /// What is unusual about the file, in sentences.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// What the log had noted with the contents that were loaded; of a file that is not opened as that of a
    /// log, too.
    pub fn note(&self) -> Option<&[u8]> {
        self.note.as_deref()
    }

    /// Stores what the memories contain, or the contents of their log, and goes on storing. A second call
    /// does nothing.
    ///
    /// # Errors
    /// [`FileError`] if the contents can't be stored, or the log has none. They are then still not stored.
    pub fn start(&self, log: Option<Arc<dyn CheckpointSource>>) -> Result<(), FileError> {
        let mut state = self.state();
        let State::Loaded(store) = &mut *state else { return Ok(()) };
        let memories: Vec<_> = self.members.iter().map(|m| Arc::clone(&m.memory)).collect();
        let mut ids = Vec::new();
        // No step may come between the contents that are stored and the first that waits.
        self.queue.begin(|| {
            let written = writes(&memories);
            self.first_writes.store(written, Ordering::Relaxed);
            self.stored_writes.store(written, Ordering::Relaxed);
            let (contents, note) = match &log {
                None => (Memory::contents(&memories), None),
                Some(log) => {
                    log.checkpoint().map(|(contents, note)| (contents, Some(note))).ok_or_else(
                        || FileError::OfLog("the log has no contents to store".to_owned()),
                    )?
                }
            };
            let mut changes;
            (changes, ids) = first_changes(store.image(), &self.members, contents)?;
            if store.image().note != note {
                changes.note = note.map_or(NoteChange::Remove, NoteChange::Set);
            }
            store.store(changes)
        })?;
        let State::Loaded(store) = mem::replace(&mut *state, State::Stopped) else {
            unreachable!("the state is locked")
        };
        let (queue, retry) = (Arc::clone(&self.queue), self.options.retry);
        let store_loop: Box<dyn FnOnce() -> Result<(), FileError> + Send> =
            if self.options.stores_before_reply() {
                let before_reply = BeforeReply::new(*store, memories, ids, queue, retry);
                Box::new(|| before_reply.run())
            } else {
                let (sync, stored_writes) = (self.options.sync, Arc::clone(&self.stored_writes));
                let periodic =
                    Periodic { store: *store, memories, ids, queue, sync, stored_writes, log };
                Box::new(|| periodic.run())
            };
        let (queue, status) = (Arc::clone(&self.queue), Arc::clone(&self.status));
        let thread = thread::Builder::new().name("memory file".to_owned()).spawn(move || {
            let ended = catch_unwind(AssertUnwindSafe(store_loop)).unwrap_or_else(|_| {
                let error = FileError::Io(io::Error::other("the thread that stores has panicked"));
                let mut status = lock(&status);
                (status.failing, status.busy_since) = (Some(error.to_string()), None);
                Err(error)
            });
            queue.end();
            ended
        });
        *state = State::Running(thread.inspect_err(|_| self.queue.end())?);
        Ok(())
    }

    /// Stores what is left, and closes the file. Steps are refused from now on. A second call does
    /// nothing.
    ///
    /// # Errors
    /// [`FileError`] if the last contents are not stored.
    pub fn stop(&self) -> Result<(), FileError> {
        if self.process != process::id() {
            return Ok(());
        }
        let mut state = self.state();
        let stopped = mem::replace(&mut *state, State::Stopped);
        self.queue.stop();
        match stopped {
            State::Loaded(store) => store.close(),
            State::Running(thread) => thread.join().unwrap_or(Ok(())),
            State::Stopped => Ok(()),
        }
    }

    pub fn status(&self) -> Status {
        let mut status = lock(&self.status).clone();
        let written: u64 = self.members.iter().map(|member| member.memory.writes()).sum();
        status.pending = if status.is_away {
            // The contents of earlier starts are away too. Nobody knows how many writes they were, but their
            // loss must show.
            let since_start = written.saturating_sub(self.first_writes.load(Ordering::Relaxed));
            since_start.max(u64::from(!self.loaded.is_empty()))
        } else if self.options.stores_before_reply() {
            self.queue.waiting() as u64
        } else {
            written.saturating_sub(self.stored_writes.load(Ordering::Relaxed))
        };
        let patience = self.options.patience;
        if status.busy_since.is_some_and(|since| since.elapsed() > patience) {
            let text = format!("the disk has not answered for {} s", patience.as_secs_f64());
            status.failing = Some(text);
        }
        status
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

impl Drop for MemoryFile {
    fn drop(&mut self) {
        if self.process != process::id() {
            // The file belongs to the parent, and the thread does not exist here.
            let state = self.state.get_mut().unwrap_or_else(PoisonError::into_inner);
            return mem::forget(mem::replace(state, State::Stopped));
        }
        // A caller that needs the result calls it before.
        let _ = self.stop();
    }
}

/// Checks that memories can be kept in one file.
fn check(members: &[Member]) -> Result<(), FileError> {
    for (number, Member { name, memory }) in members.iter().enumerate() {
        let twice = members[..number]
            .iter()
            .any(|other| other.name == *name || Arc::ptr_eq(&other.memory, memory));
        if twice {
            return Err(FileError::Memories(format!("memory {name} is given twice")));
        }
        if name.ends_with(SET_ASIDE) {
            let text = format!("memory {name}: {SET_ASIDE} at the end of a name is not allowed");
            return Err(FileError::Memories(text));
        }
        if memory.has_journal() {
            return Err(FileError::Memories(format!("memory {name} is kept elsewhere already")));
        }
    }
    Ok(())
}

/// The note of the log, if the file has the contents of its memories; `None` if it has none yet.
fn note_of(image: &Image, members: &[Member]) -> Result<Option<Vec<u8>>, FileError> {
    let all = || members.iter().map(|member| (member, image.named(&member.name)));
    if image.note.is_none() && all().all(|(_, stored)| stored.is_none()) {
        return Ok(None);
    }
    let advice = "move the file away to start with the contents of the log";
    let Some(note) = &image.note else {
        let text = format!(
            "the file has contents that are not of a log: export it first, and use that as 'initial' if a \
             new log is to begin with them; then {advice}"
        );
        return Err(FileError::OfLog(text));
    };
    for (Member { name, memory }, stored) in all() {
        if stored.is_none_or(|stored| stored.layout != *memory.layout()) {
            let text = format!("the file has other areas of memory {name}: {advice}");
            return Err(FileError::OfLog(text));
        }
    }
    Ok(Some(note.clone()))
}

/// What the file lacks of the memories, and their numbers in it.
fn first_changes(
    image: &Image,
    members: &[Member],
    contents: Vec<Contents>,
) -> Result<(Changes, Vec<u16>), FileError> {
    let (mut changes, mut ids) = (Changes::default(), Vec::new());
    let mut free = image.free_ids();
    for (Member { name, memory }, contents) in members.iter().zip(contents) {
        let (stored, layout) = (image.named(name), memory.layout());
        let mut id_of = |stored: Option<&StoredMemory>| {
            stored.map(|stored| stored.id).or_else(|| free.next()).ok_or_else(|| {
                let text = format!("no place for memory {name}: the file has 65536 memories");
                FileError::Memories(text)
            })
        };
        let id = id_of(stored)?;
        ids.push(id);
        // The same layout: only pages that differ are stored.
        if stored.is_some_and(|stored| stored.layout == *layout) {
            changes.pages.extend(image.differing(id, &contents));
            continue;
        }
        if let Some(stored) = stored {
            let set_aside = image.set_aside_of(name);
            match stored.cut(set_aside, layout) {
                Some((layout, areas)) => {
                    let (name, id) = (format!("{name}{SET_ASIDE}"), id_of(set_aside)?);
                    changes.memories.push(StoredMemory { name, id, layout, areas });
                }
                None => changes.removed.extend(set_aside.map(|old| (old.name.clone(), old.id))),
            }
        }
        let (areas, layout) = (contents.areas, layout.clone());
        changes.memories.push(StoredMemory { name: name.clone(), id, layout, areas });
    }
    Ok((changes, ids))
}
