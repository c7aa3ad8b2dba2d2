//! What answers a request: order of checks, broadcasts, memory, journal, files, queues, listen only mode,
//! identity.

pub(crate) mod broadcast;
pub(crate) mod exceptions;
pub(crate) mod fifo_queue;
pub(crate) mod file_records;
pub mod identity;
pub(crate) mod journaled_write;
pub(crate) mod listen_only;
pub mod unit_server;

use holdfast_memory::{Area, Read, Write};
use holdfast_protocol::pdu::Range;

#[inline]
fn reading<const MAX: u16>(area: Area, range: Range<MAX>, out: &mut [u8]) -> Read<'_> {
    Read { area, address: range.address(), count: usize::from(range.quantity()), out }
}

#[inline]
fn writing(area: Area, address: u16, count: u16, bytes: &[u8]) -> Write<'_> {
    Write { area, address, count: usize::from(count), bytes }
}
