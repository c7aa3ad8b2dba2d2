//! Streams of bytes with deadlines: a TCP connection, a serial port.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

/// The shortest time that a system waits for.
const MIN_TIMEOUT: Duration = Duration::from_micros(1);

pub(super) trait ByteStream: Send {
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
    if left.is_zero() { Err(ErrorKind::TimedOut.into()) } else { Ok(left.max(MIN_TIMEOUT)) }
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

/// A TCP connection. It tells the system how long to wait only when that has changed, in whole
/// milliseconds: most requests have as much time as the one before.
pub(super) struct TcpByteStream {
    socket: TcpStream,
    read_timeout: Duration,
    write_timeout: Duration,
}

impl TcpByteStream {
    /// Connects to the first address of a name that takes the connection before the deadline.
    pub(super) fn connect(host: &str, port: u16, deadline: Instant) -> io::Result<TcpByteStream> {
        let socket =
            first(host, port, |address| TcpStream::connect_timeout(&address, left(deadline)?))?;
        socket.set_nodelay(true)?;
        Ok(TcpByteStream { socket, read_timeout: Duration::ZERO, write_timeout: Duration::ZERO })
    }

    /// Whether the peer has ended it.
    pub(super) fn has_ended(&self) -> bool {
        match self.peek() {
            Ok(len) => len == 0,
            Err(error) => error.kind() != ErrorKind::WouldBlock,
        }
    }

    /// Does something with the socket that is not to wait.
    pub(super) fn at_once<T>(
        &mut self,
        work: impl FnOnce(&mut TcpStream) -> io::Result<T>,
    ) -> io::Result<T> {
        self.socket.set_nonblocking(true)?;
        let done = work(&mut self.socket);
        self.socket.set_nonblocking(false)?;
        done
    }

    /// Looks whether there is something to read, without waiting for it.
    fn peek(&self) -> io::Result<usize> {
        self.socket.set_nonblocking(true)?;
        let found = self.socket.peek(&mut [0]);
        self.socket.set_nonblocking(false)?;
        found
    }
}

/// What is left until a deadline, in whole milliseconds, the last one begun.
fn millis(deadline: Instant) -> io::Result<Duration> {
    let micros = left(deadline)?.as_micros();
    Ok(Duration::from_millis(u64::try_from(micros.div_ceil(1000)).unwrap_or(u64::MAX)))
}

impl ByteStream for TcpByteStream {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        read(|| {
            let timeout = millis(deadline)?;
            if timeout != self.read_timeout {
                self.socket.set_read_timeout(Some(timeout))?;
                self.read_timeout = timeout;
            }
            self.socket.read(buffer)
        })
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()> {
        let timeout = millis(deadline)?;
        if timeout != self.write_timeout {
            self.socket.set_write_timeout(Some(timeout))?;
            self.write_timeout = timeout;
        }
        self.socket.write_all(bytes).map_err(|error| match error.kind() {
            ErrorKind::WouldBlock => ErrorKind::TimedOut.into(),
            _ => error,
        })
    }

    fn discard(&mut self) -> io::Result<bool> {
        Ok(false)
    }

    fn is_quiet(&self) -> bool {
        let waits = |error: io::Error| error.kind() == ErrorKind::WouldBlock;
        self.peek().is_err_and(waits)
    }
}

impl ByteStream for serial2::SerialPort {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        read(|| {
            // A port leaves away what is no whole millisecond.
            self.set_read_timeout(millis(deadline)?)?;
            Read::read(self, buffer)
        })
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()> {
        self.set_write_timeout(millis(deadline)?)?;
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
