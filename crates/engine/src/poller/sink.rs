//! The destination of a read.

use std::sync::Arc;

use holdfast_memory::{Access, Area, Memory, Refusal, Write};

/// A range of a memory.
#[derive(Debug, Clone)]
pub struct Destination {
    pub memory: Arc<Memory>,
    pub area: Area,
    pub address: u16,
}

impl Destination {
    /// Writes the whole read, atomically.
    ///
    /// # Errors
    /// [`Refusal::OutOfRange`] when the read does not fit. Nothing has changed then.
    pub(super) fn write(&self, count: u32, bytes: &[u8]) -> Result<(), Refusal> {
        let Destination { area, address, .. } = *self;
        let write = Write { area, address, count: count as usize, bytes };
        self.memory.write(Access::Mirror, write)
    }

    /// Whether `count` items fit.
    pub(super) fn holds(&self, count: u32) -> bool {
        self.memory.span(self.area).holds(self.address, count as usize)
    }
}
