//! One client with one request in flight: at a fixed rate, or the next request as soon as the reply
//! arrives. Every reply must equal the first.
//!
//! The latency is the time from sending to the reply. A request that is due while another is in
//! flight is skipped.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::load::{first_reply, request};
use crate::outcome::{Outcome, Period};
use crate::{Failure, TIMEOUT, options};

/// `--address A --quantity Q --rate R --warmup S --seconds S`: without a rate, or with 0, it never
/// pauses.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let mut address = SocketAddr::from(([127, 0, 0, 1], 502));
    let (mut quantity, mut rate, mut period) = (10, 0.0, Period::DEFAULT);
    options(arguments, |name, value| {
        match name {
            "address" => address = value.parse()?,
            "quantity" => quantity = value.parse()?,
            "rate" => rate = value.parse()?,
            _ => return period.set(name, &value),
        }
        Ok(true)
    })?;
    let request = request("read-registers", quantity)?;
    let expected = first_reply(address, &request)?;
    let stream = TcpStream::connect(address)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    let pause = if rate > 0.0 { Duration::try_from_secs_f64(1.0 / rate)? } else { Duration::ZERO };
    let mut outcome = Outcome::new(period)?;
    run(stream, &request, &expected, pause, &mut outcome)?;
    outcome.ended();
    outcome.report();
    Ok(())
}

fn run(
    mut stream: TcpStream,
    request: &[u8],
    expected: &[u8],
    pause: Duration,
    outcome: &mut Outcome,
) -> Result<(), Failure> {
    let mut reply = vec![0; expected.len()];
    let (mut now, end) = (Instant::now(), outcome.end());
    let mut due = now;
    while now < end {
        sleep(due.saturating_duration_since(now));
        let sent = Instant::now();
        stream.write_all(request)?;
        stream.read_exact(&mut reply)?;
        now = Instant::now();
        if reply != expected {
            return Err("a reply differs from the first one".into());
        }
        outcome.record(sent, now, 1)?;
        while !pause.is_zero() && due <= now {
            due += pause;
        }
    }
    Ok(())
}
