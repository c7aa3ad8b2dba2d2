//! The device address that a client connects to.

use std::fmt;
use std::sync::Arc;

use holdfast_protocol::client::{Line, Transport};

use crate::serial_line::{LineMode, SerialLine};
use crate::tls::client::ClientTls;

/// A device or a gateway, and how to connect to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Endpoint {
    Tcp {
        host: String,
        port: u16,
        tls: Option<Arc<ClientTls>>,
    },
    RtuOverTcp {
        host: String,
        port: u16,
    },
    Udp {
        host: String,
        port: u16,
    },
    /// With `echo`, the adapter echoes sent bytes. An echo is also detected without this setting.
    Serial {
        line: SerialLine,
        echo: bool,
    },
}

impl Endpoint {
    /// The transport of this endpoint.
    pub fn transport(&self) -> Transport {
        match self {
            Endpoint::Tcp { .. } => Transport::Tcp,
            Endpoint::RtuOverTcp { .. } => Transport::RtuOverTcp,
            Endpoint::Udp { .. } => Transport::Udp,
            Endpoint::Serial { line, echo } => {
                let settings = Line { silence: line.silence(), echo: *echo };
                match line.mode {
                    LineMode::Rtu { .. } => Transport::SerialRtu(settings),
                    LineMode::Ascii => Transport::SerialAscii(settings),
                }
            }
        }
    }
}

/// The URL without its options.
impl fmt::Display for Endpoint {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (scheme, host, port) = match self {
            Endpoint::Tcp { host, port, tls: None } => ("tcp", host, port),
            Endpoint::Tcp { host, port, tls: Some(_) } => ("tls", host, port),
            Endpoint::RtuOverTcp { host, port } => ("rtu+tcp", host, port),
            Endpoint::Udp { host, port } => ("udp", host, port),
            Endpoint::Serial { line, .. } => {
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
