//! The poller: reads devices on schedule, and passes the results to memory and to other receivers.
//!
//! * A device is a task with its schedule, plan, counters and status ([`device`]).
//! * Devices behind the same address share a link. A link does not know its devices ([`crate::link`]).
//! * A read is written to memory unchanged and atomically. A failed read writes nothing ([`sink`]).
//!
//! All tasks of a poller run on one thread, so that they share state without locks.

mod cost;
mod device;
mod health;
mod learned;
mod mirror_age;
mod panic_guard;
pub mod plan;
mod raw_ingest;
mod results;
mod roster;
mod search;
mod sink;
mod state;
mod status;
mod thread;
mod turn;
mod write_through;

pub use device::{DeviceSettings, ReadSettings};
pub use mirror_age::MirrorAge;
pub use raw_ingest::{ForwardCounters, ForwardFailure, ForwardSettings};
pub use results::{Batch, BlockResult, Poll, Results, Written};
pub use sink::Destination;
pub use state::{DeviceCounters, DeviceState};
pub use status::{BlockSettings, StatusSettings};
pub use thread::{Polled, Poller, PollerError};
pub use write_through::{Passage, PassedRange};
