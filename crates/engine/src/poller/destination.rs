//! What is read from a device, and where it goes.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use holdfast_memory::{Area, Memory, Write};

use super::mirror_age::MirrorAge;

#[derive(Debug, Clone)]
pub struct ReadSettings {
    pub area: Area,
    pub address: u16,
    /// Any number. A read that does not fit into one request takes several, and is written
    /// atomically.
    pub count: u32,
    pub into: Option<Destination>,
    /// Whether the receivers of the device get it.
    pub forward: bool,
}

impl ReadSettings {
    /// The time of the clock of its age, if that is watched.
    pub(super) fn now(&self) -> Option<Duration> {
        self.into.as_ref()?.age.as_ref().map(|age| age.now())
    }
}

/// A range of a memory.
#[derive(Debug, Clone)]
pub struct Destination {
    pub memory: Arc<Memory>,
    pub area: Area,
    pub address: u16,
    /// Renewed by what is read into it, if its age is watched.
    pub age: Option<Arc<MirrorAge>>,
}

/// What is read into memories, and where to. Another age is that of values from elsewhere.
pub(super) fn mirrors(reads: &[ReadSettings]) -> impl Iterator<Item = impl PartialEq> {
    reads.iter().filter_map(|read| {
        let Destination { memory, area, address, age } = read.into.as_ref()?;
        let into = (Arc::as_ptr(memory), *area, *address, age.as_ref().map(Arc::as_ptr));
        Some((read.area, read.address, read.count, into))
    })
}

impl Destination {
    /// The write of a whole read.
    pub(super) fn writing<'b>(&self, count: u32, bytes: &'b [u8]) -> Write<'b> {
        let Destination { area, address, .. } = *self;
        Write { area, address, count: count as usize, bytes }
    }

    /// What tells it apart from others, whatever the number of items.
    pub(super) fn start(&self) -> (*const Memory, Area, u16) {
        (Arc::as_ptr(&self.memory), self.area, self.address)
    }

    /// Whether `count` items fit.
    pub(super) fn holds(&self, count: u32) -> bool {
        self.memory.span(self.area).holds(self.address, count as usize)
    }
}

/// Whether memory has stored or refused what was read into a range. A journal reports it from any thread, often
/// after the poll has ended, so a poll is judged by the newest outcome that is known.
#[derive(Debug, Default)]
pub(super) struct WriteOutcomes {
    /// The number of the last write.
    begun: AtomicU64,
    /// Twice the number of the newest write with an outcome, plus 1 if it was refused.
    newest: AtomicU64,
}

impl WriteOutcomes {
    /// Returns the number of a new write.
    pub(super) fn begin(&self) -> u64 {
        self.begun.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Records the outcome of a write. It is ignored if that of a later one is known: a journal that takes no
    /// more writes refuses them at once, while earlier ones are still being stored.
    pub(super) fn end(&self, number: u64, is_stored: bool) {
        self.newest.fetch_max(number * 2 + u64::from(!is_stored), Ordering::Relaxed);
    }

    /// Outcomes of the writes so far do not count any more.
    pub(super) fn forget(&self) {
        self.end(self.begin(), true);
    }

    pub(super) fn is_refused(&self) -> bool {
        self.newest.load(Ordering::Relaxed) % 2 == 1
    }
}
