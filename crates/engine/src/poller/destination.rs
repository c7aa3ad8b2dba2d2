//! The destination of a read.

use std::sync::Arc;

use holdfast_memory::{Area, Memory, Write};

/// A range of a memory.
#[derive(Debug, Clone)]
pub struct Destination {
    pub memory: Arc<Memory>,
    pub area: Area,
    pub address: u16,
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
