//! What is reported: counters, events, audit records.

pub mod audit;
pub(crate) mod comm_events;
pub mod counters;
pub mod event;
pub(crate) mod refused_request;
