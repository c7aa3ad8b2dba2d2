//! The poller: reads devices on schedule, and hands what they answered to memory and to others.
//!
//! * A device is a task: its schedule, its plan, its counters and its status ([`device`]).
//! * Devices behind the same address share a link, and a link knows no device ([`link`]).
//! * What is read is written as it came, byte for byte, one read as one step; a read that fails
//!   writes nothing ([`sink`]).
//!
//! All tasks of a poller live on one thread, so that they share without locks.

mod backoff;
mod caught;
mod cost;
mod device;
mod forward;
mod handshake;
mod learned;
mod link;
mod pace;
pub mod plan;
mod results;
mod search;
mod sink;
mod state;
mod status;
mod thread;

pub use device::{DeviceSettings, ReadSettings};
pub use forward::{ForwardCounters, ForwardSettings};
pub use pace::InFlight;
pub use results::{Batch, BlockResult, Poll, Results, Written};
pub use sink::Destination;
pub use state::{DeviceCounters, DeviceState};
pub use status::{Fault, Health, StatusSettings};
pub use thread::{Polled, Poller, PollerError};
