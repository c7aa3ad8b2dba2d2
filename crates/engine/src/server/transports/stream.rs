//! The stream of a connection: a socket, or TLS over a socket.

use std::io::{self, ErrorKind, Read, Write};
use std::mem::MaybeUninit;
use std::pin::pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use socket2::SockRef;
use tokio::io::Interest;
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::server::reports::event::Kind;
use crate::socket_calls;

/// Why a stream has no more data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    /// The peer has sent everything.
    ByPeer,
    /// The connection broke.
    Broken,
    /// TLS failed. The reason is a word for programs.
    TlsFailed(&'static str),
}

impl From<End> for Kind {
    fn from(end: End) -> Kind {
        match end {
            End::ByPeer | End::Broken => Kind::Closed,
            End::TlsFailed(reason) => Kind::TlsFailed(reason),
        }
    }
}

/// `unsent` holds bytes that the system has not accepted yet. Further bytes are appended to it, so
/// that they keep their order.
pub(crate) trait Stream: Send {
    /// Reads once. Returns the length of received Modbus data, which can be 0. An error ends the
    /// connection. The runtime does not limit how often it is called: a task lets others run by itself.
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, End>>;

    /// Ready when another read may bring something, after one that brought less than there was room for.
    #[inline]
    fn poll_ready(&self, _context: &mut Context<'_>) -> Poll<()> {
        Poll::Ready(())
    }

    /// Reads once what the system has already received; `None` when there is no more.
    fn read_now(&mut self, input: &mut [u8], unsent: &mut Vec<u8>) -> Option<usize>;

    /// Whether nothing follows what was read with [`Stream::read_now`]: the peer has ended its side, or the
    /// connection is broken.
    fn has_ended(&self) -> bool {
        has_ended(self.socket())
    }

    /// Sends as much as the system accepts without blocking.
    fn send(&mut self, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind>;

    /// Whether the peer has sent part of a TLS record.
    #[inline]
    fn is_amid_record(&self) -> bool {
        false
    }

    /// Appends the message that announces the end, if the stream has one.
    fn end(&mut self, _unsent: &mut Vec<u8>) {}

    fn socket(&self) -> &TcpStream;
}

impl Stream for TcpStream {
    #[inline]
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        _unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, End>> {
        let received = socket_calls::poll_receive_unlimited(self, context, input);
        received.map(|received| match received {
            Err(_) => Err(End::Broken),
            Ok(0) => Err(End::ByPeer),
            Ok(len) => Ok(len),
        })
    }

    #[inline]
    fn poll_ready(&self, context: &mut Context<'_>) -> Poll<()> {
        self.poll_read_ready(context).map(|_| ())
    }

    fn read_now(&mut self, input: &mut [u8], _unsent: &mut Vec<u8>) -> Option<usize> {
        read(self, input)
    }

    #[inline]
    fn send(&mut self, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind> {
        send(self, output, unsent)
    }

    fn socket(&self) -> &TcpStream {
        self
    }
}

/// Sends what the system accepts without blocking, and appends the rest to `unsent`. If `unsent` is
/// not empty, all of `output` is appended.
#[inline]
pub(crate) fn send(socket: &TcpStream, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind> {
    let sent = if unsent.is_empty() { socket_calls::send(socket, output) } else { Ok(0) };
    match sent {
        Ok(sent) => unsent.extend_from_slice(&output[sent..]),
        Err(error) if error.kind() == ErrorKind::WouldBlock => unsent.extend_from_slice(output),
        Err(_) => return Err(Kind::Closed),
    }
    Ok(())
}

/// Sends all of `output`. Fails when nothing can be sent for the duration of `time_limit`.
pub(crate) async fn send_all(
    socket: &TcpStream,
    output: &[u8],
    time_limit: Duration,
) -> Result<(), Kind> {
    let mut sent = 0;
    while sent < output.len() {
        match timeout(time_limit, socket.writable()).await {
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

/// Waits until the peer ends its side of the connection, also behind bytes that are not read. Afterwards the
/// runtime may not know of these bytes: [`Stream::read_now`] finds them.
pub(crate) fn poll_end(socket: &TcpStream, context: &mut Context<'_>) -> Poll<Kind> {
    loop {
        let reported = ready!(socket.poll_read_ready(context));
        let ready = ready!(pin!(socket.ready(Interest::READABLE)).poll(context));
        if reported.is_err() || ready.is_ok_and(|ready| ready.is_read_closed()) {
            return Poll::Ready(Kind::Closed);
        }
        // Windows reports bytes that are not read again at once: there, the end is found when they are read.
        if cfg!(windows) {
            return Poll::Pending;
        }
        // The next report is that of more bytes, or of the end.
        let _ = socket.try_io(Interest::READABLE, || Err::<(), _>(ErrorKind::WouldBlock.into()));
    }
}

/// Reads directly from the system, even if the runtime does not report the socket as readable.
pub(crate) fn read(socket: &TcpStream, input: &mut [u8]) -> Option<usize> {
    (&*SockRef::from(socket)).read(input).ok().filter(|len| *len > 0)
}

/// Asks the system, as [`read`] does, whether there is nothing more to read, and never will be.
pub(crate) fn has_ended(socket: &TcpStream) -> bool {
    match SockRef::from(socket).peek(&mut [MaybeUninit::uninit()]) {
        Ok(len) => len == 0,
        Err(error) => !matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
    }
}

/// Sends all of `unsent` without waiting, or fails. Clears it in both cases.
pub(crate) fn flush_now(socket: &TcpStream, unsent: &mut Vec<u8>) -> io::Result<()> {
    let written = (&*SockRef::from(socket)).write_all(unsent);
    unsent.clear();
    written
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::task::Waker;

    use super::*;

    #[cfg(not(windows))]
    #[test]
    fn the_end_is_found_behind_bytes_that_are_not_read() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let mut peer = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
            let (mut socket, _) = listener.accept().await.unwrap();
            peer.write_all(&[1; 100]).unwrap();
            socket.readable().await.unwrap();
            let mut context = Context::from_waker(Waker::noop());
            assert!(poll_end(&socket, &mut context).is_pending());
            let mut input = [0; 60];
            assert_eq!(socket.read_now(&mut input, &mut Vec::new()), Some(60));
            assert!(poll_end(&socket, &mut context).is_pending());

            peer.shutdown(std::net::Shutdown::Write).unwrap();
            assert_eq!(poll_fn(|context| poll_end(&socket, context)).await, Kind::Closed);
            assert_eq!(socket.read_now(&mut input, &mut Vec::new()), Some(40));
            let end = poll_fn(|context| socket.poll_read(context, &mut input, &mut Vec::new()));
            assert_eq!(end.await, Err(End::ByPeer));
        });
    }
}
