//! One request and its reply, by blocking calls with one deadline for all of it.
//!
//! The connection is made when it is needed and kept. A call that fails after its request may have been
//! sent is never repeated; only a read over UDP is, which changes nothing. What leaves the state of
//! a connection in doubt ends it: then the next call makes a new one. Over TCP a timeout does not,
//! because a late reply is known by its transaction id; only several do, with nothing between them.

use std::io::{self, ErrorKind};
use std::net::UdpSocket;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use holdfast_protocol::frame::{FrameError, ascii, mbap, rtu};
use holdfast_protocol::pdu::{self, Request, Response, ResponseError};

use super::byte_stream::{self, ByteStream, TcpByteStream};
use super::session::Session;
use super::tls_stream::TlsStream;
use super::turns::Turns;
use super::{Broken, ClientError};
use crate::serial_line::{LineMode, SerialLine};
use crate::tls::client::ClientTls;

/// Bytes taken from a socket at once.
const CHUNK: usize = 512;

/// After this time without use a connection is looked at before it is trusted.
const IDLE: Duration = Duration::from_millis(50);

/// Timeouts one after the other, without a byte between them, after which a connection is given up:
/// the other side may have gone without a word.
const MAX_CONSECUTIVE_TIMEOUTS: u32 = 3;

/// How often a read is sent over UDP within its deadline.
const UDP_ATTEMPTS: u32 = 3;

/// What devices get to carry out a broadcast (Modbus over Serial Line V1.02, 2.4.1).
const TURNAROUND: Duration = Duration::from_millis(100);

/// What a client talks to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Endpoint {
    Tcp {
        host: String,
        port: u16,
        tls: Option<Arc<ClientTls>>,
    },
    RtuOverTcp {
        host: String,
        port: u16,
    },
    Udp {
        host: String,
        port: u16,
    },
    /// With `echo` the adapter hands back what is sent; one that does is also noticed by itself.
    Serial {
        line: SerialLine,
        echo: bool,
    },
}

/// A client of one endpoint. Any number of threads may call it: their calls take turns.
pub struct BlockingClient {
    endpoint: Endpoint,
    turns: Turns,
    connection: Mutex<Option<Connection>>,
    late: AtomicU64,
}

struct Connection {
    kind: Kind,
    used: Instant,
    /// Timeouts since something came.
    timeouts: u32,
}

enum Kind {
    Tcp {
        stream: TcpByteStream,
        session: Session,
    },
    Tls {
        stream: Box<TlsStream>,
        session: Session,
    },
    Udp {
        socket: UdpSocket,
        next_id: u16,
    },
    /// `silence` is that of a serial line.
    Rtu {
        line: Box<dyn ByteStream>,
        silence: Option<Duration>,
        echo: bool,
    },
    Ascii {
        line: Box<dyn ByteStream>,
        silence: Duration,
        echo: bool,
    },
}

/// A call's request and times.
struct Call<'c> {
    unit_id: u8,
    request: &'c Request<'c>,
    pdu: &'c [u8],
    timeout: Duration,
    deadline: Instant,
}

/// A call that failed, and whether the connection can be used again.
struct Failure {
    error: ClientError,
    usable: bool,
}

impl BlockingClient {
    pub fn new(endpoint: Endpoint) -> BlockingClient {
        BlockingClient {
            endpoint,
            turns: Turns::default(),
            connection: Mutex::default(),
            late: AtomicU64::new(0),
        }
    }

    /// Sends a request when the caller's turn has come, which `timeout` does not cover, and gives
    /// its response to `take`. On a serial line unit id 0 is a broadcast: nobody replies, and a
    /// write is held to be done when it was sent.
    ///
    /// # Errors
    /// [`ClientError`].
    pub fn call<T>(
        &self,
        unit_id: u8,
        request: &Request<'_>,
        timeout: Duration,
        take: impl FnOnce(Response<'_>) -> T,
    ) -> Result<T, ClientError> {
        let mut buffer = [0; pdu::MAX_LEN];
        let len = request.encode(&mut buffer);
        let _turn = self.turns.take();
        let deadline = Instant::now() + timeout;
        let call = Call { unit_id, request, pdu: &buffer[..len], timeout, deadline };
        let mut held = self.connection.lock().unwrap_or_else(PoisonError::into_inner);
        if held.as_mut().is_some_and(Connection::has_ended) {
            *held = None;
        }
        let connection = match held.as_mut() {
            Some(connection) => connection,
            None => held.insert(self.open(deadline, timeout)?),
        };
        let mut take = Some(take);
        let mut taken = None;
        let mut give = |response: Response<'_>| {
            taken = take.take().map(|take| take(response));
        };
        let late = self.late();
        let done = connection.exchange(&call, &mut give, &self.late);
        connection.used = Instant::now();
        match done {
            Ok(()) => {
                connection.timeouts = 0;
                taken.ok_or_else(|| ClientError::Invalid("there was no response".into()))
            }
            Err(Failure { error, usable }) => {
                let silent = matches!(error, ClientError::Timeout(_)) && late == self.late();
                connection.timeouts = if silent { connection.timeouts + 1 } else { 0 };
                if !usable || connection.timeouts == MAX_CONSECUTIVE_TIMEOUTS {
                    *held = None;
                }
                Err(error)
            }
        }
    }

    /// Ends the connection when the calls before this one have ended; the next makes a new one.
    pub fn close(&self) {
        let _turn = self.turns.take();
        *self.connection.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// Replies that came after their requests had been given up.
    pub fn late(&self) -> u64 {
        self.late.load(Ordering::Relaxed)
    }

    fn open(&self, deadline: Instant, timeout: Duration) -> Result<Connection, ClientError> {
        let failed = |to: String| {
            move |error: io::Error| match error.kind() {
                ErrorKind::TimedOut => ClientError::Timeout(timeout.as_secs_f64()),
                _ => ClientError::Connect { to, error },
            }
        };
        let at = |host: &str, port: u16| failed(format!("{host}:{port}"));
        let kind = match &self.endpoint {
            Endpoint::Tcp { host, port, tls } => {
                let stream =
                    TcpByteStream::connect(host, *port, deadline).map_err(at(host, *port))?;
                let session = Session::default();
                match tls {
                    None => Kind::Tcp { stream, session },
                    Some(tls) => {
                        let secure = TlsStream::agree(stream, tls, deadline);
                        Kind::Tls { stream: secure.map_err(at(host, *port))?.into(), session }
                    }
                }
            }
            Endpoint::RtuOverTcp { host, port } => {
                let stream =
                    TcpByteStream::connect(host, *port, deadline).map_err(at(host, *port))?;
                Kind::Rtu { line: Box::new(stream), silence: None, echo: false }
            }
            Endpoint::Udp { host, port } => {
                let socket = byte_stream::first(host, *port, |address| {
                    let any = if address.is_ipv6() { "[::]:0" } else { "0.0.0.0:0" };
                    let socket = UdpSocket::bind(any)?;
                    socket.connect(address)?;
                    Ok(socket)
                });
                Kind::Udp { socket: socket.map_err(at(host, *port))?, next_id: 0 }
            }
            Endpoint::Serial { line, echo } => {
                let port = line.open_blocking().map_err(failed(line.device.clone()))?;
                let (silence, line_of) = (line.silence(), Box::new(port));
                match line.mode {
                    LineMode::Rtu { .. } => {
                        Kind::Rtu { line: line_of, silence: Some(silence), echo: *echo }
                    }
                    LineMode::Ascii => Kind::Ascii { line: line_of, silence, echo: *echo },
                }
            }
        };
        Ok(Connection { kind, used: Instant::now(), timeouts: 0 })
    }
}

impl Connection {
    /// Whether the connection can't be used any more: the peer ended it while nobody used it, or
    /// sent what nobody asked for. Where replies have no ids, that would be taken for a reply.
    fn has_ended(&mut self) -> bool {
        match &mut self.kind {
            Kind::Tcp { stream, session } => {
                session.is_broken() || (self.used.elapsed() > IDLE && stream.has_ended())
            }
            Kind::Tls { stream, session } => {
                session.is_broken() || (self.used.elapsed() > IDLE && stream.has_ended())
            }
            Kind::Udp { .. } => false,
            Kind::Rtu { line, .. } | Kind::Ascii { line, .. } => !line.is_quiet(),
        }
    }

    fn exchange(
        &mut self,
        call: &Call<'_>,
        give: &mut dyn FnMut(Response<'_>),
        late: &AtomicU64,
    ) -> Result<(), Failure> {
        match &mut self.kind {
            Kind::Tcp { stream, session } => over_tcp(stream, session, call, give, late),
            Kind::Tls { stream, session } => over_tcp(&mut **stream, session, call, give, late),
            Kind::Udp { socket, next_id } => over_udp(socket, next_id, call, give, late),
            Kind::Rtu { line, silence, echo } => {
                over_rtu(line.as_mut(), *silence, self.used, echo, call, give)
            }
            Kind::Ascii { line, silence, echo } => {
                over_ascii(line.as_mut(), *silence, self.used, echo, call, give)
            }
        }
    }
}

impl Call<'_> {
    /// What an I/O error means to the caller.
    fn failed(&self, error: &io::Error, usable: bool) -> Failure {
        let error = match error.kind() {
            ErrorKind::TimedOut => ClientError::Timeout(self.timeout.as_secs_f64()),
            ErrorKind::UnexpectedEof => ClientError::Lost("closed by the peer".into()),
            _ => ClientError::Lost(error.to_string()),
        };
        Failure { error, usable }
    }

    /// The response that a PDU is.
    fn judge(&self, reply: &[u8], give: &mut dyn FnMut(Response<'_>)) -> Result<(), Failure> {
        match self.request.response(reply) {
            Ok(response) => {
                give(response);
                Ok(())
            }
            Err(error) => Err(refused(error)),
        }
    }

    fn is_read(&self) -> bool {
        !self.request.function().is_write() && !matches!(self.request, Request::Diagnostics(_))
    }

    fn is_broadcast(&self) -> bool {
        self.unit_id == 0
    }
}

/// A response that is an exception leaves the connection as it was; any other says that the two
/// sides mean different things.
fn refused(error: ResponseError) -> Failure {
    let usable = matches!(error, ResponseError::Exception(_) | ResponseError::UnknownException(_));
    Failure { error: error.into(), usable }
}

fn invalid(text: impl Into<String>) -> Failure {
    Failure { error: ClientError::Invalid(text.into()), usable: false }
}

fn over_tcp(
    stream: &mut impl ByteStream,
    session: &mut Session,
    call: &Call<'_>,
    give: &mut dyn FnMut(Response<'_>),
    late: &AtomicU64,
) -> Result<(), Failure> {
    let mut frame = Vec::with_capacity(mbap::MAX_LEN);
    let Some(id) = session.send(call.unit_id, call.pdu, &mut frame) else {
        return Err(Failure {
            error: ClientError::Lost("no transaction id is free".into()),
            usable: false,
        });
    };
    stream.send(&frame, call.deadline).map_err(|error| call.failed(&error, false))?;
    let mut chunk = [0; CHUNK];
    let mut done = None;
    while done.is_none() {
        let len = match stream.receive(&mut chunk, call.deadline) {
            Ok(len) => len,
            Err(error) => {
                session.give_up(id);
                let late = error.kind() == ErrorKind::TimedOut && !session.is_amid_reply();
                return Err(call.failed(&error, late));
            }
        };
        let before = session.late();
        let received = session.receive(&chunk[..len], |found, response| {
            if found == id {
                done = Some(response.map(&mut *give).map_err(refused));
            }
        });
        late.fetch_add(session.late() - before, Ordering::Relaxed);
        if let Err(broken) = received {
            // What breaks the connection behind the reply does not make the reply worse.
            return match (done, broken) {
                (Some(Ok(())), _) => Ok(()),
                (Some(Err(failure)), Broken::Response(_)) => Err(failure),
                (_, broken) => Err(invalid(broken.to_string())),
            };
        }
    }
    done.unwrap_or(Ok(()))
}

fn over_udp(
    socket: &mut UdpSocket,
    next_id: &mut u16,
    call: &Call<'_>,
    give: &mut dyn FnMut(Response<'_>),
    late: &AtomicU64,
) -> Result<(), Failure> {
    let id = *next_id;
    *next_id = id.wrapping_add(1);
    let frame = [&mbap::header(id, call.unit_id, call.pdu.len())[..], call.pdu].concat();
    let attempts = if call.is_read() { UDP_ATTEMPTS } else { 1 };
    let mut chunk = [0; mbap::MAX_LEN + 1];
    for attempt in (0..attempts).rev() {
        let until = call.deadline - call.timeout * attempt / attempts;
        socket.send(&frame).map_err(|error| call.failed(&error, false))?;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            socket.set_read_timeout(Some(left)).map_err(|error| call.failed(&error, false))?;
            let len = match socket.recv(&mut chunk) {
                Ok(len) => len,
                Err(error) => match error.kind() {
                    ErrorKind::Interrupted => continue,
                    ErrorKind::TimedOut | ErrorKind::WouldBlock => break,
                    _ => return Err(call.failed(&error, false)),
                },
            };
            match mbap::next(&chunk[..len]) {
                mbap::Next::Frame { transaction_id, unit_id, pdu, len: whole } if whole == len => {
                    if transaction_id == id && unit_id == call.unit_id {
                        return call.judge(pdu, give);
                    }
                    late.fetch_add(1, Ordering::Relaxed);
                }
                other => return Err(invalid(format!("a datagram that is no frame: {other:?}"))),
            }
        }
    }
    Err(call.failed(&ErrorKind::TimedOut.into(), true))
}

fn over_rtu(
    line: &mut dyn ByteStream,
    silence: Option<Duration>,
    used: Instant,
    echo: &mut bool,
    call: &Call<'_>,
    give: &mut dyn FnMut(Response<'_>),
) -> Result<(), Failure> {
    let serial = silence.is_some();
    let lost = |error: io::Error| {
        // A serial line has nothing to lose: what is late is thrown away before the next request.
        call.failed(&error, serial && error.kind() == ErrorKind::TimedOut)
    };
    if let Some(silence) = silence {
        settle(line, silence, used, call.deadline).map_err(lost)?;
    }
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(call.unit_id, call.pdu, &mut frame)
        .ok_or_else(|| invalid("the request can't be framed"))?;
    let frame = &frame[..len];
    line.send(frame, call.deadline).map_err(lost)?;
    if serial && call.is_broadcast() {
        thread::sleep(TURNAROUND);
        give(Response::Written);
        return Ok(());
    }
    // Room for an echo and a reply.
    let mut received = [0; 2 * rtu::MAX_LEN];
    let (mut len, mut stripped) = (0, false);
    loop {
        let may_be_echo = !stripped && (*echo || (serial && call.is_read()));
        if may_be_echo {
            stripped = strip(&mut received, &mut len, frame);
            *echo |= stripped;
        }
        // The beginning of an echo is no damaged reply.
        let echo_begun = may_be_echo && !stripped && frame.starts_with(&received[..len]);
        let reply =
            if stripped || !*echo { rtu_reply(&received[..len], call.pdu.len()) } else { Ok(None) };
        match reply {
            Ok(Some((unit_id, _))) if unit_id != call.unit_id => {
                let error = format!("a reply from unit {unit_id} to a request to {}", call.unit_id);
                return Err(unusable(&error, serial));
            }
            Ok(Some((_, pdu))) => {
                let judged = call.judge(pdu, give);
                return judged
                    .map_err(|failure| Failure { usable: failure.usable || serial, ..failure });
            }
            Err(error) if !echo_begun => return Err(unusable(&error, serial)),
            Ok(None) | Err(_) => {}
        }
        if len == received.len() {
            return Err(invalid("more bytes than a reply has"));
        }
        len += line.receive(&mut received[len..], call.deadline).map_err(lost)?;
    }
}

/// Unit id and PDU of the reply at the start of some bytes; `None` while more are needed.
fn rtu_reply(bytes: &[u8], request_len: usize) -> Result<Option<(u8, &[u8])>, FrameError> {
    let len = rtu::response_len(bytes, request_len)?;
    len.and_then(|len| bytes.get(..len)).map(rtu::decode).transpose()
}

/// Waits until a serial line is silent, and throws away what has come till then: nobody asked for
/// it, or nobody waits for it any more.
fn settle(
    line: &mut dyn ByteStream,
    silence: Duration,
    used: Instant,
    deadline: Instant,
) -> io::Result<()> {
    thread::sleep(silence.saturating_sub(used.elapsed()));
    while line.discard()? {
        if Instant::now() > deadline {
            return Err(ErrorKind::TimedOut.into());
        }
        thread::sleep(silence);
    }
    Ok(())
}

fn unusable(error: &dyn std::fmt::Display, serial: bool) -> Failure {
    Failure { error: ClientError::Invalid(error.to_string()), usable: serial }
}

/// Takes the request itself from the front of what came, as adapters hand it back that hear what
/// they send; whether it was there.
fn strip(received: &mut [u8], len: &mut usize, frame: &[u8]) -> bool {
    if !received[..*len].starts_with(frame) {
        return false;
    }
    received.copy_within(frame.len()..*len, 0);
    *len -= frame.len();
    true
}

fn over_ascii(
    line: &mut dyn ByteStream,
    silence: Duration,
    used: Instant,
    echo: &mut bool,
    call: &Call<'_>,
    give: &mut dyn FnMut(Response<'_>),
) -> Result<(), Failure> {
    let lost = |error: io::Error| call.failed(&error, error.kind() == ErrorKind::TimedOut);
    settle(line, silence, used, call.deadline).map_err(lost)?;
    let mut frame = [0; ascii::MAX_LEN];
    let len = ascii::encode(call.unit_id, call.pdu, &mut frame)
        .ok_or_else(|| invalid("the request can't be framed"))?;
    let frame = &frame[..len];
    line.send(frame, call.deadline).map_err(lost)?;
    if call.is_broadcast() {
        thread::sleep(TURNAROUND);
        give(Response::Written);
        return Ok(());
    }
    let mut received: Vec<u8> = Vec::with_capacity(ascii::MAX_LEN);
    let mut chunk = [0; 256];
    let mut echo_expected = *echo;
    loop {
        if let Some(end) = received.windows(2).position(|pair| pair == b"\r\n") {
            let start = received[..end].iter().rposition(|byte| *byte == b':').unwrap_or(0);
            let reply: Vec<u8> = received.drain(..end + 2).skip(start).collect();
            if reply == frame && (echo_expected || call.is_read()) {
                (*echo, echo_expected) = (true, false);
                continue;
            }
            let mut body = [0; pdu::MAX_LEN + 2];
            let (unit_id, pdu) =
                ascii::decode(&reply, &mut body).map_err(|error| unusable(&error, true))?;
            if unit_id != call.unit_id {
                let error = format!("a reply from unit {unit_id} to a request to {}", call.unit_id);
                return Err(unusable(&error, true));
            }
            let judged = call.judge(pdu, give);
            return judged.map_err(|failure| Failure { usable: true, ..failure });
        }
        if received.len() > 2 * ascii::MAX_LEN {
            return Err(unusable(&"more characters than a reply has", true));
        }
        let len = line.receive(&mut chunk, call.deadline).map_err(lost)?;
        received.extend_from_slice(&chunk[..len]);
    }
}
