//! The device address that a client connects to.

use std::fmt;
use std::sync::Arc;

use holdfast_protocol::client::{Tolerance, Transport};

use crate::serial_line::{LineMode, SerialLine};
use crate::tls::client::ClientTls;

/// A device or a gateway: its address, and its tolerance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    pub place: Place,
    pub tolerance: Tolerance,
}

/// The address of a device, and its transport.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    Tcp { host: String, port: u16, tls: Option<Arc<ClientTls>> },
    RtuOverTcp { host: String, port: u16 },
    AsciiOverTcp { host: String, port: u16 },
    Udp { host: String, port: u16 },
    RtuOverUdp { host: String, port: u16 },
    Serial(SerialLine),
}

impl Place {
    /// The transport of this place.
    pub fn transport(&self) -> Transport {
        match self {
            Place::Tcp { .. } => Transport::Tcp,
            Place::RtuOverTcp { .. } => Transport::RtuOverTcp,
            Place::AsciiOverTcp { .. } => Transport::AsciiOverTcp,
            Place::Udp { .. } => Transport::Udp,
            Place::RtuOverUdp { .. } => Transport::RtuOverUdp,
            Place::Serial(line) => {
                let silence = line.silence();
                match line.mode {
                    LineMode::Rtu { .. } => Transport::SerialRtu { silence },
                    LineMode::Ascii => Transport::SerialAscii { silence },
                }
            }
        }
    }
}

impl From<Place> for Endpoint {
    /// A device that follows the standard.
    fn from(place: Place) -> Endpoint {
        Endpoint { place, tolerance: Tolerance::default() }
    }
}

/// The URL without its options.
impl fmt::Display for Endpoint {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (scheme, host, port) = match &self.place {
            Place::Tcp { host, port, tls: None } => ("tcp", host, port),
            Place::Tcp { host, port, tls: Some(_) } => ("tls", host, port),
            Place::RtuOverTcp { host, port } => ("rtu+tcp", host, port),
            Place::AsciiOverTcp { host, port } => ("ascii+tcp", host, port),
            Place::Udp { host, port } => ("udp", host, port),
            Place::RtuOverUdp { host, port } => ("rtu+udp", host, port),
            Place::Serial(line) => {
                let scheme = if line.mode == LineMode::Ascii { "ascii" } else { "rtu" };
                return write!(formatter, "{scheme}://{}", line.device);
            }
        };
        if host.contains(':') {
            write!(formatter, "{scheme}://[{host}]:{port}")
        } else {
            write!(formatter, "{scheme}://{host}:{port}")
        }
    }
}
