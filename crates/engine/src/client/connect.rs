//! Connects to devices.

use std::time::Instant;

use super::byte_stream::{ByteStream, StreamError, TcpByteStream, connect_udp};
use super::tls_stream::TlsStream;
use super::{Peers, Place};

/// Opens a stream to a device, at one of the `peers`.
pub(super) fn connect(
    place: &Place,
    peers: &Peers,
    deadline: Instant,
) -> Result<Box<dyn ByteStream>, StreamError> {
    Ok(match place {
        Place::Tcp { host, port, tls: None }
        | Place::RtuOverTcp { host, port }
        | Place::AsciiOverTcp { host, port } => {
            Box::new(TcpByteStream::connect(host, *port, peers, deadline)?)
        }
        Place::Tcp { host, port, tls: Some(tls) } => {
            let stream = TcpByteStream::connect(host, *port, peers, deadline)?;
            Box::new(TlsStream::connect(stream, tls, deadline)?)
        }
        Place::Udp { host, port } | Place::RtuOverUdp { host, port } => {
            Box::new(connect_udp(host, *port, peers, deadline)?)
        }
        Place::Serial(line) => Box::new(line.open_blocking()?),
    })
}
