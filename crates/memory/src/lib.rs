//! A Modbus memory: four areas of fixed size. It does not know what a value means.
//!
//! The rules this crate keeps:
//!
//! * Registers are stored as big-endian bytes, bits packed least significant bit first. A Modbus
//!   reply is a copy of a range, not a loop over values.
//! * A memory has one reader-writer lock. A read sees all of a write or none of it, even when the
//!   write spans several areas.
//! * All checks run before the first byte changes. A refused write changes nothing.
//! * The seal is checked under the same lock as the operation it guards.
//! * Memory is allocated once. No operation allocates, except a write to several memories: it
//!   keeps a list of locks, and flattens a large batch before it takes them. A write to a memory
//!   with observers is copied into their queues.
//! * If a memory has a journal, the journal alone changes it: every write becomes a step, which the
//!   journal carries out when it has kept it.
//! * Ranges that mirror a device can have a [`Freshness`], which knows a clock: while a range is stale,
//!   only the mirror uses it.
//!
//! It does no I/O, has no clock, and knows no protocol: an address is a number, a bit is a bit, a
//! register is two bytes.

#![forbid(unsafe_code)]

mod area;
mod bits;
mod error;
mod follower;
mod memory;
mod mirrored;
mod operation;
mod runs;
mod seal;
mod step;
mod write_queue;

pub use area::{Area, Layout, Span};
pub use error::{LayoutError, Refusal, Refused};
pub use follower::{Change, Follower};
pub use memory::checks::check_across;
pub use memory::several_memories::{access_of, submit_across, write_across};
pub use memory::{Contents, Memory};
pub use mirrored::{Freshness, Mirrored};
pub use operation::{Access, Read, Write};
pub use seal::{Gate, GateMode};
pub use step::{
    Action, CarriedOut, Done, Journal, Operation, Outcome, Step, StepWrite, Tenure, Term,
};
pub use write_queue::{WriteQueue, Written};
