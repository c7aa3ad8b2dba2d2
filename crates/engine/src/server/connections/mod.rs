//! Connections: which are admitted, which must wait for others, and their way from bytes to replies.

pub(crate) mod admission;
pub(crate) mod closing;
pub(crate) mod connection;
pub(crate) mod deadlines;
mod eviction;
pub(crate) mod given_up;
pub(crate) mod listener;
pub(crate) mod peer;
pub(crate) mod reloadable;
pub(crate) mod reply_order;
pub(crate) mod worker_share;
