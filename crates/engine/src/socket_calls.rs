//! Receiving and sending on the TCP sockets of the runtime, for servers and clients, and limits of sockets.
//!
//! In a process with several threads, the C library notes around each such call that the thread may be
//! cancelled in it. On Linux, the system is called without that: it takes a thirtieth of a request.

use std::io::{self, ErrorKind};
use std::task::{Context, Poll, ready};
use std::time::Duration;

#[cfg(target_os = "linux")]
use rustix::net::{RecvFlags, SendFlags};
use socket2::SockRef;
#[cfg(target_os = "linux")]
use tokio::io::Interest;
use tokio::net::TcpStream;

/// Receives once. Returns the number of bytes, 0 at the end of the stream.
#[inline]
pub(crate) fn poll_receive(
    socket: &TcpStream,
    context: &mut Context<'_>,
    input: &mut [u8],
) -> Poll<io::Result<usize>> {
    ready!(socket.poll_read_ready(context))?;
    poll_receive_unlimited(socket, context, input)
}

/// As `poll_receive`, for a task that yields by itself: the runtime does not limit how often it receives before
/// other tasks run.
#[inline]
pub(crate) fn poll_receive_unlimited(
    socket: &TcpStream,
    context: &mut Context<'_>,
    input: &mut [u8],
) -> Poll<io::Result<usize>> {
    loop {
        match receive(socket, input) {
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                ready!(socket.poll_read_ready(context))?;
            }
            received => return Poll::Ready(received),
        }
    }
}

#[cfg(target_os = "linux")]
#[inline]
fn receive(socket: &TcpStream, input: &mut [u8]) -> io::Result<usize> {
    let mut received = None;
    let outcome = socket.try_io(Interest::READABLE, || {
        let (len, _) = rustix::net::recv(socket, &mut *input, RecvFlags::empty())?;
        received = Some(len);
        // Less than there is room for was all there is. So it need not be asked for more before the
        // system reports it.
        if 0 < len && len < input.len() { Err(ErrorKind::WouldBlock.into()) } else { Ok(len) }
    });
    received.map_or(outcome, Ok)
}

#[cfg(not(target_os = "linux"))]
fn receive(socket: &TcpStream, input: &mut [u8]) -> io::Result<usize> {
    socket.try_read(input)
}

/// Sends once, without blocking. Returns the number of bytes that the system has accepted.
#[inline]
pub(crate) fn send(socket: &TcpStream, output: &[u8]) -> io::Result<usize> {
    #[cfg(target_os = "linux")]
    return socket.try_io(Interest::WRITABLE, || {
        Ok(rustix::net::send(socket, output, SendFlags::NOSIGNAL)?)
    });
    #[cfg(not(target_os = "linux"))]
    return socket.try_write(output);
}

/// Refuses a socket that is connected to itself. While nobody listens at a port of this machine, the system may
/// choose that port for the client (a "simultaneous open" of TCP). The socket would receive its own requests, and
/// the echo of a write is its confirmation.
///
/// # Errors
/// `ConnectionRefused`, as without the coincidence. The port is free again at once.
pub(crate) fn not_to_itself<S>(socket: S) -> io::Result<S>
where
    for<'s> SockRef<'s>: From<&'s S>,
{
    let ends = SockRef::from(&socket);
    // A connection that has already ended has no peer.
    let peer = ends.peer_addr().ok();
    if peer.is_none() || peer != ends.local_addr().ok() {
        return Ok(socket);
    }
    // Closed without a reset, it would keep the port from its device for a minute.
    let _ = ends.set_linger(Some(Duration::ZERO));
    Err(ErrorKind::ConnectionRefused.into())
}

/// How long the system repeats bytes of a connection that its peer does not acknowledge. Without a limit, it does
/// so for minutes, also for a process that has ended: once the network is back, a device would get a write that was
/// given up long ago. Only Linux has such a limit.
#[derive(Debug, Default)]
pub(crate) struct ResendLimit(Duration);

impl ResendLimit {
    /// Called before a request is sent. The limit is the longest timeout so far in whole seconds, rounded up, at
    /// least 1: it seldom changes, and a device that acknowledges late is not taken for one that is gone.
    #[inline]
    pub(crate) fn cover(&mut self, socket: SockRef<'_>, timeout: Duration) {
        if timeout > self.0 || self.0.is_zero() {
            self.0 = Duration::from_secs(timeout.as_secs_f64().ceil().max(1.0) as u64);
            #[cfg(target_os = "linux")]
            let _ = socket.set_tcp_user_timeout(Some(self.0));
            #[cfg(not(target_os = "linux"))]
            let _ = socket;
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::net::SocketAddr;

    use socket2::{Domain, Socket, Type};

    use super::*;

    #[test]
    fn a_socket_that_is_connected_to_itself_is_refused_and_its_port_is_free_again() {
        for kind in [Type::STREAM, Type::DGRAM] {
            let new = || Socket::new(Domain::IPV4, kind, None).unwrap();
            let itself = new();
            itself.bind(&SocketAddr::from(([127, 0, 0, 1], 0)).into()).unwrap();
            let own = itself.local_addr().unwrap();
            itself.connect(&own).unwrap();
            let refused = not_to_itself(itself).unwrap_err();
            assert_eq!(refused.kind(), ErrorKind::ConnectionRefused, "{kind:?}");
            new().bind(&own).unwrap();
        }
    }

    #[test]
    fn the_limit_is_the_longest_timeout_in_whole_seconds() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let stream = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let socket = || SockRef::from(&stream);
        let mut limit = ResendLimit::default();
        for (timeout_ms, limit_s) in
            [(0, 1), (900, 1), (1000, 1), (1001, 2), (500, 2), (60_000, 60)]
        {
            limit.cover(socket(), Duration::from_millis(timeout_ms));
            let set = socket().tcp_user_timeout().unwrap();
            assert_eq!(set, Some(Duration::from_secs(limit_s)), "{timeout_ms} ms");
        }
    }
}
