//! The client side of one connection, without I/O: requests in, bytes out; bytes in, results out.
//!
//! The owner of the socket, blocking or not, drives a [`Connection`]. The driver passes it
//! requests, received bytes and the time, sends the bytes of [`Connection::outgoing`], and calls
//! [`Connection::advance`] at [`Connection::deadline`]. Each call passes its results to a closure,
//! as [`Done`] values. The same state machine serves every [`Transport`].
//!
//! The rules of a connection:
//!
//! * A reply counts only when transaction id (where there is one), unit id, function and length are
//!   those of the request. On a stream, anything else ends the connection: the two sides no longer
//!   mean the same thing.
//! * A request that timed out is given up. Its late reply is dropped and counted; if that repeats, the next
//!   requests to this unit have more time. Where no transaction id
//!   tells it apart, a stream ends, and nothing is sent whose reply could be taken for it until it has
//!   come or late replies are known to have ended. The next connection gets this as [`Past`].
//! * Transaction ids go on from one connection to the next, and none is used again while a reply to it may
//!   come. The 4096 requests that were given up last are remembered: a late reply to an earlier one ends the
//!   connection.
//! * A reply that is read long after its timeout is late too, however early it came ([`MAX_READ_DELAY`]): the
//!   process may have been stopped.
//! * What no request asked for is counted apart from late replies ([`Strays`]). Datagrams that match no
//!   request are dropped, because their sender may be forged; a flood of them ends the connection.
//! * A connection ends when a reply broke off, and after [`MAX_CONSECUTIVE_TIMEOUTS`] without a byte:
//!   the other side may have gone without a word.
//! * Only reads are ever sent twice: as datagrams, when the device closed a connection instead of
//!   answering on it again, and as often as its [`Tolerance`] says.
//!
//! An ended connection cannot be used again: the driver creates a new one.

mod attempts;
mod connection;
mod consecutive_timeouts;
mod echo;
mod flights;
mod late_replies_without_ids;
mod mbap_datagrams;
mod mbap_stream;
mod raised_timeouts;
mod rtu_and_ascii;
mod tolerance;

pub use attempts::{Attempt, BUSY_PAUSE};
pub use connection::{Connection, Past};
pub use consecutive_timeouts::MAX_CONSECUTIVE_TIMEOUTS;
pub use echo::Echo;
pub use flights::{Done, Strays, Ticket};
pub use late_replies_without_ids::{GUARD, MAX_LATENESS};
pub use mbap_datagrams::{MAX_STRAY_DATAGRAMS, UDP_ATTEMPTS};
pub use rtu_and_ascii::TURNAROUND;
pub use tolerance::{AcceptUnit, Tolerance};

use core::time::Duration;

use thiserror::Error;

use crate::frame::FrameError;
use crate::pdu::ResponseError;

/// The clock of the driver: the time since any fixed moment. It never runs backwards.
pub type Time = Duration;

/// How long after its timeout a reply may be read that came in time: the driver may have had no processor. One
/// that is read later is a late reply, because its values are old.
pub const MAX_READ_DELAY: Duration = Duration::from_secs(1);

/// The transport of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum Transport {
    /// MBAP frames in a stream: TCP, with TLS or without.
    Tcp,
    /// One MBAP frame per datagram. One request at a time.
    Udp,
    /// RTU frames in a stream. One request at a time.
    RtuOverTcp,
    /// RTU frames in datagrams. One request at a time; none is sent again by itself.
    RtuOverUdp,
    /// ASCII frames in a stream. One request at a time.
    AsciiOverTcp,
    /// RTU frames on a serial line. One request at a time.
    SerialRtu {
        /// What separates two frames.
        silence: Duration,
    },
    /// ASCII frames on a serial line. One request at a time.
    SerialAscii {
        /// What separates two frames.
        silence: Duration,
    },
}

/// Why a request failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Failure {
    /// The device answered with an exception, with this code.
    #[error("exception {0:#04x}")]
    Exception(u8),
    /// No reply arrived within the timeout.
    #[error("no reply in time")]
    Timeout,
    /// Only the start of a reply arrived within the timeout.
    #[error("no complete reply in time")]
    Incomplete,
    /// The request was not sent: within the timeout, the line was not silent.
    #[error("the line was not silent")]
    NoSilence,
    /// The reply cannot belong to the request.
    #[error("invalid response: {0}")]
    Invalid(InvalidResponse),
    /// The connection ended before the reply.
    #[error("connection lost: {0}")]
    Closed(Closed),
}

/// Why received bytes are invalid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum InvalidResponse {
    /// A header with a protocol id other than 0.
    #[error("protocol id {0}, expected 0")]
    ProtocolId(u16),
    /// A header with an invalid length.
    #[error("length {0} in the header, expected 2 to 254")]
    Length(u16),
    /// A transaction id that no request in flight has.
    #[error("transaction id {0} matches no request")]
    TransactionId(u16),
    /// A reply from another unit.
    #[error("reply from unit {found} to a request to unit {expected}")]
    UnitId {
        /// The unit that was asked.
        expected: u8,
        /// The unit that replied.
        found: u8,
    },
    /// A PDU that is not a response to the request.
    #[error("{0}")]
    Pdu(ResponseError),
    /// A damaged frame.
    #[error("{0}")]
    Frame(FrameError),
    /// A datagram that is not exactly one frame.
    #[error("the datagram is not one frame")]
    Datagram,
    /// More bytes than a reply can have.
    #[error("more bytes than a reply can have")]
    TooLong,
    /// Bytes without a request.
    #[error("bytes without a request")]
    Unrequested,
    /// A reply that came sooner than the line can carry it, and no other.
    #[error("the reply came sooner than the baud of the line allows")]
    TooFast,
    /// Many more bytes without a request than a faulty device sends.
    #[error("a flood of bytes without a request")]
    Flood,
}

impl InvalidResponse {
    /// The reason as a word for programs.
    pub const fn reason(self) -> &'static str {
        match self {
            InvalidResponse::ProtocolId(_) => "protocol_id",
            InvalidResponse::Length(_) => "length",
            InvalidResponse::TransactionId(_) => "transaction_id",
            InvalidResponse::UnitId { .. } => "unit_id",
            InvalidResponse::Pdu(error) => match error {
                ResponseError::Function { .. } => "function",
                ResponseError::Echo => "echo",
                _ => "length",
            },
            InvalidResponse::Frame(FrameError::CheckSum) => "checksum",
            InvalidResponse::Frame(_) => "frame",
            InvalidResponse::Datagram => "datagram",
            InvalidResponse::TooLong => "too_long",
            InvalidResponse::Unrequested => "unrequested",
            InvalidResponse::TooFast => "too_fast",
            InvalidResponse::Flood => "flood",
        }
    }
}

/// Why a connection has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Closed {
    /// The driver reports that the peer closed the connection, or that I/O failed.
    #[error("closed by the peer")]
    ByPeer,
    /// The driver closed the connection.
    #[error("closed by this side")]
    BySelf,
    /// The received bytes are invalid.
    #[error("invalid response: {0}")]
    Invalid(InvalidResponse),
    /// Several requests timed out, and no byte was received meanwhile.
    #[error("no byte received during {MAX_CONSECUTIVE_TIMEOUTS} timeouts")]
    Silent,
    /// A request timed out in the middle of its reply.
    #[error("a reply was cut off")]
    BrokenOff,
    /// A request timed out, and its late reply could be taken for the next one.
    #[error("a request timed out, and its reply may still arrive")]
    TimedOut,
}

impl Closed {
    /// The failure of a request in flight when the connection ends.
    pub const fn failure(self) -> Failure {
        match self {
            Closed::Invalid(invalid) => Failure::Invalid(invalid),
            other => Failure::Closed(other),
        }
    }
}
