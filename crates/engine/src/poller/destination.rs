//! What is read from a device, and where it goes.

use std::sync::Arc;

use holdfast_memory::{Area, Memory, Write};

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
