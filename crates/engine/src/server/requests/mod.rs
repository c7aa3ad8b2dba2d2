//! What answers a request: order of checks, memory, journal, listen only mode, identity.

pub mod identity;
pub(crate) mod journaled_write;
pub(crate) mod listen_only;
pub(crate) mod memory_operations;
pub mod unit_server;
