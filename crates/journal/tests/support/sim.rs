//! A disk in memory that loses power and fails on demand.
//!
//! What was written and not synced is kept apart. When the power fails, any part of it reaches the
//! disk: whole sectors, in any order. Lengths are metadata, which a file system keeps in order.

use std::io;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use holdfast_journal::file::{Disk, FileError, Overlay};
use redb::{Builder, Database, StorageBackend};

use super::Random;

const SECTOR: usize = 512;

#[derive(Debug, Default)]
pub struct SimDisk {
    state: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    file: Option<File>,
    beside: Option<File>,
    /// Counts files: a handle to another file is not one to this.
    created: u64,
    /// How many operations follow until the power fails.
    until_cut: Option<u64>,
    off: bool,
    random: u64,
    /// One in so many syncs fails, and forgets what was to be written.
    failing_syncs: Option<u64>,
    /// Every change fails.
    broken: bool,
    /// Files can't be longer.
    capacity: Option<u64>,
    held: bool,
    /// How many operations wait because the disk is held.
    blocked: u64,
    pub operations: u64,
    pub syncs: u64,
}

#[derive(Debug, Clone, Default)]
struct File {
    number: u64,
    /// What programs see.
    seen: Vec<u8>,
    /// What is on the disk.
    disk: Vec<u8>,
    unsynced: Vec<Change>,
}

#[derive(Debug, Clone)]
enum Change {
    Len(u64),
    Sector(u64, Vec<u8>),
}

impl File {
    fn write(&mut self, offset: u64, data: &[u8]) {
        let at = offset as usize;
        self.seen[at..at + data.len()].copy_from_slice(data);
        let mut done = 0;
        while done < data.len() {
            let from = at + done;
            let len = (SECTOR - from % SECTOR).min(data.len() - done);
            let sector = data[done..done + len].to_vec();
            self.unsynced.push(Change::Sector(from as u64, sector));
            done += len;
        }
    }

    fn set_len(&mut self, len: u64) {
        self.seen.resize(len as usize, 0);
        self.unsynced.push(Change::Len(len));
    }

    fn sync(&mut self) {
        self.unsynced.clear();
        self.disk = self.seen.clone();
    }

    /// Leaves on the disk what a power cut leaves.
    fn cut(&mut self, random: &mut Random) {
        let mut changes = std::mem::take(&mut self.unsynced);
        let lens = changes.iter().filter(|change| matches!(change, Change::Len(_))).count();
        let mut lens = random.below(lens as u64 + 1);
        let share = 1 + random.below(4);
        changes.retain(|change| match change {
            Change::Len(_) => lens.checked_sub(1).map(|left| lens = left).is_some(),
            Change::Sector(..) => random.below(4) < share,
        });
        // Sectors that were written twice may have either content.
        for at in (1..changes.len()).rev() {
            let other = random.below(at as u64 + 1) as usize;
            let both_sectors =
                [at, other].iter().all(|at| matches!(changes[*at], Change::Sector(..)));
            if both_sectors {
                changes.swap(at, other);
            }
        }
        for change in changes.iter().filter(|change| matches!(change, Change::Len(_))) {
            let Change::Len(len) = change else { unreachable!() };
            self.disk.resize(*len as usize, 0);
        }
        for change in &changes {
            if let Change::Sector(offset, data) = change {
                let from = (*offset as usize).min(self.disk.len());
                let end = (from + data.len()).min(self.disk.len());
                self.disk[from..end].copy_from_slice(&data[..end - from]);
            }
        }
        self.seen = self.disk.clone();
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins an operation that changes something. The power may fail in it.
    fn changing(&self) -> io::Result<MutexGuard<'_, State>> {
        let mut state = self.state();
        state.blocked += 1;
        self.changed.notify_all();
        while state.held && !state.off {
            state = self.changed.wait(state).unwrap();
        }
        state.blocked -= 1;
        state.operations += 1;
        match &mut state.until_cut {
            Some(0) => state.off = true,
            Some(left) => *left -= 1,
            None => {}
        }
        if state.off {
            return Err(io::Error::other("the power is off"));
        }
        if state.broken {
            return Err(io::Error::other("the disk is broken"));
        }
        Ok(state)
    }
}

impl SimDisk {
    pub fn with_file(bytes: Vec<u8>) -> SimDisk {
        let sim = SimDisk::default();
        let file = File { number: 1, disk: bytes.clone(), seen: bytes, unsynced: Vec::new() };
        let mut state = sim.state.state();
        state.created = 1;
        state.file = Some(file);
        drop(state);
        sim
    }

    pub fn bytes(&self) -> Vec<u8> {
        self.state.state().file.as_ref().unwrap().seen.clone()
    }

    pub fn operations(&self) -> u64 {
        self.state.state().operations
    }

    pub fn syncs(&self) -> u64 {
        self.state.state().syncs
    }

    pub fn cut_after(&self, operations: u64, seed: u64) {
        let mut state = self.state.state();
        state.until_cut = Some(operations);
        state.random = seed;
    }

    pub fn fail_syncs(&self, one_in: Option<u64>) {
        self.state.state().failing_syncs = one_in;
    }

    pub fn set_broken(&self, broken: bool) {
        self.state.state().broken = broken;
    }

    pub fn set_capacity(&self, capacity: Option<u64>) {
        self.state.state().capacity = capacity;
    }

    /// Keeps operations waiting, or lets them go on.
    pub fn hold(&self, held: bool) {
        self.state.state().held = held;
        self.state.changed.notify_all();
    }

    pub fn is_blocking(&self) -> bool {
        self.state.state().blocked > 0
    }

    pub fn is_off(&self) -> bool {
        self.state.state().off
    }

    /// The disk after the power has come back.
    pub fn power_back(&self) -> SimDisk {
        let mut old = self.state.state();
        old.off = true;
        self.state.changed.notify_all();
        let mut random = Random(old.random);
        let mut file = old.file.clone();
        if let Some(file) = &mut file {
            file.cut(&mut random);
        }
        let state = State { file, created: old.created, ..State::default() };
        SimDisk { state: Arc::new(Shared { state: Mutex::new(state), changed: Condvar::new() }) }
    }

    fn handle(&self, number: u64) -> Handle {
        Handle { state: Arc::clone(&self.state), number }
    }

    fn number(&self) -> u64 {
        self.state.state().file.as_ref().unwrap().number
    }
}

impl Disk for SimDisk {
    fn size(&self) -> Result<Option<u64>, FileError> {
        Ok(self.state.state().file.as_ref().map(|file| file.seen.len() as u64))
    }

    fn open(&self, builder: &Builder) -> Result<Database, FileError> {
        Ok(builder.create_with_backend(self.handle(self.number()))?)
    }

    fn open_unchanged(&self, builder: &Builder) -> Result<Database, FileError> {
        Ok(builder.create_with_backend(Overlay::new(self.handle(self.number())))?)
    }

    fn create(&self, builder: &Builder) -> Result<Database, FileError> {
        let mut state = self.state.changing()?;
        state.created += 1;
        let number = state.created;
        state.beside = Some(File { number, ..File::default() });
        drop(state);
        Ok(builder.create_with_backend(self.handle(number))?)
    }

    fn is_in_place(&self) -> Result<bool, FileError> {
        Ok(self.state.state().file.is_some())
    }

    fn install(&self) -> Result<(), FileError> {
        let mut state = self.state.changing()?;
        state.file = state.beside.take();
        Ok(())
    }

    fn discard(&self) {
        self.state.state().beside = None;
    }
}

/// An open file. A file that was replaced is still there for its handles.
#[derive(Debug)]
struct Handle {
    state: Arc<Shared>,
    number: u64,
}

impl Handle {
    fn file<'s>(&self, state: &'s mut State) -> io::Result<&'s mut File> {
        let number = self.number;
        let files = [&mut state.file, &mut state.beside].into_iter().flatten();
        let mut files = files.filter(|file| file.number == number);
        files.next().ok_or_else(|| io::Error::other("the file is gone"))
    }
}

impl StorageBackend for Handle {
    fn len(&self) -> io::Result<u64> {
        Ok(self.file(&mut self.state.state())?.seen.len() as u64)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let mut state = self.state.state();
        let file = self.file(&mut state)?;
        let from = usize::try_from(offset).unwrap();
        let seen = file.seen.get(from..from + out.len());
        out.copy_from_slice(seen.ok_or(io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        let mut state = self.state.changing()?;
        if state.capacity.is_some_and(|capacity| len > capacity) {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.file(&mut state)?.set_len(len);
        Ok(())
    }

    fn sync_data(&self) -> io::Result<()> {
        let mut state = self.state.changing()?;
        state.syncs += 1;
        let mut random = Random(state.random);
        let fails = state.failing_syncs.is_some_and(|one_in| random.one_in(one_in));
        state.random = random.0;
        let file = self.file(&mut state)?;
        if fails {
            file.unsynced.clear();
            return Err(io::Error::other("the disk did not sync"));
        }
        file.sync();
        Ok(())
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let mut state = self.state.changing()?;
        self.file(&mut state)?.write(offset, data);
        Ok(())
    }
}
