//! Clients: requests out, responses in, over every transport.
//!
//! What happens on a connection is decided by [`holdfast_protocol::client::Connection`], which does no
//! I/O. [`blocking`] drives it in the calling thread; asyncio and the poller drive it too.

mod blocking;
mod byte_stream;
mod connect;
mod endpoint;
mod tls_stream;
mod turns;

pub use blocking::BlockingClient;
pub use endpoint::{Endpoint, Place};

use std::io;
use std::time::Duration;

use holdfast_protocol::client::{Closed, Failure, InvalidResponse};
use holdfast_protocol::pdu::ExceptionCode;
use thiserror::Error;

use crate::tls::TlsFailure;

/// Why a call has no result.
#[derive(Debug, Error)]
pub enum ClientError {
    /// The device answered with an exception; the code as it came.
    #[error("exception {0:#04x}")]
    Exception(u8),
    /// There was no valid reply in time.
    #[error("no reply within {} s", .0.as_secs_f64())]
    Timeout(Duration),
    /// There was no connection in time. Nothing was sent.
    #[error("no connection to {to} within {} s", .after.as_secs_f64())]
    ConnectTimeout { to: String, after: Duration },
    /// The connection could not be made. Nothing was sent.
    #[error("can't connect to {to}: {error}")]
    Connect { to: String, error: io::Error },
    /// TLS failed. `maybe_sent` says whether the request may have been carried out.
    #[error("{}{failure}", if *.maybe_sent { "connection lost: ".into() } else { format!("can't connect to {to}: ") })]
    Tls { to: String, failure: TlsFailure, maybe_sent: bool },
    /// The connection ended before the reply.
    #[error("connection lost: {0}")]
    Lost(Lost),
    /// What came can't be the reply.
    #[error("invalid response: {0}")]
    Invalid(InvalidResponse),
}

/// Why a connection was lost.
#[derive(Debug, Error)]
pub enum Lost {
    #[error("{0}")]
    Closed(Closed),
    #[error("{0}")]
    Io(io::Error),
}

impl ClientError {
    /// What a failure of the connection means to a caller that waited for `timeout`.
    pub fn new(failure: Failure, timeout: Duration) -> ClientError {
        match failure {
            Failure::Exception(code) => ClientError::Exception(code),
            Failure::Timeout => ClientError::Timeout(timeout),
            Failure::Invalid(invalid) => ClientError::Invalid(invalid),
            Failure::Closed(why) => ClientError::Lost(Lost::Closed(why)),
            _ => unreachable!("a failure that is not known here: {failure}"),
        }
    }
}

/// The standard's name of an exception code.
pub fn exception_name(code: u8) -> Option<&'static str> {
    ExceptionCode::from_code(code).map(ExceptionCode::name)
}
