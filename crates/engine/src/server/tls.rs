//! TLS between a connection and its socket: records in, plain text out, and back.
//!
//! What a peer can make this hold is bounded: one record that is not complete, the plain text of one
//! that is (16 KB), and what answers them. Handshake messages are at most 64 KB long. Renegotiation
//! is refused, and a flood of alerts or new keys ends the connection.

use std::cell::RefCell;
use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, ReadBuf};
use tokio::net::TcpStream;

use super::event::Kind;
use super::stream::{self, Stream};
use crate::tls::server::{self, ServerTls};
use crate::tls::{Channel, TlsFailure};

/// Bytes taken from a socket at once.
const INPUT: usize = 4096;

/// Bytes before each record.
const HEADER_LEN: usize = 5;

/// Buffers of a worker thread, for all of its connections.
struct Scratch {
    input: Box<[u8]>,
    plain: Vec<u8>,
    output: Vec<u8>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::new(Scratch {
        input: vec![0; INPUT].into_boxed_slice(),
        plain: Vec::new(),
        output: Vec::new(),
    });
}

pub(crate) struct ServerTlsStream {
    socket: TcpStream,
    channel: Channel,
    records: Records,
    /// Plain text that had no room in the input of the connection, and how much of it was read.
    plain: Vec<u8>,
    taken: usize,
    /// Why nothing more is read.
    ended: Option<Kind>,
}

impl ServerTlsStream {
    pub(crate) fn new(socket: TcpStream, tls: &ServerTls) -> Result<ServerTlsStream, Kind> {
        let channel = tls.channel().map_err(|error| failed(&error))?;
        let records = Records::default();
        Ok(ServerTlsStream { socket, channel, records, plain: Vec::new(), taken: 0, ended: None })
    }

    /// Gets to know the peer.
    ///
    /// # Errors
    /// It is not trusted, or went away; it was told.
    pub(crate) async fn handshake(&mut self, patience: Duration) -> Result<(), Kind> {
        let mut unsent = Vec::new();
        while self.channel.is_handshaking() || !unsent.is_empty() {
            stream::send_all(&self.socket, &unsent, patience).await?;
            unsent.clear();
            if self.channel.is_handshaking() {
                poll_fn(|context| self.poll_read(context, &mut [], &mut unsent)).await?;
            }
        }
        Ok(())
    }

    /// The role that the peer's certificate names; empty for the null role.
    pub(crate) fn role(&self) -> Result<String, Kind> {
        server::role(&self.channel).map_err(|error| failed(&error))
    }

    /// Tells the peer of the end, without waiting.
    pub(crate) fn say_end(&mut self) {
        let mut unsent = Vec::new();
        self.end(&mut unsent);
        let _ = stream::write(&self.socket, &mut unsent);
    }

    pub(crate) fn into_socket(self) -> TcpStream {
        self.socket
    }

    /// Takes what came from the peer; the length of the plain text that it made.
    fn receive(
        &mut self,
        bytes: &[u8],
        (plain, output): (&mut Vec<u8>, &mut Vec<u8>),
        input: &mut [u8],
        unsent: &mut Vec<u8>,
    ) -> Result<usize, Kind> {
        plain.clear();
        output.clear();
        self.records.pass(bytes);
        if let Err(error) = self.channel.receive(bytes, plain, output) {
            self.ended = Some(failed(&error));
        } else if self.channel.has_ended() {
            self.ended = Some(Kind::Closed);
        }
        if !output.is_empty() {
            stream::send(&self.socket, output, unsent)?;
        }
        let len = plain.len().min(input.len());
        input[..len].copy_from_slice(&plain[..len]);
        self.plain.extend_from_slice(&plain[len..]);
        Ok(len)
    }

    /// Takes plain text that waits, or says that there will be none.
    fn take(&mut self, input: &mut [u8]) -> Option<Result<usize, Kind>> {
        let waiting = &self.plain[self.taken..];
        if waiting.is_empty() {
            return self.ended.map(Err);
        }
        let len = waiting.len().min(input.len());
        input[..len].copy_from_slice(&waiting[..len]);
        self.taken += len;
        if self.taken == self.plain.len() {
            (self.plain, self.taken) = (Vec::new(), 0);
        }
        Some(Ok(len))
    }
}

impl Stream for ServerTlsStream {
    fn poll_read(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
        unsent: &mut Vec<u8>,
    ) -> Poll<Result<usize, Kind>> {
        if let Some(taken) = self.take(input) {
            return Poll::Ready(taken);
        }
        SCRATCH.with_borrow_mut(|scratch| {
            let mut buffer = ReadBuf::new(&mut scratch.input);
            let socket = Pin::new(&mut self.socket);
            let Poll::Ready(read) = socket.poll_read(context, &mut buffer) else {
                return Poll::Pending;
            };
            let len = buffer.filled().len();
            if read.is_err() || len == 0 {
                return Poll::Ready(Err(Kind::Closed));
            }
            let buffers = (&mut scratch.plain, &mut scratch.output);
            Poll::Ready(self.receive(&scratch.input[..len], buffers, input, unsent))
        })
    }

    fn read_now(&mut self, input: &mut [u8], unsent: &mut Vec<u8>) -> Option<usize> {
        if let Some(taken) = self.take(input) {
            return taken.ok();
        }
        SCRATCH.with_borrow_mut(|scratch| {
            let len = stream::read(&self.socket, &mut scratch.input)?;
            let buffers = (&mut scratch.plain, &mut scratch.output);
            self.receive(&scratch.input[..len], buffers, input, unsent).ok()
        })
    }

    fn send(&mut self, output: &[u8], unsent: &mut Vec<u8>) -> Result<(), Kind> {
        SCRATCH.with_borrow_mut(|Scratch { output: records, .. }| {
            records.clear();
            self.channel.send(output, records);
            stream::send(&self.socket, records, unsent)
        })
    }

    fn is_amid_record(&self) -> bool {
        self.records.is_amid()
    }

    fn end(&mut self, unsent: &mut Vec<u8>) {
        self.channel.end(unsent);
    }

    fn socket(&self) -> &TcpStream {
        &self.socket
    }
}

fn failed(error: &rustls::Error) -> Kind {
    Kind::TlsFailed(TlsFailure::from(error).event_reason())
}

/// Where records begin and end.
#[derive(Debug, Default)]
struct Records {
    header: [u8; HEADER_LEN],
    header_len: usize,
    /// Bytes of the record that are to come.
    missing: usize,
}

impl Records {
    fn pass(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let passed = if self.missing > 0 {
                let passed = self.missing.min(bytes.len());
                self.missing -= passed;
                passed
            } else {
                let passed = (HEADER_LEN - self.header_len).min(bytes.len());
                let end = self.header_len + passed;
                self.header[self.header_len..end].copy_from_slice(&bytes[..passed]);
                self.header_len = end;
                if end == HEADER_LEN {
                    let [.., high, low] = self.header;
                    self.missing = usize::from(u16::from_be_bytes([high, low]));
                    self.header_len = 0;
                }
                passed
            };
            bytes = &bytes[passed..];
        }
    }

    fn is_amid(&self) -> bool {
        self.header_len > 0 || self.missing > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_told_apart_however_they_are_cut() {
        let stream = [&[23, 3, 3, 0, 2, 8, 9][..], &[21, 3, 3, 0, 0], &[23, 3, 3, 1, 4]].concat();
        let stream = [&stream[..], &[0; 260]].concat();
        let ends = [0, 7, 12, stream.len()];
        for cut in 1..=stream.len() {
            let mut records = Records::default();
            records.pass(&stream[..cut]);
            assert_eq!(records.is_amid(), !ends.contains(&cut), "cut at {cut}");
            records.pass(&stream[cut..]);
            assert!(!records.is_amid(), "cut at {cut}");
        }
    }
}
