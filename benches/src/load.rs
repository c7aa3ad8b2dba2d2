//! A closed-loop Modbus TCP load: every connection keeps a number of requests in flight, and sends
//! as many new ones as it gets replies. Every reply must be the same bytes as the first.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use holdfast_protocol::frame::mbap;
use holdfast_protocol::pdu::{self, Range, Request};
use lexopt::ValueExt;
use rustix::time::{ClockId, clock_gettime};

use crate::{Failure, Poller};

/// Every request has it, so that every reply is the same.
const TRANSACTION_ID: u16 = 0x1234;

/// A server that is silent for so long fails the run.
const PATIENCE: Duration = Duration::from_secs(5);

struct Options {
    address: SocketAddr,
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
    sent: VecDeque<Instant>,
}

/// `--address A --connections C --in-flight K --quantity Q --warmup S --seconds S`: prints the rate,
/// latencies in microseconds and its own CPU seconds as JSON.
pub fn main() -> Result<(), Failure> {
    let options = parse()?;
    let request = request(options.quantity)?;
    let reply = first_reply(&options, &request)?;
    let requests = request.repeat(options.in_flight);
    let replies = reply.repeat(options.in_flight);

    let mut poller = Poller::new()?;
    let mut connections = Vec::new();
    for number in 0..options.connections {
        let stream = TcpStream::connect(options.address)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        poller.add(&stream, number)?;
        let sent = VecDeque::with_capacity(options.in_flight);
        connections.push(Connection { stream, part: 0, sent });
    }
    let mut latencies = Histogram::<u64>::new_with_bounds(1, 60_000_000_000, 3)?;
    let start = Instant::now();
    for connection in &mut connections {
        connection.send(&requests, options.in_flight)?;
    }
    let (measure_from, end) = (start + options.warmup, start + options.warmup + options.measured);
    let mut buffer = vec![0; replies.len()];
    let mut now = start;
    while now < end {
        for number in poller.wait()? {
            let connection = &mut connections[number];
            let answered = connection.receive(&replies, reply.len(), &mut buffer)?;
            now = Instant::now();
            for sent in connection.sent.drain(..answered) {
                if now >= measure_from && now < end {
                    latencies.record((now - sent).as_nanos() as u64)?;
                }
            }
            connection.send(&requests[..answered * request.len()], answered)?;
        }
    }
    report(&options, &latencies);
    Ok(())
}

impl Connection {
    fn send(&mut self, requests: &[u8], count: usize) -> Result<(), Failure> {
        if count > 0 {
            let now = Instant::now();
            self.sent.extend(std::iter::repeat_n(now, count));
            self.stream.write_all(requests)?;
        }
        Ok(())
    }

    /// Reads once; how many replies are whole.
    fn receive(
        &mut self,
        replies: &[u8],
        reply_len: usize,
        buffer: &mut [u8],
    ) -> Result<usize, Failure> {
        let room = self.sent.len() * reply_len - self.part;
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
        Ok(bytes / reply_len)
    }
}

fn parse() -> Result<Options, Failure> {
    let mut options = Options {
        address: SocketAddr::from(([127, 0, 0, 1], 502)),
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
            "connections" => options.connections = value.parse()?,
            "in-flight" => options.in_flight = value.parse()?,
            "quantity" => options.quantity = value.parse()?,
            "warmup" => options.warmup = Duration::try_from_secs_f64(value.parse()?)?,
            "seconds" => options.measured = Duration::try_from_secs_f64(value.parse()?)?,
            _ => return Err(format!("unknown option --{name}").into()),
        }
    }
    Ok(options)
}

/// One frame: `quantity` holding registers from address 0 of unit 1.
fn request(quantity: u16) -> Result<Vec<u8>, Failure> {
    let mut buffer = [0; pdu::MAX_LEN];
    let request = Request::ReadHoldingRegisters(Range { address: 0, quantity });
    let len = request.encode(&mut buffer).ok_or("a quantity of 1 to 125 is allowed")?;
    Ok([&mbap::header(TRANSACTION_ID, 1, len)[..], &buffer[..len]].concat())
}

/// What the server answers, which must be registers.
fn first_reply(options: &Options, request: &[u8]) -> Result<Vec<u8>, Failure> {
    let mut stream = TcpStream::connect(options.address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.write_all(request)?;
    let mut reply = vec![0; mbap::HEADER_LEN + 2 + usize::from(options.quantity) * 2];
    stream.read_exact(&mut reply)?;
    if reply[..2] != TRANSACTION_ID.to_be_bytes() || reply[mbap::HEADER_LEN] != 3 {
        return Err("the server did not answer with registers".into());
    }
    Ok(reply)
}

fn report(options: &Options, latencies: &Histogram<u64>) {
    let cpu = clock_gettime(ClockId::ProcessCPUTime);
    let cpu = cpu.tv_sec as f64 + cpu.tv_nsec as f64 / 1e9;
    let micros = |quantile| latencies.value_at_quantile(quantile) as f64 / 1e3;
    println!(
        r#"{{"requests": {}, "rate": {:.1}, "p50": {:.2}, "p99": {:.2}, "p999": {:.2}, "max": {:.2}, "cpu": {cpu:.3}}}"#,
        latencies.len(),
        latencies.len() as f64 / options.measured.as_secs_f64(),
        micros(0.5),
        micros(0.99),
        micros(0.999),
        latencies.max() as f64 / 1e3,
    );
}
