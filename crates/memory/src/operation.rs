//! One read or write: a range, and its bytes.

use crate::area::Area;

/// A range of at least one item to read, and where to: `out` has exactly `area.byte_len(count)` bytes.
#[derive(Debug)]
pub struct Read<'a> {
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub out: &'a mut [u8],
}

/// A range of at least one item to write, and its new content: `bytes` has exactly `area.byte_len(count)` bytes,
/// registers big-endian, bits packed least significant bit first. Bits beyond `count` in the last
/// byte are ignored.
#[derive(Debug, Clone, Copy)]
pub struct Write<'a> {
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub bytes: &'a [u8],
}
