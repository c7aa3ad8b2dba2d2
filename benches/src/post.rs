//! A closed-loop load of one HTTP request: every connection stays open, with one request in flight.
//! Every reply must be 200 with the same body as the first.

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::thread;
use std::time::Instant;

use crate::outcome::{Outcome, Period};
use crate::{Failure, TIMEOUT, options};

/// The length limit of a reply.
const REPLY: usize = 4096;

/// Bytes per write. The system copies them without interruption, which delays other processes on
/// the core.
const PIECE: usize = 16384;

struct Options {
    address: SocketAddr,
    path: String,
    token: String,
    body: Vec<u8>,
    connections: usize,
    period: Period,
}

/// `--address A --path P --token T --body FILE --connections C --warmup S --seconds S`.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let options = parse(arguments)?;
    let request = request(&options);
    let expected = Client::new(options.address)?.ask(&request)?;
    let mut outcome = Outcome::new(options.period)?;
    let outcomes: Vec<Result<Outcome, String>> = thread::scope(|scope| {
        let one = || run(&options, &request, &expected).map_err(|error| error.to_string());
        let clients: Vec<_> = (0..options.connections).map(|_| scope.spawn(one)).collect();
        let joined = clients.into_iter().map(|client| client.join());
        joined.map(|one| one.unwrap_or_else(|_| Err("a client panicked".into()))).collect()
    });
    outcome.ended();
    for one in outcomes {
        outcome.merge(&one?)?;
    }
    outcome.report();
    Ok(())
}

fn run(options: &Options, request: &[u8], expected: &[u8]) -> Result<Outcome, Failure> {
    let mut client = Client::new(options.address)?;
    let mut outcome = Outcome::new(options.period)?;
    let mut now = Instant::now();
    while now < outcome.end() {
        let sent = now;
        if client.ask(request)? != expected {
            return Err("a reply differs from the first one".into());
        }
        now = Instant::now();
        outcome.record(sent, now, 1)?;
    }
    Ok(outcome)
}

struct Client {
    stream: TcpStream,
    buffer: Vec<u8>,
}

impl Client {
    fn new(address: SocketAddr) -> Result<Client, Failure> {
        let stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(2 * TIMEOUT))?;
        stream.set_write_timeout(Some(2 * TIMEOUT))?;
        Ok(Client { stream, buffer: vec![0; REPLY] })
    }

    /// Sends a request and returns the body of the reply.
    fn ask(&mut self, request: &[u8]) -> Result<Vec<u8>, Failure> {
        for piece in request.chunks(PIECE) {
            self.stream.write_all(piece)?;
        }
        let mut len = 0;
        loop {
            match self.stream.read(&mut self.buffer[len..])? {
                0 => return Err("the server closed a connection, or the reply is too long".into()),
                more => len += more,
            }
            if let Some(body) = body(&self.buffer[..len])? {
                return Ok(body.to_vec());
            }
        }
    }
}

/// The body of a reply, if it is complete.
fn body(reply: &[u8]) -> Result<Option<&[u8]>, Failure> {
    let Some(head_len) = reply.windows(4).position(|four| four == b"\r\n\r\n") else {
        return Ok(None);
    };
    let head = str::from_utf8(&reply[..head_len])?.to_ascii_lowercase();
    if !head.starts_with("http/1.1 200 ") {
        return Err(String::from_utf8_lossy(reply).into());
    }
    let len = head.lines().find_map(|line| line.strip_prefix("content-length:"));
    let len: usize = len.ok_or("the reply has no content-length")?.trim().parse()?;
    let body = &reply[head_len + 4..];
    if body.len() > len {
        return Err("the reply is longer than its content-length".into());
    }
    Ok((body.len() == len).then_some(body))
}

fn request(options: &Options) -> Vec<u8> {
    let Options { address, path, token, body, .. } = options;
    let head = format!(
        "POST {path} HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\n\
         Content-Type: application/json\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    [head.as_bytes(), body].concat()
}

fn parse(arguments: lexopt::Parser) -> Result<Options, Failure> {
    let mut parsed = Options {
        address: SocketAddr::from(([127, 0, 0, 1], 8080)),
        path: "/".into(),
        token: String::new(),
        body: Vec::new(),
        connections: 1,
        period: Period::DEFAULT,
    };
    options(arguments, |name, value| {
        match name {
            "address" => parsed.address = value.parse()?,
            "path" => parsed.path = value,
            "token" => parsed.token = value,
            "body" => parsed.body = fs::read(value)?,
            "connections" => parsed.connections = value.parse()?,
            _ => return parsed.period.set(name, &value),
        }
        Ok(true)
    })?;
    Ok(parsed)
}
