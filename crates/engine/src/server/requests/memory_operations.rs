//! What requests ask of a memory.

use holdfast_memory::{Area, Read, Write};
use holdfast_protocol::pdu::Range;

#[inline]
pub(in crate::server) fn reading<const MAX: u16>(
    area: Area,
    range: Range<MAX>,
    out: &mut [u8],
) -> Read<'_> {
    Read { area, address: range.address(), count: usize::from(range.quantity()), out }
}

#[inline]
pub(in crate::server) fn writing(area: Area, address: u16, count: u16, bytes: &[u8]) -> Write<'_> {
    Write { area, address, count: usize::from(count), bytes }
}
