//! What everything that runs for long shares: the pauses after failures, counters, locks, threads that a value
//! owns, and a clock.

#![forbid(unsafe_code)]

mod backoff;
mod clock;
mod counter;
mod lock;
mod own_threads;

pub use backoff::Retry;
pub use clock::{Epoch, suspend_aware_time};
pub use counter::Counter;
pub use lock::lock;
pub use own_threads::OwnThreads;
