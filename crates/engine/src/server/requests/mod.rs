//! What answers a request: order of checks, memory, journal, files, queues, listen only mode,
//! identity.

pub(crate) mod exceptions;
pub(crate) mod fifo_queue;
pub(crate) mod file_records;
pub mod identity;
pub(crate) mod journaled_write;
pub(crate) mod listen_only;
pub(crate) mod memory_operations;
pub mod unit_server;
