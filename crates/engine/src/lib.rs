//! The data plane: Modbus and Raw Ingest listeners over memories, on threads of its own.
//!
//! The rules this crate keeps:
//!
//! * A connection's rights are settled once, when it is accepted: its source address picks one rule
//!   ([`policy`]), and the rule is two tables. A request costs two look-ups.
//! * All that arrived together is answered together, in order, with one write ([`connection`]). The
//!   way from request to reply ([`station`]) allocates nothing.
//! * One peer can't hold up another: every buffer has a bound, every wait has a deadline, and no
//!   code on a worker thread waits for anything but its sockets.
//! * It says what happened in counters and events, and never waits for whoever reads them.
//!
//! It knows no Python, no JSON, and no type wider than a bit or a register.

#![forbid(unsafe_code)]

mod admission;
pub mod audit;
pub mod client;
mod connection;
pub mod counters;
mod engine;
pub mod event;
mod framing;
pub mod identity;
mod listener;
mod modbus_stream;
pub mod policy;
pub mod poller;
mod raw_ingest;
mod serial;
pub mod station;
mod stream;
pub mod tls;
mod tls_stream;
mod udp;

pub use engine::{
    Engine, ListenerCounters, ListenerKind, ListenerSettings, ProtocolCounters, Settings,
    StartError,
};
pub use listener::{Limits, WhenFull};
pub use modbus_stream::{StreamFraming, StreamSettings};
pub use raw_ingest::{RawRule, RawSettings};
pub use serial::{Line, LineMode, LineParity, SerialSettings};
pub use udp::UdpSettings;
