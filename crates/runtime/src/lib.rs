//! What everything that runs for long shares: the pauses after failures, counters, locks, and a clock.

#![forbid(unsafe_code)]

mod backoff;
mod clock;
mod counter;
mod lock;

pub use backoff::Retry;
pub use clock::{Epoch, time_since_boot};
pub use counter::Counter;
pub use lock::lock;
