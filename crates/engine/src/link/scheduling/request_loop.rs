//! Carries out the requests of listeners and event loops, on the thread of the link. For listeners, every
//! failure becomes the exception of a gateway (V1.1b3, 7); event loops get the error itself.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::{Arc, Weak};
use std::time::Duration;

use holdfast_protocol::pdu::{EncodedRequest, ExceptionCode};
use tokio::sync::mpsc;
use tokio::task::spawn_local;
use tokio::time::Instant;

use crate::client::ClientError;
use crate::link::fault::{Exchanged, Fault, exception, exception_code, fault};
use crate::link::limits::circuit_breaker::{Down, OPEN_AFTER_TIMEOUTS};
use crate::link::limits::connect_pause::DuringPause;
use crate::link::limits::permit::{Permit, Wanted};
use crate::link::limits::standstill;
use crate::link::local_link::Link;
use crate::link::route::{Call, LinkSettings, Reply, SharedLink};
use crate::link::scheduling::shared_reads::{SharedReads, shareable};
use crate::link::scheduling::write_barrier::Order;

/// A link without an answer for so long is silent. One unit that is silent beside others does not make it so.
const SILENT_AFTER: Duration = Duration::from_secs(10);

/// Carries out the requests to a link until all that could send some are dropped.
pub(crate) async fn serve(
    link: Rc<Link>,
    settings: LinkSettings,
    shared: Weak<SharedLink>,
    mut calls: mpsc::UnboundedReceiver<Call>,
) {
    if let Some(shared) = shared.upgrade() {
        shared.connect_counters(link.strays());
    }
    let reads = SharedReads::new(settings.coalesce, settings.cache);
    let order = Arc::<Order>::default();
    let (failures, answered) = Default::default();
    let serving = Rc::new(Serving { link, order, reads, failures, answered });
    while let Some(call) = calls.recv().await {
        let Some(shared) = shared.upgrade() else { return };
        spawn_local(Rc::clone(&serving).carry_out(call, shared));
    }
}

struct Serving {
    link: Rc<Link>,
    order: Arc<Order>,
    reads: SharedReads,
    /// Requests in a row that had no answer.
    failures: Cell<u32>,
    /// When the last answer came.
    answered: Cell<Option<Instant>>,
}

impl Serving {
    async fn carry_out(self: Rc<Self>, call: Call, shared: Arc<SharedLink>) {
        let Call { unit_id, request, queued, source, priority, mut reply } = call;
        let counters = &shared.counters;
        // Callers of an event loop wait for their own replies, and share one source.
        if reply.is_of_listener() {
            reply.hold(self.order.wait(source, request.is_read()).await);
        }
        let read = shareable(unit_id, &request);
        let changes = self.link.changes.get();
        // People decide on what an event loop has just read: such a read always asks the device.
        let older = read.as_ref().filter(|_| reply.is_of_listener());
        if let Some(pdu) = older.and_then(|read| self.reads.cached(read, changes)) {
            counters.cached.add();
            return reply.send(Ok(&pdu));
        }
        let Some(reply) = self.admitted(unit_id, &request, vec![reply], &shared).pop() else {
            return;
        };
        let client_gone = reply.client_gone();
        let peers = reply.peers.clone();
        let joining = self.reads.join(read.clone(), reply);
        if joining.follows_equal {
            counters.coalesced.add();
        }
        let turn = tokio::select! {
            biased;
            () = joining.sent() => return,
            () = client_gone => {
                joining.withdraw();
                return counters.withdrawn.add();
            }
            turn = self.link.turn(source, priority) => turn,
        };
        let replies = joining.leave();
        if replies.iter().all(Reply::is_unwanted) {
            return counters.withdrawn.add();
        }
        // Requests before this one may have opened a breaker while it waited.
        let mut replies = self.admitted(unit_id, &request, replies, &shared);
        if replies.is_empty() {
            return;
        }
        // Callers that have given up already know that nothing is sent.
        replies.retain(|reply| !reply.is_unwanted());
        let Some(timeout) = replies.iter().map(Reply::timeout).max() else {
            return counters.withdrawn.add();
        };
        let changes = self.link.changes.get();
        // There may be no connection yet, and a line may still wait for late replies to others. Each caller
        // is asked: each notes whether its request is sent.
        let wanted: Vec<_> = replies.iter().map(Reply::wanted).collect();
        let wanted: Wanted =
            Arc::new(move |moment| wanted.iter().filter(|wanted| wanted(moment)).count() > 0);
        let permit = match request.is_read() {
            true => Permit::default(),
            false => Permit::default().and(standstill::none_since(queued)),
        };
        let permit = Permit { peers, ..permit.and(wanted) };
        let answered =
            self.link.exchange(unit_id, &request, timeout, DuringPause::Connect, &permit).await;
        drop(turn);
        if let Err(error) = &answered
            && matches!(**error, ClientError::Expired | ClientError::Elsewhere)
        {
            counters.withdrawn.add();
            // After a standstill, or without its device, a caller may still be there.
            replies.retain(|reply| !reply.is_unwanted());
            let pdu = exception(request.pdu(), exception_code(error));
            return replies.into_iter().for_each(|reply| reply.send(Err((error, &pdu))));
        }
        let from_listener = replies.iter().any(Reply::is_of_listener);
        self.record((unit_id, request.pdu()[0]), &answered, from_listener, &shared);
        let error = match answered {
            Ok(pdu) => {
                counters.replies.add();
                if let Some(read) = read {
                    self.reads.keep(read, &pdu, changes);
                }
                return replies.into_iter().for_each(|reply| reply.send(Ok(&pdu)));
            }
            Err(error) => error,
        };
        let fault = fault(&error);
        match fault {
            Fault::Exception(_) => {
                counters.replies.add();
                counters.exceptions.add();
            }
            Fault::Timeout => counters.timeouts.add(),
            _ => counters.failures.add(),
        }
        let pdu = exception(request.pdu(), exception_code(&error));
        replies.into_iter().for_each(|reply| reply.send(Err((&error, &pdu))));
    }

    /// Fails fast where a breaker is open, and returns the other callers. Event loops choose their timeouts
    /// and look for silent addresses: they fail fast only if the address can't be reached.
    fn admitted(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        replies: Vec<Reply>,
        shared: &SharedLink,
    ) -> Vec<Reply> {
        let Err(down) = self.link.admit(unit_id, request.pdu()[0]) else { return replies };
        // Not 0B, after which a write may have been carried out: nothing was sent.
        let pdu = exception(request.pdu(), ExceptionCode::GatewayPathUnavailable.code());
        let error = shared.error().filter(|_| down == Down::Address);
        let mut admitted = Vec::new();
        let mut is_refused = false;
        for reply in replies {
            match &error {
                Some(error) => reply.send(Err((error, &pdu))),
                None if reply.is_of_listener() => reply.send(Ok(&pdu)),
                None => {
                    admitted.push(reply);
                    continue;
                }
            }
            is_refused = true;
        }
        if is_refused {
            shared.counters.refused_down.add();
        }
        admitted
    }

    /// Notes the outcome for the breakers, and the error of the link. The timeouts of event loops alone say
    /// nothing about a unit: they may be short.
    fn record(&self, of: (u8, u8), answered: &Exchanged, from_listener: bool, shared: &SharedLink) {
        let is_unreachable = self.link.retry_at().is_some();
        let outcome = answered.as_ref().map(drop).map_err(|error| fault(error));
        if outcome == Err(Fault::Timeout) && !from_listener && !is_unreachable {
            return;
        }
        self.link.record(of, outcome);
        match answered {
            Err(error) if !matches!(outcome, Err(Fault::Exception(_))) => {
                self.failures.set(self.failures.get().saturating_add(1));
                let is_silent = self.answered.get().is_none_or(|at| at.elapsed() >= SILENT_AFTER)
                    && self.failures.get() >= OPEN_AFTER_TIMEOUTS;
                if is_unreachable || is_silent {
                    shared.set_error(Some(error));
                }
            }
            // Nobody replies to a broadcast: it shows that the line can be used, not that a unit answers.
            Ok(pdu) if pdu.is_empty() => {
                use ClientError::{Incomplete, Invalid, Timeout};
                match shared.error().as_deref() {
                    Some(Timeout(_) | Incomplete(_) | Invalid(_)) => {}
                    _ => shared.set_error(None),
                }
            }
            _ => {
                self.failures.set(0);
                self.answered.set(Some(Instant::now()));
                shared.set_error(None);
            }
        }
    }
}
