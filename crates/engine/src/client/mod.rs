//! Clients: send requests and receive responses, over every transport.
//!
//! [`holdfast_protocol::client::Connection`] decides what happens on a connection, and does no I/O.
//! [`blocking`] drives it in the calling thread; asyncio and the poller drive it too.

mod blocking;
mod byte_stream;
mod connect;
mod endpoint;
mod fair_lock;
mod interrupt;
mod peers;
mod stray_counts;
mod tls_stream;
mod trace;

pub use blocking::{BlockingClient, Conditions, SendMoment};
pub use endpoint::{Endpoint, Place};
pub use peers::Peers;
pub use stray_counts::StrayCounters;
pub use trace::{Direction, Trace};

use std::hash::{BuildHasher, RandomState};
use std::io;
use std::time::Duration;

use holdfast_protocol::client::{
    Closed, Connection, Failure, InvalidResponse, Tolerance, Transport,
};
use thiserror::Error;

use crate::tls::TlsFailure;

/// A connection whose transaction ids begin with a random number.
pub fn connection(transport: Transport, tolerance: Tolerance, now: Duration) -> Connection {
    // The keys of a hasher are random.
    Connection::tolerant(transport, tolerance, now).unpredictable(RandomState::new().hash_one(0))
}

/// Why a call failed.
#[derive(Debug, Error)]
pub enum ClientError {
    /// The device answered with an exception. The code is not converted.
    #[error("exception {0:#04x}")]
    Exception(u8),
    /// No valid reply arrived within the timeout.
    #[error("no reply within {} s", .0.as_secs_f64())]
    Timeout(Duration),
    /// Only the start of a reply arrived within the timeout.
    #[error("no complete reply within {} s, only its start", .0.as_secs_f64())]
    Incomplete(Duration),
    /// The line was not silent within the timeout. Nothing was sent.
    #[error("nothing was sent within {} s: the line was not silent", .0.as_secs_f64())]
    NoSilence(Duration),
    /// The connection was not made within the timeout. Nothing was sent.
    #[error("no connection to {to} within {} s", .after.as_secs_f64())]
    ConnectTimeout { to: String, after: Duration },
    /// The name was not resolved within the timeout. Nothing was sent.
    #[error("no connection to {to} within {} s: its name was not resolved", .after.as_secs_f64())]
    LookupTimeout { to: String, after: Duration },
    /// The connection could not be made. Nothing was sent.
    #[error("can't connect to {to}: {error}")]
    Connect { to: String, error: io::Error },
    /// TLS failed. `maybe_sent` says whether the request may have been carried out.
    #[error("{}{failure}", if *.maybe_sent { "connection lost: ".into() } else { format!("can't connect to {to}: ") })]
    Tls { to: String, failure: TlsFailure, maybe_sent: bool },
    /// The connection ended before the reply.
    #[error("connection lost: {0}")]
    Lost(Lost),
    /// The received bytes are not the reply.
    #[error("invalid response: {0}")]
    Invalid(InvalidResponse),
    /// The device may not be used now: another process may use it. Nothing was sent.
    #[error("this node may not use the device now; another node may be using it")]
    Fenced,
    /// The request was not sent in time. Nothing was sent.
    #[error("not sent: it has waited too long")]
    Expired,
    /// The connection leads to none of the [`Peers`] of the request. Nothing was sent.
    #[error("not sent: the connection leads to another address")]
    Elsewhere,
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
    /// Converts a failure of a connection. `timeout` is the timeout of the request.
    pub fn new(failure: Failure, timeout: Duration) -> ClientError {
        match failure {
            Failure::Exception(code) => ClientError::Exception(code),
            Failure::Timeout => ClientError::Timeout(timeout),
            Failure::Incomplete => ClientError::Incomplete(timeout),
            Failure::NoSilence => ClientError::NoSilence(timeout),
            Failure::Invalid(invalid) => ClientError::Invalid(invalid),
            Failure::Closed(why) => ClientError::Lost(Lost::Closed(why)),
            _ => unreachable!("unknown failure: {failure}"),
        }
    }
}
