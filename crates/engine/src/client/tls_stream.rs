//! TLS over a TCP connection with deadlines.

use std::io::{self, ErrorKind, Read, Write};
use std::time::Instant;

use super::byte_stream::{ByteStream, TcpByteStream};
use crate::tls::client::ClientTls;
use crate::tls::{Channel, words};

/// Bytes taken from a socket at once.
const CHUNK: usize = 4096;

/// How often a socket is read in one look.
const READS: usize = 4;

pub(super) struct TlsStream {
    stream: TcpByteStream,
    channel: Channel,
    /// What came and nobody has taken yet.
    plain: Vec<u8>,
    /// What is to be sent.
    out: Vec<u8>,
    /// Why nothing more can come.
    broken: Option<String>,
}

impl TlsStream {
    /// Agrees with the peer on TLS before the deadline.
    ///
    /// # Errors
    /// `TimedOut`, or what went wrong, in words.
    pub(super) fn agree(
        stream: TcpByteStream,
        tls: &ClientTls,
        deadline: Instant,
    ) -> io::Result<TlsStream> {
        let channel = tls.channel().map_err(|error| io::Error::other(words(&error)))?;
        let (plain, out) = (Vec::new(), Vec::new());
        let mut secure = TlsStream { stream, channel, plain, out, broken: None };
        secure.send(&[], deadline).and_then(|()| secure.shake_hands(deadline)).map_err(
            |error| match error.kind() {
                ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset | ErrorKind::BrokenPipe => {
                    io::Error::other("the peer ended the connection instead of agreeing on TLS")
                }
                _ => error,
            },
        )?;
        Ok(secure)
    }

    fn shake_hands(&mut self, deadline: Instant) -> io::Result<()> {
        while self.channel.is_handshaking() {
            self.take(deadline)?;
            if let Some(why) = &self.broken {
                return Err(io::Error::other(why.clone()));
            }
        }
        Ok(())
    }

    /// Whether the peer has ended it; what else came is kept.
    pub(super) fn has_ended(&mut self) -> bool {
        let ended = self.look();
        ended || self.broken.is_some() || self.channel.has_ended()
    }

    /// Takes what is there without waiting for it; whether that was the end of the connection.
    fn look(&mut self) -> bool {
        let mut chunk = [0; CHUNK];
        for _ in 0..READS {
            match self.stream.at_once(|socket| socket.read(&mut chunk)) {
                Ok(0) => return true,
                Ok(len) => self.feed(&chunk[..len]),
                Err(error) => return error.kind() != ErrorKind::WouldBlock,
            }
        }
        false
    }

    /// Takes what comes before the deadline.
    fn take(&mut self, deadline: Instant) -> io::Result<()> {
        let mut chunk = [0; CHUNK];
        let len = self.stream.receive(&mut chunk, deadline)?;
        self.feed(&chunk[..len]);
        // What breaks the connection is told whether the peer hears of it or not.
        self.flush(deadline)
            .or_else(|error| if self.broken.is_some() { Ok(()) } else { Err(error) })
    }

    fn feed(&mut self, bytes: &[u8]) {
        if let Err(error) = self.channel.receive(bytes, &mut self.plain, &mut self.out) {
            self.broken = Some(words(&error));
        }
    }

    fn flush(&mut self, deadline: Instant) -> io::Result<()> {
        if self.out.is_empty() {
            return Ok(());
        }
        let sent = self.stream.send(&self.out, deadline);
        self.out.clear();
        sent
    }
}

impl ByteStream for TlsStream {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        while self.plain.is_empty() {
            if let Some(why) = &self.broken {
                return Err(io::Error::other(why.clone()));
            }
            if self.channel.has_ended() {
                return Err(ErrorKind::UnexpectedEof.into());
            }
            self.take(deadline)?;
        }
        let len = self.plain.len().min(buffer.len());
        buffer[..len].copy_from_slice(&self.plain[..len]);
        self.plain.drain(..len);
        Ok(len)
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()> {
        self.channel.send(bytes, &mut self.out);
        self.flush(deadline).map_err(|error| {
            // A peer that has ended the connection may have said why.
            self.look();
            self.broken.clone().map_or(error, io::Error::other)
        })
    }

    fn discard(&mut self) -> io::Result<bool> {
        Ok(false)
    }

    fn is_quiet(&self) -> bool {
        self.plain.is_empty() && self.stream.is_quiet()
    }
}

impl Drop for TlsStream {
    fn drop(&mut self) {
        self.channel.end(&mut self.out);
        let _ = self.stream.at_once(|socket| socket.write(&self.out));
    }
}
