//! What everything that runs for long shares: the pauses after failures, counters, and locks.

#![forbid(unsafe_code)]

mod backoff;
mod counter;
mod lock;

pub use backoff::Retry;
pub use counter::Counter;
pub use lock::lock;
