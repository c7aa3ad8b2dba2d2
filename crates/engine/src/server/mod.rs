//! Listeners: Modbus and Raw Ingest over memories, one file per transport.

pub(crate) mod admission;
pub mod audit;
mod connection;
pub mod counters;
#[cfg(test)]
mod cuts;
mod deferred;
mod engine;
pub mod event;
mod fair_share;
mod framing;
pub mod functions;
pub mod identity;
mod incoming;
mod journaled_write;
pub(crate) mod listener;
pub(crate) mod live;
mod memory_operations;
mod peer;
pub mod policy;
pub mod ranges;
mod raw_ingest;
mod refused_request;
pub(crate) mod secure;
mod serial;
pub(crate) mod stream;
mod tcp;
pub(crate) mod tls;
mod udp;
pub mod unit_server;

pub use admission::{ConnectionLimits, OpenConnection, WhenFull};
pub use engine::{
    Engine, ListenerCounters, ListenerKind, ListenerSettings, Listening, ProtocolCounters,
    Settings, SocketKind, StartError,
};
pub use peer::Peer;
pub use raw_ingest::{AfterRefusal, Flags, PacketsPerConnection, RawRule, RawSettings};
pub use refused_request::{RefusedRequest, Why};
pub use serial::SerialSettings;
pub use tcp::{StreamFraming, StreamSettings};
pub use udp::{DatagramFraming, UdpSettings};
