//! A Modbus memory: four areas of fixed size, and nothing that knows what a value means.
//!
//! The rules this crate keeps:
//!
//! * Registers are stored as big-endian bytes, bits packed least significant bit first: what a
//!   Modbus reply wants is a copy of a range, not a loop over values.
//! * A memory has one lock. Any number of readers share it; a writer has it alone. So a read sees
//!   all of a write or none of it, however many areas the write spans.
//! * Everything that can be refused is refused before the first byte changes. A refused write
//!   leaves every byte as it was.
//! * The seal is judged under the same lock as the operation it guards.
//! * Memory is allocated once. No operation allocates, except a write over several memories, which
//!   keeps a list of its locks, and flattens a large batch before it takes them.
//!
//! It does no I/O, keeps no clock, and knows no protocol: an address is a number, a bit is a bit,
//! a register is two bytes.

#![forbid(unsafe_code)]

mod area;
mod batch;
mod bits;
mod error;
mod memory;
mod operation;

pub use area::{Area, Layout, Span};
pub use error::{LayoutError, Refusal, Refused};
pub use memory::{Access, Gate, GateMode, Memory, write_across};
pub use operation::{Read, Write};
