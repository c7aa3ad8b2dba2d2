//! The data plane: Modbus and Raw Ingest listeners over memories, on threads of its own.
//!
//! The rules this crate keeps:
//!
//! * A connection's rights are settled once, when it is accepted: its source address picks one rule
//!   ([`server::policy`]), and the rule is two tables. A request costs two look-ups.
//! * All that arrived together is answered together, in order, with one write (`server::connection`). The
//!   way from request to reply ([`server::unit_server`]) allocates nothing.
//! * One peer can't hold up another: every buffer has a bound, every wait has a deadline, and no
//!   code on a worker thread waits for anything but its sockets.
//! * It says what happened in counters and events, and never waits for whoever reads them.
//!
//! It knows no Python, no JSON, and no type wider than a bit or a register.

#![forbid(unsafe_code)]

pub mod client;
mod counter;
pub mod packet_area;
pub mod poller;
mod serial_line;
pub mod server;
pub mod tls;

pub use serial_line::{LineMode, LineParity, SerialLine};
