//! A closed-loop load of Modbus TCP or HTTP: every connection keeps a number of requests in flight, and
//! sends a new one for each reply. Every reply must equal the first, but for the date of HTTP.
//!
//! Replies arrive in the order of the requests, so a queue of send times gives the latency of each.
//! At the end, the load waits for the requests in flight: a request without a reply fails the run.

use std::collections::VecDeque;
use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::ops::Range;
use std::time::Instant;

use holdfast_protocol::frame::mbap::{self, Next};
use holdfast_protocol::pdu::{self, Registers, Request};

use crate::outcome::{Outcome, Period};
use crate::poller::Poller;
use crate::{Failure, TIMEOUT, http, options};

/// The same for every request, so that all replies are equal.
const TRANSACTION_ID: u16 = 0x1234;

/// Requests in flight must fit into the buffers of a socket, or both sides wait for the other to
/// read.
const MAX_IN_FLIGHT: usize = 4096;

/// Bytes per write. The system copies them without interruption, which delays other processes on
/// the core.
const PIECE: usize = 16384;

struct Options {
    address: SocketAddr,
    request: String,
    http: Vec<Vec<u8>>,
    connections: usize,
    in_flight: usize,
    quantity: u16,
    period: Period,
}

struct Connection {
    stream: TcpStream,
    /// Bytes of an incomplete reply.
    part: usize,
    /// Requests in flight.
    open: usize,
    /// The send times, and the number of requests sent together, oldest first.
    sent: VecDeque<(Instant, usize)>,
}

/// `--address A --connections C --in-flight K --request read-registers|read-coils|write-registers
/// --quantity Q --warmup S --seconds S`; with `--http FILE`, the request is in the file. With several
/// files, each connection sends the request of another one.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let options = parse(arguments)?;
    let exchanges = exchanges(&options)?;
    let longest = exchanges.iter().map(|one| one.expected.replies.len()).max().unwrap_or_default();
    let mut load = Load {
        poller: Poller::new()?,
        connections: Vec::with_capacity(options.connections),
        exchanges,
        buffer: vec![0; longest],
    };
    load.connect(&options)?;
    let mut outcome = Outcome::new(options.period)?;
    load.run(&mut outcome)?;
    outcome.ended();
    load.finish(&mut outcome)?;
    outcome.report();
    Ok(())
}

struct Load {
    poller: Poller,
    connections: Vec<Connection>,
    /// Connection N has that of number N modulo their count.
    exchanges: Vec<Exchange>,
    buffer: Vec<u8>,
}

/// What a connection sends and receives.
struct Exchange {
    /// All requests in flight, as bytes.
    requests: Vec<u8>,
    request_len: usize,
    expected: Expected,
}

fn exchanges(options: &Options) -> Result<Vec<Exchange>, Failure> {
    let exchange = |request: &[u8], (reply, date): (Vec<u8>, Range<usize>)| Exchange {
        requests: request.repeat(options.in_flight),
        request_len: request.len(),
        expected: Expected { replies: reply.repeat(options.in_flight), len: reply.len(), date },
    };
    if options.http.is_empty() {
        let request = request(&options.request, options.quantity)?;
        let reply = first_reply(options.address, &request)?;
        return Ok(vec![exchange(&request, (reply, 0..0))]);
    }
    let of =
        |request: &Vec<u8>| Ok(exchange(request, http::first_reply(options.address, request)?));
    options.http.iter().map(of).collect()
}

/// What the server has to answer.
struct Expected {
    replies: Vec<u8>,
    /// The length of one reply.
    len: usize,
    /// Where one reply has a date.
    date: Range<usize>,
}

impl Load {
    fn connect(&mut self, options: &Options) -> Result<(), Failure> {
        for number in 0..options.connections {
            let stream = TcpStream::connect(options.address)?;
            stream.set_nodelay(true)?;
            stream.set_read_timeout(Some(TIMEOUT))?;
            stream.set_write_timeout(Some(TIMEOUT))?;
            self.poller.add(&stream, number)?;
            let sent = VecDeque::with_capacity(options.in_flight);
            self.connections.push(Connection { stream, part: 0, open: 0, sent });
        }
        let now = Instant::now();
        for (connection, exchange) in self.connections.iter_mut().zip(self.exchanges.iter().cycle())
        {
            connection.send(&exchange.requests, options.in_flight, now)?;
        }
        Ok(())
    }

    /// Keeps requests in flight until the period ends.
    fn run(&mut self, outcome: &mut Outcome) -> Result<(), Failure> {
        let end = outcome.end();
        let mut now = Instant::now();
        while now < end {
            let ready = self.poller.wait(Some(TIMEOUT))?;
            if ready.len() == 0 {
                return Err("the server does not answer".into());
            }
            for number in ready {
                let connection = &mut self.connections[number];
                let exchange = &self.exchanges[number % self.exchanges.len()];
                let mut left = connection.receive(&exchange.expected, &mut self.buffer)?;
                let answered = left;
                now = Instant::now();
                while let Some((sent, count)) = connection.take(&mut left) {
                    outcome.record(sent, now, count)?;
                }
                let requests = &exchange.requests[..answered * exchange.request_len];
                connection.send(requests, answered, now)?;
            }
        }
        Ok(())
    }

    /// Waits for the outstanding replies.
    fn finish(&mut self, outcome: &mut Outcome) -> Result<(), Failure> {
        let deadline = Instant::now() + TIMEOUT;
        let mut open: usize = self.connections.iter().map(|connection| connection.open).sum();
        while open > 0 {
            let patience = deadline.saturating_duration_since(Instant::now());
            let ready = self.poller.wait(Some(patience))?;
            if ready.len() == 0 {
                return Err(format!("{open} requests got no reply").into());
            }
            for number in ready {
                let connection = &mut self.connections[number];
                let exchange = &self.exchanges[number % self.exchanges.len()];
                let answered = connection.receive(&exchange.expected, &mut self.buffer)?;
                open -= answered;
                outcome.late(answered);
            }
        }
        Ok(())
    }
}

impl Expected {
    /// Replaces the dates in a part of replies that begins at `at` by the expected ones.
    fn forget_dates(&self, received: &mut [u8], at: usize) {
        let end = at + received.len();
        if self.date.is_empty() {
            return;
        }
        for reply in (0..end).step_by(self.len) {
            let (from, to) = (at.max(reply + self.date.start), end.min(reply + self.date.end));
            if from < to {
                received[from - at..to - at].copy_from_slice(&self.replies[from..to]);
            }
        }
    }
}

impl Connection {
    fn send(&mut self, requests: &[u8], count: usize, now: Instant) -> Result<(), Failure> {
        if count > 0 {
            self.open += count;
            self.sent.push_back((now, count));
            for piece in requests.chunks(PIECE) {
                self.stream.write_all(piece)?;
            }
        }
        Ok(())
    }

    /// Takes the send time of the oldest of `left` answered requests, and the number sent together.
    fn take(&mut self, left: &mut usize) -> Option<(Instant, usize)> {
        let (sent, together) = self.sent.front_mut().filter(|_| *left > 0)?;
        let (sent, count) = (*sent, (*together).min(*left));
        *together -= count;
        *left -= count;
        if *together == 0 {
            self.sent.pop_front();
        }
        Some((sent, count))
    }

    /// Reads once. Returns the number of complete replies.
    fn receive(&mut self, expected: &Expected, buffer: &mut [u8]) -> Result<usize, Failure> {
        let room = self.open * expected.len - self.part;
        if room == 0 {
            return Err("a reply to no request, or the server closed a connection".into());
        }
        let len = match self.stream.read(&mut buffer[..room]) {
            Ok(0) => return Err("the server closed a connection".into()),
            Ok(len) => len,
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                return Err("the server does not answer".into());
            }
            Err(error) => return Err(error.into()),
        };
        let received = &mut buffer[..len];
        expected.forget_dates(received, self.part);
        if received != &expected.replies[self.part..self.part + len] {
            let found = String::from_utf8_lossy(received);
            return Err(format!("a reply differs from the first one: {found}").into());
        }
        let bytes = self.part + len;
        self.part = bytes % expected.len;
        self.open -= bytes / expected.len;
        Ok(bytes / expected.len)
    }
}

fn parse(arguments: lexopt::Parser) -> Result<Options, Failure> {
    let mut parsed = Options {
        address: SocketAddr::from(([127, 0, 0, 1], 502)),
        request: "read-registers".into(),
        http: Vec::new(),
        connections: 1,
        in_flight: 1,
        quantity: 10,
        period: Period::DEFAULT,
    };
    options(arguments, |name, value| {
        match name {
            "address" => parsed.address = value.parse()?,
            "request" => parsed.request = value,
            "http" => parsed.http.push(fs::read(value)?),
            "connections" => parsed.connections = value.parse()?,
            "in-flight" => parsed.in_flight = value.parse()?,
            "quantity" => parsed.quantity = value.parse()?,
            _ => return parsed.period.set(name, &value),
        }
        Ok(true)
    })?;
    if parsed.connections == 0 || !(1..=MAX_IN_FLIGHT).contains(&parsed.in_flight) {
        return Err(format!(
            "at least 1 connection and 1 to {MAX_IN_FLIGHT} requests in flight are required"
        )
        .into());
    }
    Ok(parsed)
}

/// One frame: `quantity` items from address 0 of unit 1. A write writes 0, 1, 2, ...
pub(crate) fn request(kind: &str, quantity: u16) -> Result<Vec<u8>, Failure> {
    let registers: Vec<u8> = (0..quantity).flat_map(u16::to_be_bytes).collect();
    let request = match kind {
        "read-registers" => Request::ReadHoldingRegisters(pdu::Range::new(0, quantity)?),
        "read-coils" => Request::ReadCoils(pdu::Range::new(0, quantity)?),
        "write-registers" => {
            let registers = Registers::new(&registers)?;
            Request::WriteMultipleRegisters { address: 0, registers }
        }
        other => return Err(format!("unknown request {other}").into()),
    };
    let mut buffer = [0; pdu::MAX_LEN];
    let len = request.encode(&mut buffer);
    Ok([&mbap::header(TRANSACTION_ID, 1, len)[..], &buffer[..len]].concat())
}

/// The first reply of the server, which must not be an exception.
pub(crate) fn first_reply(address: SocketAddr, request: &[u8]) -> Result<Vec<u8>, Failure> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.write_all(request)?;
    let mut reply = [0; mbap::MAX_LEN];
    let mut len = 0;
    loop {
        match mbap::next(&reply[..len]) {
            Next::Frame { len: whole, .. } if whole == len => break,
            Next::Incomplete => {}
            other => {
                return Err(format!("the server did not answer with a frame: {other:?}").into());
            }
        }
        match stream.read(&mut reply[len..])? {
            0 => return Err("the server closed the first connection".into()),
            more => len += more,
        }
    }
    if reply[..2] != request[..2] || reply[mbap::HEADER_LEN] != request[mbap::HEADER_LEN] {
        return Err("the server did not answer the request".into());
    }
    Ok(reply[..len].to_vec())
}
