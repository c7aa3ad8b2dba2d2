//! What is read from a device, and where it goes.

use std::sync::Arc;
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

    /// Whether `count` items fit.
    pub(super) fn holds(&self, count: u32) -> bool {
        self.memory.span(self.area).holds(self.address, count as usize)
    }
}
