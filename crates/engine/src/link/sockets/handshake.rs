//! The TLS handshake over a new connection.

use std::io::{self, ErrorKind};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::tls::client::ClientTls;
use crate::tls::{Channel, TlsFailure};

/// Bytes per read of a socket.
const CHUNK_BYTES: usize = 4096;

/// # Errors
/// The handshake failed: close the connection. An alert has been sent.
pub(crate) async fn agree(stream: &mut TcpStream, tls: &ClientTls) -> io::Result<Channel> {
    let failed = |error| io::Error::other(TlsFailure::from(&error));
    let mut channel = tls.channel().map_err(failed)?;
    let (mut plain, mut out) = (Vec::new(), Vec::new());
    let mut chunk = vec![0; CHUNK_BYTES];
    channel.send(&[], &mut out);
    loop {
        stream.write_all(&out).await?;
        out.clear();
        if !channel.is_handshaking() {
            break;
        }
        let len = stream.read(&mut chunk).await?;
        if len == 0 {
            return Err(io::Error::other(TlsFailure::ClosedDuringHandshake));
        }
        if let Err(error) = channel.receive(&chunk[..len], &mut plain, &mut out) {
            let _ = stream.try_write(&out);
            return Err(failed(error));
        }
    }
    // Data before the first request is an error.
    if plain.is_empty() { Ok(channel) } else { Err(ErrorKind::InvalidData.into()) }
}
