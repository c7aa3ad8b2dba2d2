//! Byte streams with deadlines: a TCP connection, datagrams, a serial port.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{IpAddr, SocketAddr, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use socket2::SockRef;

use crate::client::Peers;
use crate::name_lookup::{self, Unresolved};
use crate::serial_line::OpenLine;
use crate::socket_calls::{ResendLimit, not_to_itself};
use crate::tls::TlsFailure;

/// The shortest timeout that all systems accept.
const MIN_TIMEOUT: Duration = Duration::from_micros(1);

/// Why bytes were not received, or not sent.
#[derive(Debug)]
pub(super) enum StreamError {
    /// The deadline passed.
    TimedOut,
    /// The deadline passed while the name was looked up.
    Unresolved,
    /// The name leads to none of the [`Peers`].
    Elsewhere,
    /// The peer has ended the stream.
    Ended,
    Io(io::Error),
    Tls(TlsFailure),
}

pub(super) trait ByteStream: Send {
    /// Reads what is available, at least one byte. Of datagrams, reads one.
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError>;

    /// Reads what is already available, without waiting.
    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError>;

    /// Sends all bytes. Over UDP, they are one datagram.
    fn send(&mut self, bytes: &[u8], deadline: Instant) -> Result<(), StreamError>;

    /// Whether the peer has closed the stream. Bytes that it sent before are kept.
    fn has_ended(&mut self) -> bool {
        false
    }

    /// Whether the stream is that of another device than its name is now.
    fn has_moved(&self) -> bool {
        false
    }

    /// The address at the other end, if it has one.
    fn peer(&self) -> Option<IpAddr> {
        None
    }

    /// Whether the stream is open and no bytes wait in it.
    fn is_quiet(&self) -> bool {
        true
    }
}

impl From<io::Error> for StreamError {
    /// Systems report an end or a timeout differently: this maps them to the same variants.
    fn from(error: io::Error) -> StreamError {
        match error.kind() {
            ErrorKind::TimedOut | ErrorKind::WouldBlock => StreamError::TimedOut,
            ErrorKind::UnexpectedEof => StreamError::Ended,
            _ => StreamError::Io(error),
        }
    }
}

impl From<Unresolved> for StreamError {
    fn from(unresolved: Unresolved) -> StreamError {
        match unresolved {
            Unresolved::TooLate => StreamError::Unresolved,
            Unresolved::Failed(error) => StreamError::Io(error),
        }
    }
}

/// The time until a deadline, at least [`MIN_TIMEOUT`]: systems do not accept a timeout of 0.
fn left(deadline: Instant) -> io::Result<Duration> {
    let left = deadline.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(ErrorKind::TimedOut.into()) } else { Ok(left.max(MIN_TIMEOUT)) }
}

/// The same in whole milliseconds, rounded up.
fn millis(deadline: Instant) -> io::Result<Duration> {
    let micros = left(deadline)?.as_micros();
    Ok(Duration::from_millis(u64::try_from(micros.div_ceil(1000)).unwrap_or(u64::MAX)))
}

/// Repeats an interrupted read.
fn read(mut once: impl FnMut() -> io::Result<usize>) -> Result<usize, StreamError> {
    loop {
        return match once() {
            Ok(0) => Err(StreamError::Ended),
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            other => Ok(other?),
        };
    }
}

/// No available bytes are not an error when the caller does not wait.
fn at_once(received: Result<usize, StreamError>) -> Result<Option<usize>, StreamError> {
    match received {
        Err(StreamError::TimedOut) => Ok(None),
        other => other.map(Some),
    }
}

/// A TCP connection. Timeouts are set in whole milliseconds, and only when they change: most
/// requests have the same timeout as the one before.
pub(super) struct TcpByteStream {
    socket: TcpStream,
    read_timeout: Duration,
    write_timeout: Duration,
    resend_limit: ResendLimit,
}

impl TcpByteStream {
    /// Connects to the first address of a name that accepts before the deadline. Each gets a share of the
    /// time that is left.
    pub(super) fn connect(
        host: &str,
        port: u16,
        peers: &Peers,
        deadline: Instant,
    ) -> Result<TcpByteStream, StreamError> {
        let found = addresses(host, port, peers, deadline)?;
        let socket = first(found, |address, others| {
            let timeout = left(deadline)?.min(name_lookup::share(deadline, others));
            not_to_itself(TcpStream::connect_timeout(&address, timeout.max(MIN_TIMEOUT))?)
        })?;
        socket.set_nodelay(true)?;
        Ok(TcpByteStream {
            socket,
            read_timeout: Duration::ZERO,
            write_timeout: Duration::ZERO,
            resend_limit: ResendLimit::default(),
        })
    }

    /// Runs an operation on the socket without blocking.
    pub(super) fn at_once<T>(
        &self,
        work: impl FnOnce(&TcpStream) -> io::Result<T>,
    ) -> io::Result<T> {
        self.socket.set_nonblocking(true)?;
        let done = work(&self.socket);
        self.socket.set_nonblocking(false)?;
        done
    }

    fn peek(&self) -> io::Result<usize> {
        self.at_once(|socket| socket.peek(&mut [0]))
    }
}

impl ByteStream for TcpByteStream {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
        read(|| {
            let timeout = millis(deadline)?;
            if timeout != self.read_timeout {
                self.socket.set_read_timeout(Some(timeout))?;
                self.read_timeout = timeout;
            }
            self.socket.read(buffer)
        })
    }

    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
        at_once(read(|| self.at_once(|mut socket| socket.read(buffer))))
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> Result<(), StreamError> {
        let timeout = millis(deadline)?;
        if timeout != self.write_timeout {
            self.socket.set_write_timeout(Some(timeout))?;
            self.write_timeout = timeout;
        }
        self.resend_limit.cover(SockRef::from(&self.socket), timeout);
        Ok(self.socket.write_all(bytes)?)
    }

    fn has_ended(&mut self) -> bool {
        match self.peek() {
            Ok(len) => len == 0,
            Err(error) => error.kind() != ErrorKind::WouldBlock,
        }
    }

    fn peer(&self) -> Option<IpAddr> {
        self.socket.peer_addr().ok().map(|peer| peer.ip())
    }

    fn is_quiet(&self) -> bool {
        self.peek().is_err_and(|error| error.kind() == ErrorKind::WouldBlock)
    }
}

/// Creates a UDP socket for the first reachable address of a name.
pub(super) fn connect_udp(
    host: &str,
    port: u16,
    peers: &Peers,
    deadline: Instant,
) -> Result<UdpSocket, StreamError> {
    let found = addresses(host, port, peers, deadline)?;
    Ok(first(found, |address, _| {
        let any = if address.is_ipv6() { "[::]:0" } else { "0.0.0.0:0" };
        let socket = UdpSocket::bind(any)?;
        socket.connect(address)?;
        not_to_itself(socket)
    })?)
}

impl ByteStream for UdpSocket {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
        loop {
            self.set_read_timeout(Some(left(deadline)?))?;
            match self.recv(buffer) {
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                other => return Ok(other?),
            }
        }
    }

    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
        self.set_nonblocking(true)?;
        let received = self.recv(buffer);
        self.set_nonblocking(false)?;
        at_once(received.map_err(StreamError::from))
    }

    fn send(&mut self, bytes: &[u8], _deadline: Instant) -> Result<(), StreamError> {
        UdpSocket::send(self, bytes)?;
        Ok(())
    }

    fn peer(&self) -> Option<IpAddr> {
        self.peer_addr().ok().map(|peer| peer.ip())
    }

    fn is_quiet(&self) -> bool {
        let peek = || {
            self.set_nonblocking(true)?;
            let peeked = self.peek(&mut [0]);
            self.set_nonblocking(false)?;
            peeked
        };
        peek().is_err_and(|error: io::Error| error.kind() == ErrorKind::WouldBlock)
    }
}

impl ByteStream for OpenLine<serial2::SerialPort> {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
        read(|| {
            // A port rounds down to whole milliseconds.
            self.port.set_read_timeout(millis(deadline)?)?;
            Read::read(&mut self.port, buffer)
        })
    }

    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
        self.port.set_read_timeout(Duration::ZERO)?;
        at_once(read(|| Read::read(&mut self.port, buffer)))
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> Result<(), StreamError> {
        self.port.set_write_timeout(millis(deadline)?)?;
        Ok(Write::write_all(&mut self.port, bytes)?)
    }

    fn has_moved(&self) -> bool {
        OpenLine::has_moved(self)
    }
}

/// The addresses of a name, if all are among the `peers`.
fn addresses(
    host: &str,
    port: u16,
    peers: &Peers,
    deadline: Instant,
) -> Result<Vec<SocketAddr>, StreamError> {
    let found = name_lookup::addresses(host, port, deadline)?;
    if peers.hold_all(&found) { Ok(found) } else { Err(StreamError::Elsewhere) }
}

/// Tries the addresses of a name in order, until `open` succeeds. It also gets the number of addresses that
/// follow.
fn first<T>(
    addresses: Vec<SocketAddr>,
    open: impl Fn(SocketAddr, usize) -> io::Result<T>,
) -> io::Result<T> {
    let mut failure = io::Error::new(ErrorKind::NotFound, "the name has no address");
    let others = (0..addresses.len()).rev();
    for (address, others) in addresses.into_iter().zip(others) {
        match open(address, others) {
            Ok(opened) => return Ok(opened),
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    const MINUTE: Duration = Duration::from_secs(60);

    fn address(port: u16) -> SocketAddr {
        ([127, 0, 0, 1], port).into()
    }

    #[test]
    fn each_address_is_tried_and_knows_how_many_follow() {
        let tried = std::cell::RefCell::default();
        let opened = first(vec![address(1), address(2), address(3)], |at, others| {
            Vec::push(&mut tried.borrow_mut(), (at.port(), others));
            if at.port() == 2 { Ok(at) } else { Err(ErrorKind::ConnectionRefused.into()) }
        });
        assert_eq!(opened.unwrap(), address(2));
        assert_eq!(tried.into_inner(), [(1, 2), (2, 1)]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_system_repeats_no_request_for_much_longer_than_its_timeout() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let (port, deadline) = (listener.local_addr().unwrap().port(), Instant::now() + MINUTE);
        let mut stream =
            TcpByteStream::connect("127.0.0.1", port, &Peers::default(), deadline).unwrap();
        stream.send(&[0], deadline).unwrap();
        let limit = SockRef::from(&stream.socket).tcp_user_timeout().unwrap();
        assert!(limit.is_some_and(|limit| !limit.is_zero() && limit <= MINUTE), "{limit:?}");
    }

    #[test]
    fn the_failure_is_that_of_the_last_address() {
        let kinds = [ErrorKind::TimedOut, ErrorKind::ConnectionRefused];
        let failed = first(vec![address(0), address(1)], |at, _| {
            io::Result::<()>::Err(kinds[usize::from(at.port())].into())
        });
        assert_eq!(failed.unwrap_err().kind(), ErrorKind::ConnectionRefused);
        let none = first(Vec::new(), |_, _| io::Result::Ok(()));
        assert_eq!(none.unwrap_err().kind(), ErrorKind::NotFound);
    }
}
