//! What a connection reads requests from and sends replies to: a socket, or TLS between it and one.

use std::io::{self, ErrorKind, Read, Write};
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use socket2::SockRef;
use tokio::io::{AsyncRead, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::event::Kind;

/// `unsent` is what the system did not take yet: what is to be sent is appended to it, never sent
/// before it.
pub(crate) trait Stream: Send {
    /// Reads once. The length of what came for Modbus, which can be 0; an error is the end.
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, Kind>>;

    /// Reads once what the system has received already; `None` when there is no more.
    fn read_now(&mut self, input: &mut [u8], unsent: &mut Vec<u8>) -> Option<usize>;

    /// Sends as much as the system takes at once.
    fn send(&mut self, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind>;

    /// Whether the peer has begun something whose rest is needed to make sense of it.
    fn is_amid_record(&self) -> bool;

    /// Appends what tells the peer of the end.
    fn end(&mut self, unsent: &mut Vec<u8>);

    fn socket(&self) -> &TcpStream;
}

impl Stream for TcpStream {
    #[inline]
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        _unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, Kind>> {
        let mut buffer = ReadBuf::new(input);
        let Poll::Ready(read) = AsyncRead::poll_read(Pin::new(self), context, &mut buffer) else {
            return Poll::Pending;
        };
        let len = buffer.filled().len();
        Poll::Ready(if read.is_err() || len == 0 { Err(Kind::Closed) } else { Ok(len) })
    }

    fn read_now(&mut self, input: &mut [u8], _unsent: &mut Vec<u8>) -> Option<usize> {
        read(self, input)
    }

    #[inline]
    fn send(&mut self, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind> {
        send(self, output, unsent)
    }

    #[inline]
    fn is_amid_record(&self) -> bool {
        false
    }

    fn end(&mut self, _unsent: &mut Vec<u8>) {}

    fn socket(&self) -> &TcpStream {
        self
    }
}

/// Sends behind `unsent`, at once where it is empty, as much as the system takes; the rest is
/// appended to it.
#[inline]
pub(crate) fn send(socket: &TcpStream, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind> {
    let sent = if unsent.is_empty() { socket.try_write(output) } else { Ok(0) };
    match sent {
        Ok(sent) => unsent.extend_from_slice(&output[sent..]),
        Err(error) if error.kind() == ErrorKind::WouldBlock => unsent.extend_from_slice(output),
        Err(_) => return Err(Kind::Closed),
    }
    Ok(())
}

/// Waits for the peer to take all of `output`, for `patience` without any progress.
pub(crate) async fn send_all(
    socket: &TcpStream,
    output: &[u8],
    patience: Duration,
) -> Result<(), Kind> {
    let mut sent = 0;
    while sent < output.len() {
        match timeout(patience, socket.writable()).await {
            Err(_) => return Err(Kind::SlowReader),
            Ok(Err(_)) => return Err(Kind::Closed),
            Ok(Ok(())) => {}
        }
        match socket.try_write(&output[sent..]) {
            Ok(len) => sent += len,
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => return Err(Kind::Closed),
        }
    }
    Ok(())
}

/// Reads what the system has received, whatever the runtime knows of it.
pub(crate) fn read(socket: &TcpStream, input: &mut [u8]) -> Option<usize> {
    (&*SockRef::from(socket)).read(input).ok().filter(|len| *len > 0)
}

/// Sends all of `unsent`, or fails: nothing is waited for.
pub(crate) fn write(socket: &TcpStream, unsent: &mut Vec<u8>) -> io::Result<()> {
    let written = (&*SockRef::from(socket)).write_all(unsent);
    unsent.clear();
    written
}
