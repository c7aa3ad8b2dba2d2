//! The limit with one connection per packet: a server that accepts, reads a given number of bytes,
//! answers one byte without looking at them, and closes.

use std::collections::HashMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};

use rustix::io::Errno;
use rustix::net::{SocketFlags, accept_with};

use crate::poller::Poller;
use crate::{Failure, options};

const LISTENER: usize = usize::MAX;

/// Bytes per read of a socket.
const INPUT: usize = 16384;

const REPLY: [u8; 1] = [0];

/// `--packet-len N`: runs until it is killed.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let mut packet_len = 0;
    options(arguments, |name, value| {
        match name {
            "packet-len" => packet_len = value.parse()?,
            _ => return Ok(false),
        }
        Ok(true)
    })?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    listener.set_nonblocking(true)?;
    println!("listening {}", listener.local_addr()?);
    serve(&listener, packet_len)
}

struct Peer {
    stream: TcpStream,
    missing: usize,
}

impl Peer {
    /// Reads until no bytes are available. Returns whether the connection is done.
    fn receive(&mut self, input: &mut [u8]) -> bool {
        loop {
            match self.stream.read(input) {
                Ok(0) => return true,
                Ok(len) if len < self.missing => self.missing -= len,
                Ok(_) => {
                    let _ = self.stream.write(&REPLY);
                    return true;
                }
                Err(error) => return error.kind() != ErrorKind::WouldBlock,
            }
        }
    }
}

fn serve(listener: &TcpListener, packet_len: usize) -> Result<(), Failure> {
    let mut poller = Poller::new()?;
    poller.add(listener, LISTENER)?;
    let mut peers: HashMap<usize, Peer> = HashMap::new();
    let mut next = 0;
    let mut input = [0; INPUT];
    loop {
        let mut accepting = false;
        for number in poller.wait(None)? {
            match peers.get_mut(&number) {
                None => accepting = true,
                Some(peer) => {
                    if peer.receive(&mut input) {
                        peers.remove(&number);
                    }
                }
            }
        }
        while accepting {
            let stream = match accept_with(listener, SocketFlags::NONBLOCK | SocketFlags::CLOEXEC) {
                Ok(stream) => TcpStream::from(stream),
                Err(Errno::WOULDBLOCK) => {
                    accepting = false;
                    continue;
                }
                Err(Errno::CONNABORTED) => continue,
                Err(error) => return Err(error.into()),
            };
            // Most packets have already arrived.
            let mut peer = Peer { stream, missing: packet_len };
            if !peer.receive(&mut input) {
                poller.add(&peer.stream, next)?;
                peers.insert(next, peer);
                next += 1;
            }
        }
    }
}
