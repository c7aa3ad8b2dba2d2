//! Connects to devices.

use std::time::Instant;

use super::Place;
use super::byte_stream::{ByteStream, StreamError, TcpByteStream, connect_udp};
use super::tls_stream::TlsStream;

/// Opens a stream to a device.
pub(super) fn connect(
    place: &Place,
    deadline: Instant,
) -> Result<Box<dyn ByteStream>, StreamError> {
    Ok(match place {
        Place::Tcp { host, port, tls: None }
        | Place::RtuOverTcp { host, port }
        | Place::AsciiOverTcp { host, port } => {
            Box::new(TcpByteStream::connect(host, *port, deadline)?)
        }
        Place::Tcp { host, port, tls: Some(tls) } => {
            let stream = TcpByteStream::connect(host, *port, deadline)?;
            Box::new(TlsStream::connect(stream, tls, deadline)?)
        }
        Place::Udp { host, port } | Place::RtuOverUdp { host, port } => {
            Box::new(connect_udp(host, *port, deadline)?)
        }
        Place::Serial(line) => Box::new(line.open_blocking()?),
    })
}
