//! TLS between a socket and a protocol, as Modbus/TCP Security has it.
//!
//! A [`Channel`] does no I/O: whoever has the socket gives it what came, and sends what it says.

mod certificate;
pub mod client;
mod failure;
mod files;
mod own;
mod p521;
mod provider;
mod rsa_pss;
pub mod server;
mod trust;

use std::io::{Read, Write};

use rustls::{Connection, Error};

pub use failure::TlsFailure;
pub use files::FileError;

/// Bytes of plain text taken out at once.
const CHUNK: usize = 4096;

/// One connection's TLS.
pub struct Channel(Connection);

impl Channel {
    fn new(connection: impl Into<Connection>) -> Channel {
        let mut connection = connection.into();
        connection.set_buffer_limit(None);
        Channel(connection)
    }

    /// Takes bytes that came from the peer, which may end anywhere. What they carry is appended to
    /// `plain`, and what the peer is to get because of them to `out`, an alert for a failure included.
    ///
    /// # Errors
    /// The connection is to be closed, when `out` was sent.
    pub fn receive(
        &mut self,
        mut bytes: &[u8],
        plain: &mut Vec<u8>,
        out: &mut Vec<u8>,
    ) -> Result<(), Error> {
        let mut done = Ok(());
        while done.is_ok() && !bytes.is_empty() {
            // It takes nothing only while plain text waits, which it never does here.
            let Ok(1..) = self.0.read_tls(&mut bytes) else { break };
            done = self.0.process_new_packets().map(drop);
            self.take(plain);
        }
        self.flush(out);
        done
    }

    /// Appends to `out` what the peer is to get for some plain text to arrive there. Before the
    /// handshake is over, the text waits for its end.
    pub fn send(&mut self, plain: &[u8], out: &mut Vec<u8>) {
        // It has no limit, so that it takes everything.
        let _ = self.0.writer().write_all(plain);
        self.flush(out);
    }

    /// Appends to `out` what tells the peer of the end.
    pub fn end(&mut self, out: &mut Vec<u8>) {
        self.0.send_close_notify();
        self.flush(out);
    }

    pub fn is_handshaking(&self) -> bool {
        self.0.is_handshaking()
    }

    /// Whether the peer has said that nothing more will come.
    pub fn has_ended(&mut self) -> bool {
        // No plain text waits here, so that only an end has a length.
        matches!(self.0.reader().read(&mut [0]), Ok(0))
    }

    fn take(&mut self, plain: &mut Vec<u8>) {
        let mut chunk = [0; CHUNK];
        while let Ok(len @ 1..) = self.0.reader().read(&mut chunk) {
            plain.extend_from_slice(&chunk[..len]);
        }
    }

    fn flush(&mut self, out: &mut Vec<u8>) {
        while self.0.wants_write() {
            // A vector takes everything.
            let _ = self.0.write_tls(out);
        }
    }
}
