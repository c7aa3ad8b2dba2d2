//! Calls over links from an event loop in another thread.
//!
//! The thread of the link never waits for the event loop: it puts results into a queue, and a byte into
//! a socket when the queue was empty. The event loop reads the socket and takes all results.

use std::collections::HashMap;
use std::io::{self, Write};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use holdfast_protocol::client::Closed;
use holdfast_protocol::pdu::EncodedRequest;
use holdfast_runtime::lock;

use crate::client::{ClientError, Lost, SendMoment};
use crate::link::limits::permit::Wanted;
use crate::link::scheduling::queue::new_source;
use crate::wake::{Wakes, pair};

/// How long a link waits after a broadcast, which has no reply: the time to connect, if it is not
/// connected, and for devices to carry it out (Modbus over Serial Line V1.02, 2.4.1).
const BROADCAST_TIMEOUT: Duration = Duration::from_millis(500);

/// An event loop that calls devices: one source of requests, however many callers it has.
#[derive(Debug)]
pub struct Caller {
    pub(super) source: u64,
    state: Mutex<State>,
    wake: Wakes,
}

#[derive(Debug, Default)]
struct State {
    next: u64,
    pending: HashMap<u64, Pending>,
    done: Vec<Called>,
}

#[derive(Debug)]
struct Pending {
    request: EncodedRequest,
    is_sent: bool,
}

/// A call that has ended.
#[derive(Debug)]
pub struct Called {
    /// The number that [`super::SharedLink::call`] returned.
    pub ticket: u64,
    pub request: EncodedRequest,
    /// The PDU of a reply, empty after a broadcast.
    pub outcome: Result<Vec<u8>, Arc<ClientError>>,
    /// Whether the device may have received the request.
    pub is_sent: bool,
}

/// A call that has not ended. It ends as lost when this is dropped.
#[derive(Debug)]
pub(crate) struct Waiting {
    caller: Arc<Caller>,
    ticket: u64,
    timeout: Duration,
    /// `None` for a timeout that never ends.
    until: Option<Instant>,
    /// The longest wait for the reply, once it was sent.
    longest_wait: Duration,
    is_broadcast: bool,
    has_ended: bool,
}

impl Caller {
    /// The second result becomes readable when there are results, for the event loop.
    ///
    /// # Errors
    /// The system has no sockets left.
    pub fn new() -> io::Result<(Arc<Caller>, Wakes)> {
        let (wake, wakes) = pair()?;
        let caller = Caller { source: new_source(), state: Mutex::default(), wake };
        Ok((Arc::new(caller), wakes))
    }

    /// A new call. Nothing ends it at its timeout if it was not sent: its caller must withdraw it.
    pub(crate) fn begin(
        self: &Arc<Caller>,
        request: &EncodedRequest,
        timeout: Duration,
        is_broadcast: bool,
    ) -> (u64, Waiting) {
        let mut state = lock(&self.state);
        let ticket = state.next;
        state.next += 1;
        state.pending.insert(ticket, Pending { request: request.clone(), is_sent: false });
        drop(state);
        let (caller, until) = (Arc::clone(self), Instant::now().checked_add(timeout));
        let longest_wait = Duration::MAX;
        let has_ended = false;
        (ticket, Waiting { caller, ticket, timeout, until, longest_wait, is_broadcast, has_ended })
    }

    /// Gives a call up: it is not sent if it was not sent yet. Returns whether it may have been; such a call
    /// still has a result.
    pub fn withdraw(&self, ticket: u64) -> bool {
        let mut state = lock(&self.state);
        let is_sent = match state.pending.get(&ticket) {
            Some(pending) => pending.is_sent,
            // It has just ended.
            None => state
                .done
                .iter()
                .find(|called| called.ticket == ticket)
                .is_none_or(|called| called.is_sent),
        };
        if !is_sent {
            state.pending.remove(&ticket);
        }
        is_sent
    }

    /// Takes all calls that have ended.
    pub fn take(&self) -> Vec<Called> {
        std::mem::take(&mut lock(&self.state).done)
    }

    fn note_sent(&self, ticket: u64) -> bool {
        let mut state = lock(&self.state);
        state.pending.get_mut(&ticket).map(|pending| pending.is_sent = true).is_some()
    }

    fn end(&self, ticket: u64, outcome: Result<Vec<u8>, Arc<ClientError>>) {
        let mut state = lock(&self.state);
        let Some(Pending { request, is_sent }) = state.pending.remove(&ticket) else { return };
        let was_empty = state.done.is_empty();
        state.done.push(Called { ticket, request, outcome, is_sent });
        drop(state);
        if was_empty {
            // A full socket wakes the event loop too, and a closed one has no event loop.
            let _ = (&self.wake).write(&[0]);
        }
    }
}

impl Waiting {
    pub(super) fn at_most(mut self, longest_wait: Duration) -> Waiting {
        self.longest_wait = longest_wait;
        self
    }

    /// How long to wait for a reply to a request that is sent now.
    pub(super) fn reply_timeout(&self) -> Duration {
        let longest = if self.is_broadcast { BROADCAST_TIMEOUT } else { self.longest_wait };
        self.left().min(longest)
    }

    /// The time that is left.
    pub(super) fn left(&self) -> Duration {
        self.until.map_or(Duration::MAX, |until| until.saturating_duration_since(Instant::now()))
    }

    pub(crate) fn is_unwanted(&self) -> bool {
        self.left().is_zero() || !lock(&self.caller.state).pending.contains_key(&self.ticket)
    }

    /// Whether it has not been given up, for a [`Permit`](crate::link::Permit). Notes that it is sent.
    pub(crate) fn wanted(&self) -> Wanted {
        let (caller, ticket) = (Arc::clone(&self.caller), self.ticket);
        Arc::new(move |moment| match moment {
            SendMoment::Sending => caller.note_sent(ticket),
            SendMoment::Waiting => lock(&caller.state).pending.contains_key(&ticket),
        })
    }

    pub(crate) fn end(mut self, outcome: Result<Vec<u8>, Arc<ClientError>>) {
        self.has_ended = true;
        let is_over = outcome.as_ref().is_err_and(|error| {
            matches!(**error, ClientError::Timeout(_) | ClientError::Incomplete(_))
        });
        let outcome = if self.is_broadcast && is_over { Ok(Vec::new()) } else { outcome };
        self.caller.end(self.ticket, outcome);
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        if self.has_ended {
            return;
        }
        let error = match self.left().is_zero() {
            true => ClientError::Timeout(self.timeout),
            false => ClientError::Lost(Lost::Closed(Closed::BySelf)),
        };
        self.caller.end(self.ticket, Err(Arc::new(error)));
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use holdfast_protocol::pdu::{Range, Request};

    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(60);

    fn read() -> EncodedRequest {
        let range = Range::new(0, 1).expect("one register is a valid range");
        EncodedRequest::new(&Request::ReadHoldingRegisters(range))
    }

    fn woken(mut wakes: &Wakes) -> usize {
        wakes.read(&mut [0; 16]).unwrap_or(0)
    }

    #[test]
    fn several_results_cause_one_wake_up() {
        let (caller, wakes) = Caller::new().unwrap();
        let calls: Vec<_> = (0..3).map(|_| caller.begin(&read(), TIMEOUT, false)).collect();
        assert_eq!(woken(&wakes), 0);
        for (_, waiting) in calls {
            waiting.wanted()(SendMoment::Sending);
            waiting.end(Ok(vec![3, 2, 0, 7]));
        }
        assert_eq!(woken(&wakes), 1);
        let tickets: Vec<_> =
            caller.take().iter().map(|call| (call.ticket, call.is_sent)).collect();
        assert_eq!(tickets, [(0, true), (1, true), (2, true)]);
        let (_, waiting) = caller.begin(&read(), TIMEOUT, false);
        waiting.end(Ok(vec![3, 2, 0, 7]));
        assert_eq!(woken(&wakes), 1);
    }

    #[test]
    fn a_call_that_was_given_up_is_unwanted_and_has_no_result() {
        let (caller, wakes) = Caller::new().unwrap();
        let (ticket, waiting) = caller.begin(&read(), TIMEOUT, false);
        assert!(!waiting.is_unwanted());
        assert!(!caller.withdraw(ticket), "it was not sent");
        assert!(waiting.is_unwanted());
        waiting.end(Ok(vec![3, 2, 0, 7]));
        assert!(caller.take().is_empty());
        assert_eq!(woken(&wakes), 0);
    }

    #[test]
    fn a_call_that_was_sent_has_a_result_although_it_was_given_up() {
        let (caller, _wakes) = Caller::new().unwrap();
        let (ticket, waiting) = caller.begin(&read(), Duration::MAX, false);
        assert!(waiting.wanted()(SendMoment::Sending));
        assert!(caller.withdraw(ticket), "it was sent");
        waiting.end(Ok(vec![3, 2, 0, 7]));
        assert_eq!(caller.take().len(), 1);

        let (ticket, waiting) = caller.begin(&read(), Duration::MAX, false);
        assert!(waiting.wanted()(SendMoment::Waiting), "there is no connection yet");
        assert!(!caller.withdraw(ticket));
        assert!(!waiting.wanted()(SendMoment::Sending), "it is not sent");

        let (ticket, waiting) = caller.begin(&read(), Duration::MAX, false);
        waiting.end(Err(ClientError::Expired.into()));
        assert!(!caller.withdraw(ticket), "it has ended unsent");
    }

    #[test]
    fn a_call_that_nobody_carries_out_ends_as_lost_or_as_too_late() {
        let (caller, _wakes) = Caller::new().unwrap();
        drop(caller.begin(&read(), TIMEOUT, false));
        drop(caller.begin(&read(), Duration::ZERO, false));
        let ended = caller.take();
        assert!(
            matches!(ended[0].outcome.as_deref(), Err(error) if matches!(**error, ClientError::Lost(_)))
        );
        assert!(
            matches!(ended[1].outcome.as_deref(), Err(error) if matches!(**error, ClientError::Timeout(_)))
        );
        assert!(ended.iter().all(|call| !call.is_sent));
    }

    #[test]
    fn a_broadcast_without_a_reply_has_succeeded() {
        let (caller, _wakes) = Caller::new().unwrap();
        let (_, waiting) = caller.begin(&read(), TIMEOUT, true);
        assert_eq!(waiting.reply_timeout(), BROADCAST_TIMEOUT);
        waiting.end(Err(Arc::new(ClientError::Timeout(BROADCAST_TIMEOUT))));
        assert_eq!(caller.take()[0].outcome.as_ref().ok(), Some(&Vec::new()));
        let (_, waiting) = caller.begin(&read(), TIMEOUT, true);
        waiting.end(Err(Arc::new(ClientError::Incomplete(BROADCAST_TIMEOUT))));
        assert_eq!(caller.take()[0].outcome.as_ref().ok(), Some(&Vec::new()));
    }
}
