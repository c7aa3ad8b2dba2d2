//! Connects to endpoints.

use std::time::Instant;

use super::Endpoint;
use super::byte_stream::{ByteStream, StreamError, TcpByteStream, connect_udp};
use super::tls_stream::TlsStream;

/// Opens a stream to an endpoint.
pub(super) fn connect(
    endpoint: &Endpoint,
    deadline: Instant,
) -> Result<Box<dyn ByteStream>, StreamError> {
    Ok(match endpoint {
        Endpoint::Tcp { host, port, tls: None } | Endpoint::RtuOverTcp { host, port } => {
            Box::new(TcpByteStream::connect(host, *port, deadline)?)
        }
        Endpoint::Tcp { host, port, tls: Some(tls) } => {
            let stream = TcpByteStream::connect(host, *port, deadline)?;
            Box::new(TlsStream::agree(stream, tls, deadline)?)
        }
        Endpoint::Udp { host, port } => Box::new(connect_udp(host, *port)?),
        Endpoint::Serial { line, .. } => Box::new(line.open_blocking()?),
    })
}
