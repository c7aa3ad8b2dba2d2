//! TLS over a TCP connection with deadlines.

use std::io::{ErrorKind, Write};
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
    of_process: u32,
}

impl TlsStream {
    /// Performs the handshake, before the deadline.
    pub(super) fn agree(
        stream: TcpByteStream,
        tls: &ClientTls,
        deadline: Instant,
    ) -> Result<TlsStream, StreamError> {
        let channel = tls.channel().map_err(|error| StreamError::Tls((&error).into()))?;
        let (plain, out) = (Vec::new(), Vec::new());
        let of_process = std::process::id();
        let mut secure =
            TlsStream { stream, channel, plain, out, heard: false, broken: None, of_process };
        secure.send(&[], deadline).and_then(|()| secure.shake_hands(deadline)).map_err(ended)?;
        Ok(secure)
    }

    fn shake_hands(&mut self, deadline: Instant) -> Result<(), StreamError> {
        while self.channel.is_handshaking() {
            self.take(deadline)?;
            self.intact()?;
        }
        Ok(())
    }

    fn intact(&self) -> Result<(), StreamError> {
        self.broken.clone().map_or(Ok(()), |failure| Err(StreamError::Tls(failure)))
    }

    /// Reads what is available, without waiting. Returns `true` if the connection has ended.
    fn look(&mut self) -> bool {
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
    fn take(&mut self, deadline: Instant) -> Result<(), StreamError> {
        let mut chunk = [0; CHUNK_BYTES];
        let len = self.stream.receive(&mut chunk, deadline)?;
        self.feed(&chunk[..len]);
        // The channel's answer is sent even if the deadline only ended a slice of the wait.
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

    fn flush(&mut self, deadline: Instant) -> Result<(), StreamError> {
        if self.out.is_empty() {
            return Ok(());
        }
        let sent = self.stream.send(&self.out, deadline);
        self.out.clear();
        sent
    }

    /// Interprets the end of the connection: a peer may refuse a certificate without an alert.
    fn closed_before_reply(&self, error: StreamError) -> StreamError {
        match error {
            StreamError::Io(error)
                if !self.heard
                    && matches!(
                        error.kind(),
                        ErrorKind::ConnectionReset | ErrorKind::BrokenPipe
                    ) =>
            {
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
        StreamError::Io(error)
            if matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::BrokenPipe) =>
        {
            StreamError::Tls(TlsFailure::ClosedDuringHandshake)
        }
        other => other,
    }
}

impl ByteStream for TlsStream {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
        while self.plain.is_empty() {
            self.intact()?;
            if self.channel.has_ended() {
                return Err(StreamError::Ended);
            }
            self.take(deadline).map_err(|error| self.closed_before_reply(error))?;
        }
        let len = self.plain.len().min(buffer.len());
        buffer[..len].copy_from_slice(&self.plain[..len]);
        self.plain.drain(..len);
        Ok(len)
    }

    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
        if self.plain.is_empty() && self.look() && self.plain.is_empty() {
            return Err(StreamError::Ended);
        }
        let len = self.plain.len().min(buffer.len());
        buffer[..len].copy_from_slice(&self.plain[..len]);
        self.plain.drain(..len);
        Ok((len > 0).then_some(len))
    }

    fn send(&mut self, bytes: &[u8], deadline: Instant) -> Result<(), StreamError> {
        self.channel.send(bytes, &mut self.out);
        self.flush(deadline).map_err(|error| {
            // A peer that has closed the connection may have sent an alert.
            self.look();
            self.broken.clone().map_or(self.closed_before_reply(error), StreamError::Tls)
        })
    }

    fn has_ended(&mut self) -> bool {
        let ended = self.look();
        ended || self.broken.is_some() || self.channel.has_ended()
    }

    fn is_quiet(&self) -> bool {
        self.plain.is_empty() && self.stream.is_quiet()
    }
}

impl Drop for TlsStream {
    fn drop(&mut self) {
        // In a forked child, nothing is said to the peer: the connection is that of the parent.
        if self.of_process != std::process::id() {
            return;
        }
        self.channel.end(&mut self.out);
        let _ = self.stream.at_once(|mut socket| socket.write(&self.out));
    }
}
