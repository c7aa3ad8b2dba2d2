//! Read and write operations: a range and its bytes, and the kind of their source.

use crate::area::Area;

/// The kind of a reader or writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// A reader or writer that a sealed memory refuses. It can never write the gate bit.
    Client,
    /// A source of data. It ignores the seal and can open it.
    Ingest,
    /// A source of data that a memory admits only while it is sealed. It can open the seal.
    Restore,
    /// A source of data that alone writes the mirrored ranges.
    Mirror,
}

/// A range to read, of at least one item, and the buffer that receives it: `out` has exactly
/// `area.byte_len(count)` bytes.
#[derive(Debug)]
pub struct Read<'a> {
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub out: &'a mut [u8],
}

/// A range to write, of at least one item, and its new content: `bytes` has exactly
/// `area.byte_len(count)` bytes, registers big-endian, bits packed least significant bit first.
/// Bits after the first `count` are ignored.
#[derive(Debug, Clone, Copy)]
pub struct Write<'a> {
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub bytes: &'a [u8],
}
