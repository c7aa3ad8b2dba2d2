//! Listeners: Modbus and Raw Ingest over memories, one file per transport.

pub(crate) mod connections;
mod engine;
pub mod reports;
pub mod requests;
pub mod rights;
pub(crate) mod transports;

pub use connections::admission::{ConnectionLimits, OpenConnection, WhenFull};
pub use connections::peer::Peer;
pub use engine::{
    Engine, ListenerCounters, ListenerKind, ListenerSettings, Listening, ProtocolCounters,
    Settings, SocketKind, StartError,
};
pub use reports::refused_request::{RefusedRequest, Why};
pub use transports::raw_ingest::{AfterRefusal, Flags, PacketsPerConnection, RawRule, RawSettings};
pub use transports::serial::SerialSettings;
pub use transports::tcp::{StreamFraming, StreamSettings};
pub use transports::udp::{DatagramFraming, UdpSettings};
