//! TLS between a socket and a protocol, as Modbus/TCP Security requires.
//!
//! A [`Channel`] does no I/O: the owner of the socket passes it received bytes, and sends the bytes
//! that it returns.

mod certificate;
pub mod client;
mod client_verifier;
mod failure;
mod file_warnings;
mod files;
mod handshake_notes;
mod hello;
mod own_certificate;
mod p521;
mod provider;
mod revocation;
mod rsa_pss;
pub mod server;
mod server_files;
mod sessions;
mod supported_keys;
#[cfg(test)]
pub(crate) mod test_party;
mod trust;

use std::io::{Read, Write};

use rustls::{Connection, Error};

pub use failure::TlsFailure;
pub use files::FileError;

/// Bytes of plain text per read.
const CHUNK_BYTES: usize = 4096;

/// The TLS state of one connection.
pub struct Channel(Connection);

impl Channel {
    fn new(connection: impl Into<Connection>) -> Channel {
        let mut connection = connection.into();
        connection.set_buffer_limit(None);
        Channel(connection)
    }

    /// Processes received bytes, which may end anywhere. Appends the plain text to `plain`, and
    /// bytes to send, alerts included, to `out`.
    ///
    /// # Errors
    /// TLS failed: send `out`, then close the connection.
    pub fn receive(
        &mut self,
        mut bytes: &[u8],
        plain: &mut Vec<u8>,
        out: &mut Vec<u8>,
    ) -> Result<(), Error> {
        let mut done = Ok(());
        while done.is_ok() && !bytes.is_empty() {
            // `read_tls` reads nothing only while plain text waits. Here none ever waits.
            let Ok(1..) = self.0.read_tls(&mut bytes) else { break };
            done = self.0.process_new_packets().map(drop);
            self.take(plain);
        }
        self.flush(out);
        done
    }

    /// Encrypts `plain` and appends the records to `out`. During the handshake, plain text is
    /// queued until the end of the handshake.
    pub fn send(&mut self, plain: &[u8], out: &mut Vec<u8>) {
        // The writer has no limit, so it accepts everything.
        let _ = self.0.writer().write_all(plain);
        self.flush(out);
    }

    /// Appends the closing alert to `out`.
    pub fn end(&mut self, out: &mut Vec<u8>) {
        self.0.send_close_notify();
        self.flush(out);
    }

    pub fn is_handshaking(&self) -> bool {
        self.0.is_handshaking()
    }

    /// Whether the peer has announced the end.
    pub fn has_ended(&mut self) -> bool {
        // No plain text waits here, so a read of length 0 is the end.
        matches!(self.0.reader().read(&mut [0]), Ok(0))
    }

    fn take(&mut self, plain: &mut Vec<u8>) {
        let mut chunk = [0; CHUNK_BYTES];
        while let Ok(len @ 1..) = self.0.reader().read(&mut chunk) {
            plain.extend_from_slice(&chunk[..len]);
        }
    }

    fn flush(&mut self, out: &mut Vec<u8>) {
        while self.0.wants_write() {
            // Writing to a vector cannot fail.
            let _ = self.0.write_tls(out);
        }
    }
}
