//! The limit: a server that sends the same reply without reading the request. It only counts bytes,
//! to count requests.
//!
//! Writes are blocking. They never block here: all replies in flight to a closed-loop load fit into
//! the buffers of its sockets.

use std::collections::HashMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};

use crate::poller::Poller;
use crate::{Failure, options, unhex};

const LISTENER: usize = usize::MAX;

/// Bytes per read of a socket, as in the server that it is compared with.
const INPUT: usize = 4096;

struct Peer {
    stream: TcpStream,
    /// Bytes of an incomplete request.
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
