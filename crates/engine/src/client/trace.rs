//! Shows the bytes of a connection to whoever wants to see them.

use std::sync::Arc;
use std::time::Instant;

use super::byte_stream::{ByteStream, StreamError};

/// Where bytes went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// To the device.
    Sent,
    /// From the device.
    Received,
}

/// Gets the bytes that were sent and received, in order, as they came: a frame may come in several
/// parts. Over TLS, what is inside of it.
pub type Trace = Arc<dyn Fn(Direction, &[u8]) + Send + Sync>;

/// A stream whose bytes are shown.
pub(super) struct Traced {
    pub(super) stream: Box<dyn ByteStream>,
    pub(super) trace: Trace,
}

impl ByteStream for Traced {
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
        let len = self.stream.receive(buffer, deadline)?;
        (self.trace)(Direction::Received, &buffer[..len]);
        Ok(len)
    }

    fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
        let received = self.stream.receive_now(buffer)?;
        if let Some(len) = received {
            (self.trace)(Direction::Received, &buffer[..len]);
        }
        Ok(received)
    }

    /// Bytes that could not all be sent are shown too: the device may have got them.
    fn send(&mut self, bytes: &[u8], deadline: Instant) -> Result<(), StreamError> {
        (self.trace)(Direction::Sent, bytes);
        self.stream.send(bytes, deadline)
    }

    fn has_ended(&mut self) -> bool {
        self.stream.has_ended()
    }

    fn has_moved(&self) -> bool {
        self.stream.has_moved()
    }

    fn is_quiet(&self) -> bool {
        self.stream.is_quiet()
    }
}
