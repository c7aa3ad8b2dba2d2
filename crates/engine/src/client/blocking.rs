//! A blocking client: it drives a [`Connection`] in the calling thread.
//!
//! The connection is opened on first use and kept open. Calls are never repeated: if a call fails
//! after its request may have been sent, the caller gets the error.

use std::io::ErrorKind;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use holdfast_protocol::client::{Closed, Connection, Done, Transport};
use holdfast_protocol::pdu::{EncodedRequest, Response};

use super::byte_stream::{ByteStream, StreamError};
use super::connect::connect;
use super::turns::Turns;
use super::{ClientError, Endpoint, Lost};

/// Bytes per read of a socket. No Modbus datagram is longer.
const CHUNK: usize = 512;

/// A TCP connection that was unused for this time is checked before it is used again.
const IDLE: Duration = Duration::from_millis(50);

/// A client of one endpoint. Any number of threads can call it; their calls take turns.
pub struct BlockingClient {
    endpoint: Endpoint,
    turns: Turns,
    open: Mutex<Option<Open>>,
    late: AtomicU64,
}

/// An open connection.
struct Open {
    stream: Box<dyn ByteStream>,
    connection: Connection,
    transport: Transport,
    /// The zero of the clock of the connection.
    epoch: Instant,
    used: Instant,
}

impl BlockingClient {
    pub fn new(endpoint: Endpoint) -> BlockingClient {
        BlockingClient {
            endpoint,
            turns: Turns::default(),
            open: Mutex::default(),
            late: AtomicU64::new(0),
        }
    }

    /// Sends a request when it is the caller's turn, and passes its response to `take`. `timeout`
    /// does not include the wait for the turn. On a serial line, unit id 0 is a broadcast: no unit
    /// replies, and a write counts as done when it is sent.
    ///
    /// # Errors
    /// [`ClientError`]: the request failed, or there is no connection.
    pub fn call<T>(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        take: impl FnOnce(Response<'_>) -> T,
    ) -> Result<T, ClientError> {
        let _turn = self.turns.take();
        let deadline = Instant::now() + timeout;
        let mut held = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if held.as_mut().is_some_and(|open| !open.is_usable()) {
            *held = None;
        }
        let open = match held.as_mut() {
            Some(open) => open,
            None => held.insert(Open::new(&self.endpoint, deadline, timeout)?),
        };
        let late = open.connection.late();
        let mut take = Some(take);
        let mut result = None;
        let lost = open.call(unit_id, request, deadline, &mut |done: Done<'_>| {
            let Some(take) = take.take() else { unreachable!("a call has one result") };
            result = Some(match done.outcome {
                Ok(response) => Ok(take(response)),
                Err(failure) => Err(ClientError::new(failure, timeout)),
            });
        });
        self.late.fetch_add(open.connection.late() - late, Ordering::Relaxed);
        if open.connection.closed().is_some() {
            *held = None;
        }
        match (result, lost) {
            (Some(Err(ClientError::Lost(_))) | None, Some(error)) => Err(self.lost(error)),
            (Some(result), _) => result,
            (None, None) => unreachable!("a call ends with a result"),
        }
    }

    fn lost(&self, error: StreamError) -> ClientError {
        ClientError::Lost(match error {
            StreamError::Tls(failure) => {
                let maybe_sent = !failure.refuses_connection();
                return ClientError::Tls { to: self.endpoint.to_string(), failure, maybe_sent };
            }
            StreamError::Io(error) => Lost::Io(error),
            StreamError::TimedOut | StreamError::Ended => Lost::Closed(Closed::ByPeer),
        })
    }

    /// Closes the connection after the calls before this one. The next call opens a new one.
    pub fn close(&self) {
        let _turn = self.turns.take();
        *self.open.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// The number of replies that came after their request had ended.
    pub fn late(&self) -> u64 {
        self.late.load(Ordering::Relaxed)
    }
}

impl Open {
    fn new(endpoint: &Endpoint, deadline: Instant, timeout: Duration) -> Result<Open, ClientError> {
        let transport = endpoint.transport();
        let to = || endpoint.to_string();
        let stream = connect(endpoint, deadline).map_err(|error| match error {
            StreamError::TimedOut => ClientError::ConnectTimeout { to: to(), after: timeout },
            StreamError::Ended => {
                ClientError::Connect { to: to(), error: ErrorKind::UnexpectedEof.into() }
            }
            StreamError::Io(error) => ClientError::Connect { to: to(), error },
            StreamError::Tls(failure) => ClientError::Tls { to: to(), failure, maybe_sent: false },
        })?;
        let (connection, now) = (Connection::new(transport), Instant::now());
        Ok(Open { stream, connection, transport, epoch: now, used: now })
    }

    /// Whether the connection can carry another request: the peer has not closed it, and has not
    /// sent bytes without a request.
    fn is_usable(&mut self) -> bool {
        match self.transport {
            Transport::Tcp => self.used.elapsed() <= IDLE || !self.stream.has_ended(),
            Transport::RtuOverTcp => self.stream.is_quiet(),
            _ => true,
        }
    }

    /// Carries out a request. Returns the I/O error, if there was one.
    fn call(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        deadline: Instant,
        sink: &mut impl FnMut(Done<'_>),
    ) -> Option<StreamError> {
        let exchanged = self.exchange(unit_id, request, deadline, sink);
        self.used = Instant::now();
        let error = exchanged.err()?;
        self.connection.close(Closed::ByPeer, sink);
        Some(error)
    }

    fn exchange(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        deadline: Instant,
        sink: &mut impl FnMut(Done<'_>),
    ) -> Result<(), StreamError> {
        let mut chunk = [0; CHUNK];
        if matches!(self.transport, Transport::SerialRtu(_) | Transport::SerialAscii(_)) {
            // On a line that is never silent, the request times out.
            while Instant::now() < deadline
                && let Some(len) = self.stream.receive_now(&mut chunk)?
            {
                self.connection.receive(&chunk[..len], self.epoch.elapsed(), &mut *sink);
            }
        }
        let now = Instant::now();
        let timeout = deadline.saturating_duration_since(now);
        let sent = self.connection.send(unit_id, request, timeout, now - self.epoch);
        if let Err(why) = sent {
            self.connection.close(why, sink);
            return Ok(());
        }
        loop {
            let outgoing = self.connection.outgoing();
            if !outgoing.is_empty() {
                match self.stream.send(outgoing, deadline) {
                    // Part of the request may have been sent.
                    Err(StreamError::TimedOut) => {
                        self.connection.advance(deadline - self.epoch, &mut *sink);
                        self.connection.close(Closed::TimedOut, sink);
                        return Ok(());
                    }
                    other => other?,
                }
                let len = outgoing.len();
                self.connection.sent(len);
            }
            let Some(until) = self.connection.deadline() else { return Ok(()) };
            match self.stream.receive(&mut chunk, self.epoch + until) {
                Ok(len) => {
                    self.connection.receive(&chunk[..len], self.epoch.elapsed(), &mut *sink);
                }
                Err(StreamError::TimedOut) => {
                    self.connection.advance(self.epoch.elapsed(), &mut *sink);
                }
                Err(error) => return Err(error),
            }
        }
    }
}
