//! TLS over a TCP connection with deadlines.

use std::io::{ErrorKind, Write};
use std::net::IpAddr;
use std::time::Instant;

use super::byte_stream::{ByteStream, StreamError, TcpByteStream};
use super::interrupt::SIGNAL_CHECK_INTERVAL;
use crate::tls::client::ClientTls;
use crate::tls::{Channel, TlsFailure};

/// Bytes per read of a socket.
const CHUNK_BYTES: usize = 4096;

/// The most reads of one check for available bytes.
const MAX_READS_PER_CHECK: usize = 4;

pub(super) struct TlsStream {
    stream: TcpByteStream,
    channel: Channel,
    /// Received data that the caller has not read yet.
    plain: Vec<u8>,
    /// Bytes to send.
    out: Vec<u8>,
    /// Whether data has been received after the handshake.
    heard: bool,
    /// The error after which nothing more can be received.
    broken: Option<TlsFailure>,
    /// The process that opened the connection: a forked child must not use it.
    owner_pid: u32,
}

impl TlsStream {
    /// Performs the handshake, before the deadline.
    pub(super) fn connect(
        stream: TcpByteStream,
        tls: &ClientTls,
        deadline: Instant,
    ) -> Result<TlsStream, StreamError> {
        let channel = tls.channel().map_err(|error| StreamError::Tls((&error).into()))?;
        let (plain, out) = (Vec::new(), Vec::new());
        let owner_pid = std::process::id();
        let mut secure =
            TlsStream { stream, channel, plain, out, heard: false, broken: None, owner_pid };
        secure
            .send(&[], deadline)
            .and_then(|()| secure.finish_handshake(deadline))
            .map_err(ended)?;
        Ok(secure)
    }

    fn finish_handshake(&mut self, deadline: Instant) -> Result<(), StreamError> {
        while self.channel.is_handshaking() {
            self.read_some(deadline)?;
            self.check_broken()?;
        }
        Ok(())
    }

    fn check_broken(&self) -> Result<(), StreamError> {
        self.broken.clone().map_or(Ok(()), |failure| Err(StreamError::Tls(failure)))
    }

    /// Reads what is available, without waiting. Returns `true` if the connection has ended.
    fn read_available(&mut self) -> bool {
        let mut chunk = [0; CHUNK_BYTES];
        for _ in 0..MAX_READS_PER_CHECK {
            match self.stream.receive_now(&mut chunk) {
                Ok(None) => return false,
                Ok(Some(len)) => self.feed(&chunk[..len]),
                Err(_) => return true,
            }
        }
        false
    }

    /// Reads what arrives before the deadline.
    fn read_some(&mut self, deadline: Instant) -> Result<(), StreamError> {
        let mut chunk = [0; CHUNK_BYTES];
        let len = self.stream.receive(&mut chunk, deadline)?;
        self.feed(&chunk[..len]);
        // Callers wait in slices, so the deadline may be past: sending still gets one slice.
        // A TLS failure takes precedence over a failure to send its alert.
        self.flush(deadline.max(Instant::now() + SIGNAL_CHECK_INTERVAL))
            .or_else(|error| if self.broken.is_some() { Ok(()) } else { Err(error) })
    }

    fn feed(&mut self, bytes: &[u8]) {
        if let Err(error) = self.channel.receive(bytes, &mut self.plain, &mut self.out) {
            self.broken = Some((&error).into());
        }
        self.heard |= !self.plain.is_empty();
    }

    /// Moves received data into `buffer`. Returns how many bytes.
    fn copy_plain(&mut self, buffer: &mut [u8]) -> usize {
        let len = self.plain.len().min(buffer.len());
        buffer[..len].copy_from_slice(&self.plain[..len]);
        self.plain.drain(..len);
        len
    }

    fn flush(&mut self, deadline: Instant) -> Result<(), StreamError> {
        if self.out.is_empty() {
            return Ok(());
        }
        let sent = self.stream.send(&self.out, deadline);
        self.out.clear();
        sent
    }

    /// Interprets a reset before any data: in TLS 1.3, the peer checks our certificate after our
    /// handshake, and may close without an alert.
    fn closed_before_reply(&self, error: StreamError) -> StreamError {
        match error {
            StreamError::Io(error) if !self.heard && is_reset(&error) => {
                StreamError::Tls(TlsFailure::ClosedBeforeReply)
            }
            other => other,
        }
    }
}

/// Interprets a connection that ends during the handshake.
fn ended(error: StreamError) -> StreamError {
    match error {
        StreamError::Ended => StreamError::Tls(TlsFailure::ClosedDuringHandshake),
        StreamError::Io(error) if is_reset(&error) => {
            StreamError::Tls(TlsFailure::ClosedDuringHandshake)
        }
        other => other,
    }
}

fn is_reset(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::BrokenPipe)
}

impl ByteStream for TlsStream {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
        while self.plain.is_empty() {
            self.check_broken()?;
            if self.channel.has_ended() {
                return Err(StreamError::Ended);
            }
            self.read_some(deadline).map_err(|error| self.closed_before_reply(error))?;
        }
        Ok(self.copy_plain(buffer))
    }

    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
        if self.plain.is_empty() && self.read_available() && self.plain.is_empty() {
            return Err(StreamError::Ended);
        }
        let len = self.copy_plain(buffer);
        Ok((len > 0).then_some(len))
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> Result<(), StreamError> {
        self.channel.send(bytes, &mut self.out);
        self.flush(deadline).map_err(|error| {
            // A peer that has closed the connection may have sent an alert.
            self.read_available();
            self.broken.clone().map_or(self.closed_before_reply(error), StreamError::Tls)
        })
    }

    fn has_ended(&mut self) -> bool {
        let ended = self.read_available();
        ended || self.broken.is_some() || self.channel.has_ended()
    }

    fn peer(&self) -> Option<IpAddr> {
        self.stream.peer()
    }

    fn is_quiet(&self) -> bool {
        self.plain.is_empty() && self.stream.is_quiet()
    }
}

impl Drop for TlsStream {
    fn drop(&mut self) {
        // In a forked child, nothing is said to the peer: the connection is that of the parent.
        if self.owner_pid != std::process::id() {
            return;
        }
        self.channel.end(&mut self.out);
        let _ = self.stream.at_once(|mut socket| socket.write(&self.out));
    }
}
