//! A closed-loop load with one connection per packet: connect, send, read the reply byte, close.
//! Every reply must be 00.
//!
//! The server closes first, so its side of the connection would stay in TIME_WAIT, and the port of
//! the client could not be used again for a minute. The load ends each connection with a reset,
//! which also ends the server's side. So nothing stays behind, however long the load runs.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use rustix::net::sockopt::set_socket_linger;

use crate::outcome::{Outcome, Period};
use crate::poller::Poller;
use crate::{Failure, TIMEOUT, options, unhex};

const DONE: u8 = 0;

struct Load {
    address: SocketAddr,
    packet: Vec<u8>,
    poller: Poller,
}

struct Attempt {
    stream: TcpStream,
    began: Instant,
}

/// `--address A --in-flight K --packet HEX --warmup S --seconds S`: the latency is the time from
/// connecting to the reply.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let (mut in_flight, mut period) = (1, Period::DEFAULT);
    let address = SocketAddr::from(([127, 0, 0, 1], 9000));
    let mut load = Load { address, packet: Vec::new(), poller: Poller::new()? };
    options(arguments, |name, value| {
        match name {
            "address" => load.address = value.parse()?,
            "in-flight" => in_flight = value.parse()?,
            "packet" => load.packet = unhex(&value)?,
            _ => return period.set(name, &value),
        }
        Ok(true)
    })?;
    let mut outcome = Outcome::new(period)?;
    load.run(in_flight, &mut outcome)?;
    outcome.report();
    Ok(())
}

impl Load {
    /// Keeps packets in flight until the period ends, and waits for the last ones.
    fn run(&mut self, in_flight: usize, outcome: &mut Outcome) -> Result<(), Failure> {
        let mut attempts: Vec<Option<Attempt>> = Vec::with_capacity(in_flight);
        for number in 0..in_flight {
            attempts.push(Some(self.begin(number)?));
        }
        let (mut open, end) = (in_flight, outcome.end());
        while open > 0 {
            let ready: Vec<usize> = self.poller.wait(Some(TIMEOUT))?.collect();
            if ready.is_empty() {
                return Err(format!("{open} packets got no reply").into());
            }
            for number in ready {
                let Some(attempt) = attempts[number].take() else { continue };
                attempt.conclude()?;
                let now = Instant::now();
                outcome.record(attempt.began, now, 1)?;
                drop(attempt);
                if now < end {
                    attempts[number] = Some(self.begin(number)?);
                } else {
                    open -= 1;
                }
            }
        }
        outcome.ended();
        Ok(())
    }

    fn begin(&self, number: usize) -> Result<Attempt, Failure> {
        let began = Instant::now();
        let mut stream = TcpStream::connect(self.address)?;
        set_socket_linger(&stream, Some(Duration::ZERO))?;
        stream.write_all(&self.packet)?;
        self.poller.add(&stream, number)?;
        Ok(Attempt { stream, began })
    }
}

impl Attempt {
    /// Reads the reply.
    fn conclude(&self) -> Result<(), Failure> {
        let mut reply = [0xFF];
        match (&self.stream).read(&mut reply) {
            Ok(1) if reply[0] == DONE => Ok(()),
            Ok(1) => Err(format!("the reply is {:02x}", reply[0]).into()),
            Ok(_) => Err("the server closed a connection without a reply".into()),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                Err("the server does not answer".into())
            }
            Err(error) => Err(error.into()),
        }
    }
}
