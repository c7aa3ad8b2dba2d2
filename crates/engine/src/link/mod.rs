//! Links: one connection or one serial line each, shared by all that ask the devices behind it.
//!
//! The poller asks by [`Link::call`], listeners through a [`Route`]. Over Modbus TCP, several requests
//! can be in flight, if the settings allow it. Other transports carry one request at a time, in a
//! thread of their own. Who waits for a place is served in a fair order ([`queue`]).
//!
//! After a failed connect, requests fail immediately until the backoff is over. `Connection`, in
//! `holdfast_protocol`, decides when a connection ends. The next request opens a new one.

pub(crate) mod backoff;
mod blocking;
mod fault;
mod handshake;
mod pace;
mod queue;
mod route;
mod routing;
mod tcp;

use std::cell::Cell;
use std::rc::Rc;
use std::time::Duration;

use holdfast_protocol::client::Failure;
use holdfast_protocol::pdu::EncodedRequest;
use tokio::time::Instant;

use self::blocking::BlockingLink;
use self::pace::{Pace, Place as Turn};
use self::tcp::TcpLink;
use crate::client::{Endpoint, Place};

pub use fault::Fault;
pub use pace::InFlight;
pub(crate) use queue::Priority;
pub(crate) use route::{Asker, Call, Coming};
pub use route::{LinkCounters, LinkSettings, Route, SharedLink};
pub(crate) use routing::serve;

/// The PDU of a reply, empty after a broadcast; or the fault.
pub(crate) type Answer = Result<Vec<u8>, Fault>;

/// Requests of the poller, as one source beside the clients of listeners.
const POLLER: u64 = 0;

pub(crate) struct Link {
    pace: Pace,
    wire: Wire,
    /// Grows whenever a device may have changed by a request.
    changes: Cell<u64>,
}

enum Wire {
    Tcp(Box<TcpLink>),
    Blocking(BlockingLink),
}

impl Link {
    /// Must be called in the context of a `LocalSet`.
    pub(crate) fn new(endpoint: Endpoint, in_flight: InFlight) -> Rc<Link> {
        let one = InFlight::Fixed(1);
        let (wire, in_flight) = match endpoint.place {
            Place::Tcp { host, port, tls } => {
                let is_one = endpoint.tolerance.is_one_at_a_time();
                let link = TcpLink::new((host, port), tls, endpoint.tolerance);
                (Wire::Tcp(Box::new(link)), if is_one { one } else { in_flight })
            }
            _ => (Wire::Blocking(BlockingLink::new(endpoint)), one),
        };
        Rc::new(Link { pace: Pace::new(in_flight), wire, changes: Cell::default() })
    }

    /// Sends a request of the poller when it is its turn, and waits for the answer. `timeout` does not
    /// include the wait for the turn.
    pub(crate) async fn call(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        priority: Priority,
    ) -> Answer {
        let _turn = self.turn(POLLER, priority).await;
        let eager = priority == Priority::Urgent;
        self.exchange(unit_id, request, timeout, eager).await
    }

    /// Waits for a turn, which lasts as long as the result.
    async fn turn(&self, source: u64, priority: Priority) -> Turn<'_> {
        self.pace.place(source, priority).await
    }

    /// Sends a request and waits for the answer. With `eager`, an unreachable address is tried even
    /// before its pause is over.
    async fn exchange(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        eager: bool,
    ) -> Answer {
        self.note_change(request);
        let answer = match &self.wire {
            Wire::Tcp(link) => link.exchange(&self.pace, unit_id, request, timeout, eager).await,
            Wire::Blocking(link) => link.exchange(unit_id, request, timeout, eager).await,
        };
        self.note_change(request);
        answer
    }

    /// Counts a request that may change a device, before it is sent and after it was answered.
    fn note_change(&self, request: &EncodedRequest) {
        if !request.is_read() {
            self.changes.set(self.changes.get() + 1);
        }
    }

    /// When an unreachable address is tried again. Until then polls fail immediately.
    pub(crate) fn retry_at(&self) -> Option<Instant> {
        let failed = match &self.wire {
            Wire::Tcp(link) => link.retry_at(),
            Wire::Blocking(link) => link.retry_at(),
        };
        failed.filter(|until| Instant::now() < *until)
    }

    /// Closes the connection if no request is in flight. The next request opens a new one.
    pub(crate) fn release(&self) {
        match &self.wire {
            Wire::Tcp(link) => link.release(),
            Wire::Blocking(link) => link.release(),
        }
    }
}

/// The fault that a failed request counts as.
fn fault(failure: Failure) -> Fault {
    match failure {
        Failure::Exception(code) => Fault::Exception(code),
        Failure::Timeout => Fault::Timeout,
        Failure::Invalid(_) => Fault::Invalid,
        _ => Fault::Reset,
    }
}
