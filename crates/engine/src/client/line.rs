//! Streams of bytes with deadlines: a TCP connection, a serial port.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

/// The shortest time that a system waits for.
const LEAST: Duration = Duration::from_micros(1);

pub(super) trait Line: Send {
    /// Reads what is there, at least one byte.
    ///
    /// # Errors
    /// `TimedOut` when nothing comes before the deadline, `UnexpectedEof` when nothing will.
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize>;

    /// # Errors
    /// `TimedOut` when the line does not take all of it before the deadline.
    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()>;

    /// Throws away what is there; whether there was something.
    fn discard(&mut self) -> io::Result<bool>;

    /// Whether the peer is there, and has sent nothing; a line that can be silenced always is.
    fn is_quiet(&self) -> bool;
}

/// What is left until a deadline, for a system that knows no time of 0.
fn left(deadline: Instant) -> io::Result<Duration> {
    let left = deadline.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(ErrorKind::TimedOut.into()) } else { Ok(left.max(LEAST)) }
}

/// Reads until nothing interrupts it; says the same of an end and of a time that ran out on every
/// system.
fn read(mut once: impl FnMut() -> io::Result<usize>) -> io::Result<usize> {
    loop {
        return match once() {
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            Err(error) if error.kind() == ErrorKind::WouldBlock => Err(ErrorKind::TimedOut.into()),
            other => other,
        };
    }
}

impl Line for TcpStream {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        read(|| {
            self.set_read_timeout(Some(left(deadline)?))?;
            Read::read(self, buffer)
        })
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()> {
        self.set_write_timeout(Some(left(deadline)?))?;
        self.write_all(bytes).map_err(|error| match error.kind() {
            ErrorKind::WouldBlock => ErrorKind::TimedOut.into(),
            _ => error,
        })
    }

    fn discard(&mut self) -> io::Result<bool> {
        Ok(false)
    }

    fn is_quiet(&self) -> bool {
        let waits = |error: io::Error| error.kind() == ErrorKind::WouldBlock;
        peek(self).is_err_and(waits)
    }
}

impl Line for serial2::SerialPort {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        read(|| {
            // A port counts whole milliseconds, and leaves the rest away.
            self.set_read_timeout(left(deadline)? + Duration::from_micros(999))?;
            Read::read(self, buffer)
        })
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()> {
        self.set_write_timeout(left(deadline)? + Duration::from_micros(999))?;
        Write::write_all(self, bytes)
    }

    fn discard(&mut self) -> io::Result<bool> {
        self.set_read_timeout(Duration::ZERO)?;
        match read(|| Read::read(self, &mut [0; 4096])) {
            Ok(_) => Ok(true),
            Err(error) if error.kind() == ErrorKind::TimedOut => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn is_quiet(&self) -> bool {
        true
    }
}

/// Connects to the first address of a name that takes the connection before the deadline.
pub(super) fn connect(host: &str, port: u16, deadline: Instant) -> io::Result<TcpStream> {
    let stream =
        first(host, port, |address| TcpStream::connect_timeout(&address, left(deadline)?))?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// The first address of a name that `open` succeeds with.
pub(super) fn first<T>(
    host: &str,
    port: u16,
    open: impl Fn(SocketAddr) -> io::Result<T>,
) -> io::Result<T> {
    let mut failure = io::Error::new(ErrorKind::NotFound, "the name has no address");
    for address in (host, port).to_socket_addrs()? {
        match open(address) {
            Ok(opened) => return Ok(opened),
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

/// Whether the peer of an idle connection has ended it.
pub(super) fn has_ended(stream: &TcpStream) -> bool {
    match peek(stream) {
        Ok(len) => len == 0,
        Err(error) => error.kind() != ErrorKind::WouldBlock,
    }
}

/// Looks whether there is something to read, without waiting for it.
fn peek(stream: &TcpStream) -> io::Result<usize> {
    stream.set_nonblocking(true)?;
    let found = stream.peek(&mut [0]);
    stream.set_nonblocking(false)?;
    found
}
