//! The data plane: Modbus and Raw Ingest listeners, clients and the poller, on their own threads.
//!
//! The rules this crate keeps:
//!
//! * The rights of a connection are fixed when it is accepted: its source address selects one rule
//!   ([`server::rights::policy`]), compiled to two tables. A request costs two look-ups.
//! * Requests that arrive together are answered together, in order, with one write
//!   (`server::connections::connection`). The path from request to reply ([`server::requests::unit_server`]) does not
//!   allocate.
//! * One peer cannot delay another: every buffer has a limit, every wait has a deadline, and code
//!   on a worker thread waits for nothing but its sockets.
//! * Counters and events report what happens. Reporting never blocks.
//!
//! It does not know Python, JSON, or any type wider than a bit or a register.

#![forbid(unsafe_code)]

pub mod client;
mod counter;
mod heartbeat;
pub mod http;
pub mod items;
pub mod link;
mod name_lookup;
pub mod poller;
pub mod raw_ingest_areas;
mod serial_line;
pub mod server;
mod socket_calls;
pub mod tls;
mod wake;

pub use heartbeat::Heartbeat;
pub use serial_line::{LineDirection, LineMode, LineParity, SerialLine};
pub use wake::Wakes;
