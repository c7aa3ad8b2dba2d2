//! The poller: reads devices on schedule, and passes the results to memory and to other receivers.
//!
//! * A device is a task with its schedule, plan, counters and status ([`device`]).
//! * Devices behind the same address share a link. A link does not know its devices ([`crate::link`]).
//! * A read is written to memory unchanged and atomically. A failed read writes nothing ([`destination`]).
//!
//! All tasks of a poller run on one thread, so that they share state without locks.

mod bisection;
mod cost;
mod destination;
mod device;
mod forwarding;
mod health;
mod mirror_age;
mod panic_guard;
pub mod plan;
mod poll_pause;
mod remembered_refusals;
mod results;
mod schedule;
mod standby;
mod state;
mod status;
mod thread;
mod turn;
mod write_through;

pub use cost::UNMEASURED_COST_MS;
pub use destination::{Destination, ReadSettings};
pub use device::DeviceSettings;
pub use forwarding::{ForwardCounters, ForwardFailure, ForwardSettings};
pub use mirror_age::MirrorAge;
pub use remembered_refusals::RETRY_REFUSED_AFTER;
pub use results::{Batch, BlockResult, Poll, Results, Written};
pub use schedule::first_poll_spread;
pub use state::{DeviceCounters, DeviceState};
pub use status::{BlockSettings, StatusSettings};
pub use thread::{Polled, Poller, PollerError};
pub use write_through::{Passage, PassedRange};
