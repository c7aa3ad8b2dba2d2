//! Clients: requests out, responses in, over every transport.
//!
//! * [`session`] matches replies to requests by transaction id. It does no I/O: whoever has a socket
//!   drives it, blocking or not.
//! * [`exchange`] is one request and its reply on transports that carry one at a time, by blocking
//!   calls with a deadline: RTU, ASCII, UDP, and TCP for callers that wait anyway.

mod byte_stream;
mod exchange;
pub mod session;
mod tls_stream;
mod turns;

pub use exchange::{BlockingClient, Endpoint};
pub use session::{Broken, Session};

use std::io;

use holdfast_protocol::pdu::{ExceptionCode, ResponseError};
use thiserror::Error;

/// Why a call has no result.
#[derive(Debug, Error)]
pub enum ClientError {
    /// The device answered with an exception; the code as it came.
    #[error("exception {0:#04x}")]
    Exception(u8),
    /// There was no valid reply within the deadline.
    #[error("no reply within {0} s")]
    Timeout(f64),
    /// The connection could not be made.
    #[error("can't connect to {to}: {error}")]
    Connect { to: String, error: io::Error },
    /// The connection ended before the reply.
    #[error("connection lost: {0}")]
    Lost(String),
    /// What came can't be the reply.
    #[error("invalid response: {0}")]
    Invalid(String),
}

impl From<ResponseError> for ClientError {
    fn from(error: ResponseError) -> ClientError {
        match error {
            ResponseError::Exception(code) => ClientError::Exception(code.code()),
            ResponseError::UnknownException(code) => ClientError::Exception(code),
            other => ClientError::Invalid(other.to_string()),
        }
    }
}

/// The standard's name of an exception code.
pub fn exception_name(code: u8) -> Option<&'static str> {
    ExceptionCode::from_code(code).map(ExceptionCode::name)
}
