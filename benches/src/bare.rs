//! The limit: a server that answers the same bytes without looking at the request. It only counts
//! bytes, to know how many requests there were.
//!
//! A write may block: what a closed-loop load has in flight fits into the buffers of its sockets, so
//! it never does while the load reads.

use std::collections::HashMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};

use crate::poller::Poller;
use crate::{Failure, options, unhex};

const LISTENER: usize = usize::MAX;

/// Bytes taken from a socket at once, as the server that is compared takes them.
const INPUT: usize = 4096;

struct Peer {
    stream: TcpStream,
    /// Bytes of a request that is not whole yet.
    part: usize,
}

/// `--request-len N --reply HEX`: answers every N bytes with the reply, until it is killed.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let (mut request_len, mut reply) = (12, Vec::new());
    options(arguments, |name, value| {
        match name {
            "request-len" => request_len = value.parse()?,
            "reply" => reply = unhex(&value)?,
            _ => return Ok(false),
        }
        Ok(true)
    })?;
    let replies = reply.repeat(INPUT / request_len + 1);
    let listener = TcpListener::bind("127.0.0.1:0")?;
    println!("listening {}", listener.local_addr()?);
    serve(&listener, request_len, reply.len(), &replies)
}

fn serve(
    listener: &TcpListener,
    request_len: usize,
    reply_len: usize,
    replies: &[u8],
) -> Result<(), Failure> {
    let mut poller = Poller::new()?;
    poller.add(listener, LISTENER)?;
    let mut peers: HashMap<usize, Peer> = HashMap::new();
    let mut next = 0;
    let mut input = [0; INPUT];
    let mut gone = Vec::new();
    loop {
        let mut accepting = false;
        for number in poller.wait(None)? {
            let Some(peer) = peers.get_mut(&number) else {
                accepting = true;
                continue;
            };
            match peer.stream.read(&mut input) {
                Ok(0) => gone.push(number),
                Ok(len) => {
                    let bytes = peer.part + len;
                    peer.part = bytes % request_len;
                    let replies = &replies[..bytes / request_len * reply_len];
                    if peer.stream.write_all(replies).is_err() {
                        gone.push(number);
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(_) => gone.push(number),
            }
        }
        for number in gone.drain(..) {
            peers.remove(&number);
        }
        if accepting {
            let (stream, _) = listener.accept()?;
            stream.set_nodelay(true)?;
            poller.add(&stream, next)?;
            peers.insert(next, Peer { stream, part: 0 });
            next += 1;
        }
    }
}
