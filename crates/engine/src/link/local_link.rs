//! A link on its own thread: sends the requests of the poller and of all others in turns. Other threads use
//! [`SharedLink`](super::SharedLink).

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use holdfast_protocol::client::InvalidResponse;
use holdfast_protocol::pdu::{EncodedRequest, Request, ResponseError};
use holdfast_runtime::Retry;
use tokio::time::Instant;

use super::fault::{Exchanged, Fault};
use crate::client::{ClientError, Endpoint, Place, StrayCounters};
use crate::link::limits::circuit_breaker::{CircuitBreakers, Down};
use crate::link::limits::connect_pause::DuringPause;
use crate::link::limits::permit::Permit;
use crate::link::scheduling::in_flight::{Alone, InFlight, Pace, Place as Turn};
use crate::link::scheduling::queue::Priority;
use crate::link::sockets::blocking_link::BlockingLink;
use crate::link::sockets::tcp::TcpLink;

/// Requests of the poller, as one source beside the clients of listeners.
const POLLER: u64 = 0;

pub(crate) struct Link {
    pub(super) pace: Pace,
    pub(super) wire: Wire,
    /// When an address that cannot be reached, or a unit that does not answer, is tried again.
    pub(crate) retry: Retry,
    /// Of the requests of clients. Polls have pauses of their own.
    breakers: CircuitBreakers,
    /// Grows whenever a device may have changed by a request.
    pub(super) changes: Cell<u64>,
    /// The links to this address before it, until they are closed.
    before: RefCell<Vec<Rc<Link>>>,
}

pub(super) enum Wire {
    Tcp(Box<TcpLink>),
    Blocking(BlockingLink),
}

impl Link {
    /// Must be called in the context of a `LocalSet`.
    pub(crate) fn new(endpoint: Endpoint, in_flight: InFlight, retry: Retry) -> Rc<Link> {
        let one = InFlight::Fixed(1);
        let url = endpoint.to_string();
        let (wire, in_flight) = match endpoint.place {
            Place::Tcp { host, port, tls } => {
                let is_one = endpoint.tolerance.is_one_at_a_time();
                let link = TcpLink::new((host, port), tls, (endpoint.tolerance, retry), url);
                (Wire::Tcp(Box::new(link)), if is_one { one } else { in_flight })
            }
            _ => (Wire::Blocking(BlockingLink::new(endpoint, retry)), one),
        };
        let (pace, breakers) = (Pace::new(in_flight), CircuitBreakers::new(retry));
        let (changes, before) = Default::default();
        Rc::new(Link { pace, wire, retry, breakers, changes, before })
    }

    /// Sends nothing until a link to the same address, which nobody uses any more, is closed: a line, and many
    /// a device, has only one connection.
    pub(crate) fn follow(&self, before: Rc<Link>) {
        let mut all = before.before.take();
        all.push(before);
        self.before.replace(all);
    }

    /// Waits until the links before this one are closed.
    async fn begin(&self) {
        let before = self.before.borrow().clone();
        for link in before {
            // In a box, as this closes a link that may have had one before it.
            Box::pin(link.close()).await;
        }
        self.before.borrow_mut().clear();
    }

    /// Closes the connection behind the requests that were sent, and the links before this one first.
    pub(crate) async fn close(&self) {
        let _alone = self.alone().await;
        self.release();
        if let Wire::Blocking(link) = &self.wire {
            // Its thread has closed the connection when it refuses this one.
            let (unit_id, request) = (0, EncodedRequest::new(&Request::ReadExceptionStatus));
            let unwanted = Permit { wanted: Some(Arc::new(|_| false)), ..Permit::default() };
            let _ = link
                .exchange(unit_id, &request, Duration::ZERO, DuringPause::Connect, &unwanted)
                .await;
        }
    }

    /// Whether a request of a client with this function must fail fast.
    pub(crate) fn admit(&self, unit_id: u8, function: u8) -> Result<(), Down> {
        self.breakers.check(unit_id, function)
    }

    /// Notes the outcome of a request of a client that was sent.
    pub(crate) fn record(&self, of: (u8, u8), outcome: Result<(), Fault>) {
        self.breakers.record(of, outcome, self.retry_at().is_some());
    }

    /// Sends a request of the poller when it is its turn, and waits for the answer. `timeout` does not
    /// include the wait for the turn. Devices of one link have the same fence, or none.
    pub(crate) async fn call(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        priority: Priority,
        permit: &Permit,
    ) -> Exchanged {
        let _turn = match permit.until {
            None => self.turn(POLLER, priority).await,
            // In a box, so that polls do not carry the room for it.
            Some(_) => {
                let turn = Box::pin(self.turn(POLLER, priority));
                permit.in_time(turn).await.ok_or(ClientError::Expired)?
            }
        };
        let during_pause = match priority {
            Priority::Urgent => DuringPause::Connect,
            _ => DuringPause::Fail,
        };
        self.exchange(unit_id, request, timeout, during_pause, permit).await
    }

    /// As [`call`](Link::call), for a read and then the write that `write` makes of its answer. No other
    /// request is sent between the two. There is nothing to write if `write` returns `None`: the answer is
    /// invalid then.
    pub(crate) async fn read_then_write(
        &self,
        unit_id: u8,
        read: &EncodedRequest,
        write: impl FnOnce(&[u8]) -> Option<EncodedRequest>,
        timeout: Duration,
        permit: &Permit,
    ) -> Exchanged {
        let _alone = self.alone().await;
        let answer = self.exchange(unit_id, read, timeout, DuringPause::Connect, permit).await?;
        let invalid = || ClientError::Invalid(InvalidResponse::Pdu(ResponseError::Length));
        let write = write(&answer).ok_or_else(invalid)?;
        self.exchange(unit_id, &write, timeout, DuringPause::Connect, permit).await
    }

    /// Waits for a turn, which lasts as long as the result.
    pub(super) async fn turn(&self, source: u64, priority: Priority) -> Turn<'_> {
        let turn = self.pace.place(source, priority).await;
        self.begin().await;
        turn
    }

    /// Waits for a turn in which no other request is in flight.
    async fn alone(&self) -> Alone<'_> {
        let alone = self.pace.alone(POLLER, Priority::Urgent).await;
        self.begin().await;
        alone
    }

    /// Sends a request and waits for the answer.
    pub(super) async fn exchange(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        during_pause: DuringPause,
        permit: &Permit,
    ) -> Exchanged {
        self.note_change(request);
        let answer = match &self.wire {
            Wire::Tcp(link) => {
                link.exchange(&self.pace, unit_id, request, timeout, during_pause, permit).await
            }
            Wire::Blocking(link) => {
                link.exchange(unit_id, request, timeout, during_pause, permit).await
            }
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

    /// What was received without a request, or late.
    pub(crate) fn strays(&self) -> &Arc<StrayCounters> {
        match &self.wire {
            Wire::Tcp(link) => link.strays(),
            Wire::Blocking(link) => link.strays(),
        }
    }

    /// Closes the connection if no request is in flight. The next request opens a new one.
    pub(crate) fn release(&self) {
        match &self.wire {
            Wire::Tcp(link) => link.release(),
            Wire::Blocking(link) => link.release(),
        }
    }
}

#[cfg(test)]
mod tests {
    use holdfast_protocol::pdu::Range;
    use tokio::runtime::Builder;
    use tokio::task::LocalSet;

    use super::*;
    use crate::link::fault::{Fault, fault};
    use crate::name_lookup;

    #[test]
    fn a_name_that_is_not_resolved_in_time_is_a_failed_connect_on_every_transport() {
        let read = EncodedRequest::new(&Request::ReadHoldingRegisters(Range::new(0, 1).unwrap()));
        let (host, port) = (String::from("unanswered.test"), 502);
        let _unanswered = name_lookup::hold(&host);
        let places = [
            Place::Tcp { host: host.clone(), port, tls: None },
            Place::Udp { host: host.clone(), port },
            Place::RtuOverTcp { host: host.clone(), port },
            Place::AsciiOverTcp { host: host.clone(), port },
            Place::RtuOverUdp { host, port },
        ];
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            for place in places {
                let endpoint = Endpoint::from(place);
                let told = endpoint.to_string();
                let link = Link::new(endpoint, InFlight::Fixed(1), Retry::default());
                let (priority, permit) = (Priority::Usual, Permit::default());
                let answer = link.call(1, &read, Duration::from_millis(1), priority, &permit).await;
                assert_eq!(fault(&answer.unwrap_err()), Fault::Timeout, "{told}");
                assert!(link.retry_at().is_some(), "{told}");
            }
        });
    }
}
