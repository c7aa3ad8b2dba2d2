//! A closed-loop Modbus TCP load: every connection keeps a number of requests in flight, and sends
//! as many new ones as it gets replies. Every reply must be the same bytes as the first.
//!
//! Replies come in the order of the requests, so a queue of the times of sending gives the latency of
//! each. What is in flight at the end is waited for: a request without a reply fails the run.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use holdfast_protocol::frame::mbap::{self, Next};
use holdfast_protocol::pdu::{self, Range, Request};
use lexopt::ValueExt;
use rustix::time::{ClockId, clock_gettime};

use crate::{Failure, Poller};

/// Every request has it, so that every reply is the same.
const TRANSACTION_ID: u16 = 0x1234;

/// A server that is silent for so long fails the run.
const PATIENCE: Duration = Duration::from_secs(5);

/// What is in flight must fit into a socket's buffers, or both sides wait for the other to read.
const MAX_IN_FLIGHT: usize = 4096;

struct Options {
    address: SocketAddr,
    request: String,
    connections: usize,
    in_flight: usize,
    quantity: u16,
    warmup: Duration,
    measured: Duration,
}

struct Connection {
    stream: TcpStream,
    /// Bytes of a reply that is not whole yet.
    part: usize,
    /// Requests without a reply yet.
    open: usize,
    /// When they were sent, and how many at once, the oldest first.
    sent: VecDeque<(Instant, usize)>,
}

/// `--address A --connections C --in-flight K --request read-registers|read-coils|write-registers
/// --quantity Q --warmup S --seconds S`: prints the rate, latencies in microseconds and its own
/// processor time as JSON.
pub fn main() -> Result<(), Failure> {
    let options = parse()?;
    let request = request(&options)?;
    let reply = first_reply(&options, &request)?;
    let mut load = Load {
        poller: Poller::new()?,
        connections: Vec::with_capacity(options.connections),
        requests: request.repeat(options.in_flight),
        replies: reply.repeat(options.in_flight),
        buffer: vec![0; reply.len() * options.in_flight],
        request_len: request.len(),
        reply_len: reply.len(),
        latencies: Histogram::new_with_bounds(1, 60_000_000_000, 3)?,
        answered: 0,
    };
    load.connect(&options)?;
    let (cpu, start) = (cpu_seconds(), Instant::now());
    load.run(start + options.warmup, start + options.warmup + options.measured)?;
    let busy = (cpu_seconds() - cpu) / start.elapsed().as_secs_f64();
    load.finish()?;
    load.report(&options, busy);
    Ok(())
}

struct Load {
    poller: Poller,
    connections: Vec<Connection>,
    /// As many as can be in flight, as one piece of bytes.
    requests: Vec<u8>,
    replies: Vec<u8>,
    buffer: Vec<u8>,
    request_len: usize,
    reply_len: usize,
    latencies: Histogram<u64>,
    /// Requests that got their reply, whether they count or not.
    answered: usize,
}

impl Load {
    fn connect(&mut self, options: &Options) -> Result<(), Failure> {
        for number in 0..options.connections {
            let stream = TcpStream::connect(options.address)?;
            stream.set_nodelay(true)?;
            stream.set_read_timeout(Some(PATIENCE))?;
            stream.set_write_timeout(Some(PATIENCE))?;
            self.poller.add(&stream, number)?;
            let sent = VecDeque::with_capacity(options.in_flight);
            self.connections.push(Connection { stream, part: 0, open: 0, sent });
        }
        let now = Instant::now();
        for connection in &mut self.connections {
            connection.send(&self.requests, options.in_flight, now)?;
        }
        Ok(())
    }

    /// Keeps the requests in flight until `end`; replies from `measure_from` on count.
    fn run(&mut self, measure_from: Instant, end: Instant) -> Result<(), Failure> {
        let mut now = Instant::now();
        while now < end {
            let ready = self.poller.wait(Some(PATIENCE))?;
            if ready.len() == 0 {
                return Err("the server is silent".into());
            }
            for number in ready {
                let connection = &mut self.connections[number];
                let mut left =
                    connection.receive(&self.replies, self.reply_len, &mut self.buffer)?;
                let answered = left;
                now = Instant::now();
                while let Some((sent, count)) = connection.take(&mut left) {
                    if now >= measure_from && now < end {
                        self.latencies.record_n((now - sent).as_nanos() as u64, count as u64)?;
                    }
                }
                let requests = &self.requests[..answered * self.request_len];
                connection.send(requests, answered, now)?;
                self.answered += answered;
            }
        }
        Ok(())
    }

    /// Waits for the replies that are still to come.
    fn finish(&mut self) -> Result<(), Failure> {
        let deadline = Instant::now() + PATIENCE;
        let mut open: usize = self.connections.iter().map(|connection| connection.open).sum();
        while open > 0 {
            let patience = deadline.saturating_duration_since(Instant::now());
            let ready = self.poller.wait(Some(patience))?;
            if ready.len() == 0 {
                return Err(format!("{open} requests got no reply").into());
            }
            for number in ready {
                let connection = &mut self.connections[number];
                let answered =
                    connection.receive(&self.replies, self.reply_len, &mut self.buffer)?;
                open -= answered;
                self.answered += answered;
            }
        }
        Ok(())
    }

    fn report(&self, options: &Options, busy: f64) {
        let micros = |nanos: u64| nanos as f64 / 1e3;
        let at = |quantile| micros(self.latencies.value_at_quantile(quantile));
        let (requests, seconds) = (self.latencies.len(), options.measured.as_secs_f64());
        println!(
            r#"{{"requests": {requests}, "answered": {}, "seconds": {seconds}, "rate": {:.1}, "p50": {:.2}, "p99": {:.2}, "p999": {:.2}, "max": {:.2}, "cpu": {:.3}, "busy": {busy:.3}}}"#,
            self.answered,
            requests as f64 / seconds,
            at(0.5),
            at(0.99),
            at(0.999),
            micros(self.latencies.max()),
            cpu_seconds(),
        );
    }
}

impl Connection {
    fn send(&mut self, requests: &[u8], count: usize, now: Instant) -> Result<(), Failure> {
        if count > 0 {
            self.open += count;
            self.sent.push_back((now, count));
            self.stream.write_all(requests)?;
        }
        Ok(())
    }

    /// When the oldest of `left` answered requests were sent, and how many of them at once.
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

    /// Reads once; how many replies are whole.
    fn receive(
        &mut self,
        replies: &[u8],
        reply_len: usize,
        buffer: &mut [u8],
    ) -> Result<usize, Failure> {
        let room = self.open * reply_len - self.part;
        if room == 0 {
            return Err("a reply to no request, or the server closed a connection".into());
        }
        let len = match self.stream.read(&mut buffer[..room]) {
            Ok(0) => return Err("the server closed a connection".into()),
            Ok(len) => len,
            Err(error) if error.kind() == ErrorKind::WouldBlock => return Err("silence".into()),
            Err(error) => return Err(error.into()),
        };
        if buffer[..len] != replies[self.part..self.part + len] {
            return Err("a reply is not what it was at first".into());
        }
        let bytes = self.part + len;
        self.part = bytes % reply_len;
        self.open -= bytes / reply_len;
        Ok(bytes / reply_len)
    }
}

fn parse() -> Result<Options, Failure> {
    let mut options = Options {
        address: SocketAddr::from(([127, 0, 0, 1], 502)),
        request: "read-registers".into(),
        connections: 1,
        in_flight: 1,
        quantity: 10,
        warmup: Duration::from_millis(300),
        measured: Duration::from_secs(2),
    };
    let mut arguments = lexopt::Parser::from_env();
    while let Some(argument) = arguments.next()? {
        let lexopt::Arg::Long(name) = argument else {
            return Err(argument.unexpected().into());
        };
        let name = name.to_owned();
        let value = arguments.value()?.string()?;
        match name.as_str() {
            "address" => options.address = value.parse()?,
            "request" => options.request = value,
            "connections" => options.connections = value.parse()?,
            "in-flight" => options.in_flight = value.parse()?,
            "quantity" => options.quantity = value.parse()?,
            "warmup" => options.warmup = Duration::try_from_secs_f64(value.parse()?)?,
            "seconds" => options.measured = Duration::try_from_secs_f64(value.parse()?)?,
            _ => return Err(format!("unknown option --{name}").into()),
        }
    }
    if options.connections == 0 || !(1..=MAX_IN_FLIGHT).contains(&options.in_flight) {
        return Err(format!("1 connection or more, 1 to {MAX_IN_FLIGHT} in flight").into());
    }
    Ok(options)
}

/// One frame: `quantity` items from address 0 of unit 1. What is written is 0, 1, 2, ...
fn request(options: &Options) -> Result<Vec<u8>, Failure> {
    let range = Range { address: 0, quantity: options.quantity };
    let registers: Vec<u8> = (0..options.quantity).flat_map(u16::to_be_bytes).collect();
    let request = match options.request.as_str() {
        "read-registers" => Request::ReadHoldingRegisters(range),
        "read-coils" => Request::ReadCoils(range),
        "write-registers" => Request::WriteMultipleRegisters { range, registers: &registers },
        other => return Err(format!("unknown request {other}").into()),
    };
    let mut buffer = [0; pdu::MAX_LEN];
    let len = request.encode(&mut buffer).ok_or("the quantity is not one of the function's")?;
    Ok([&mbap::header(TRANSACTION_ID, 1, len)[..], &buffer[..len]].concat())
}

/// What the server answers, which must not be an exception.
fn first_reply(options: &Options, request: &[u8]) -> Result<Vec<u8>, Failure> {
    let mut stream = TcpStream::connect(options.address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
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

/// Processor time of this process so far.
fn cpu_seconds() -> f64 {
    let cpu = clock_gettime(ClockId::ProcessCPUTime);
    cpu.tv_sec as f64 + cpu.tv_nsec as f64 / 1e9
}
