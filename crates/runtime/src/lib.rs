//! What everything that runs for long shares: the pauses after failures.

#![forbid(unsafe_code)]

mod backoff;

pub use backoff::Retry;
