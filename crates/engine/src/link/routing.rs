//! Requests of listeners, on the thread of the link: equal reads are answered together, a unit that
//! stays silent does not hold up the others, and every failure becomes the exception of a gateway
//! (V1.1b3, 7).

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use holdfast_protocol::pdu::{self, EncodedRequest, ExceptionCode, reply};
use tokio::sync::mpsc;
use tokio::task::spawn_local;
use tokio::time::Instant;

use super::access::Link;
use super::backoff;
use super::fault::{Answer, Fault};
use super::route::{Call, LinkSettings, Reply, SharedLink};

/// Timeouts in a row after which requests to a unit are refused for a while.
const SILENT_AFTER: u32 = 3;

/// The longest time for which requests are refused without a try: somebody waits for them.
const MAX_PAUSE: Duration = Duration::from_secs(5);

/// The most replies that are kept for equal reads.
const MAX_CACHED: usize = 1024;

/// Carries out the requests of listeners until all routes to the link are dropped.
pub(crate) async fn serve(
    link: Rc<Link>,
    settings: LinkSettings,
    shared: std::sync::Weak<SharedLink>,
    mut calls: mpsc::UnboundedReceiver<Call>,
) {
    let LinkSettings { coalesce, cache, .. } = settings;
    let state = Default::default();
    let routing = Rc::new(Routing { link, coalesce, keep: cache, state });
    while let Some(call) = calls.recv().await {
        let Some(shared) = shared.upgrade() else { return };
        spawn_local(Rc::clone(&routing).carry_out(call, shared));
    }
}

struct Routing {
    link: Rc<Link>,
    coalesce: bool,
    /// How long a reply answers equal reads.
    keep: Duration,
    state: State,
}

#[derive(Default)]
struct State {
    /// Reads that wait for their turn, with the replies to equal ones that came later.
    waiting: RefCell<HashMap<Read, Vec<Reply>>>,
    cached: RefCell<HashMap<Read, Cached>>,
    silent: RefCell<HashMap<u8, Pause>>,
    unreachable: Cell<Option<Pause>>,
}

/// A read that equal ones can share a reply with: its unit id and PDU.
type Read = (u8, Box<[u8]>);

struct Cached {
    pdu: Vec<u8>,
    until: Instant,
    /// [`Link::changes`] when it was asked for.
    changes: u64,
}

/// Failures in a row, and how long requests are refused for that.
#[derive(Clone, Copy)]
struct Pause {
    failures: u32,
    until: Instant,
}

impl Pause {
    /// After one more failure. The first `free` failures cause no pause.
    fn longer(before: Option<Pause>, free: u32) -> Pause {
        let failures = before.map_or(1, |pause| pause.failures.saturating_add(1));
        let pause = match failures.checked_sub(free) {
            None | Some(0) => Duration::ZERO,
            Some(counted) => backoff::pause(counted, MAX_PAUSE),
        };
        Pause { failures, until: Instant::now() + pause }
    }

    fn lasts(&self) -> bool {
        Instant::now() < self.until
    }
}

impl Routing {
    async fn carry_out(self: Rc<Self>, call: Call, shared: Arc<SharedLink>) {
        let Call { unit_id, request, timeout, source, priority, reply } = call;
        let counters = &shared.counters;
        let read = shareable(unit_id, &request);
        if let Some(pdu) = read.as_ref().and_then(|read| self.cached(read)) {
            counters.cached.add();
            return reply.send(pdu);
        }
        if let Err(code) = self.refuse(unit_id) {
            counters.refused_down.add();
            return reply.send(exception(&request, code));
        }
        let read = match read.filter(|_| self.coalesce) {
            Some(read) => match self.join(read, reply) {
                Some(joining) => joining,
                None => return counters.coalesced.add(),
            },
            None => Joining { routing: &self, read: None, first: Some(reply) },
        };
        let turn = self.link.turn(source, priority).await;
        let replies = read.leave();
        if replies.iter().all(Reply::is_unwanted) {
            return counters.withdrawn.add();
        }
        // Others may have found out while this request waited.
        if let Err(code) = self.refuse(unit_id) {
            counters.refused_down.add();
            return answer(replies, exception(&request, code));
        }
        let changes = self.link.changes.get();
        let answered = self.link.exchange(unit_id, &request, timeout, true).await;
        drop(turn);
        self.learn(unit_id, &answered);
        match &answered {
            Ok(_) => counters.replies.add(),
            Err(Fault::Exception(_)) => {
                counters.replies.add();
                counters.exceptions.add();
            }
            Err(Fault::Timeout) => counters.timeouts.add(),
            Err(_) => counters.failures.add(),
        }
        let pdu = match answered {
            Ok(pdu) => {
                self.keep(unit_id, &request, &pdu, changes);
                pdu
            }
            Err(Fault::Exception(code)) => vec![request.pdu()[0] | 0x80, code],
            Err(_) if self.state.unreachable.get().is_some() => {
                exception(&request, ExceptionCode::GatewayPathUnavailable)
            }
            Err(_) => exception(&request, ExceptionCode::GatewayTargetFailedToRespond),
        };
        answer(replies, pdu);
    }

    /// Waits with an equal read if there is one: then it has the reply.
    fn join(&self, read: Read, reply: Reply) -> Option<Joining<'_>> {
        let mut waiting = self.state.waiting.borrow_mut();
        if let Some(equal) = waiting.get_mut(&read) {
            equal.push(reply);
            return None;
        }
        waiting.insert(read.clone(), vec![reply]);
        Some(Joining { routing: self, read: Some(read), first: None })
    }

    /// Whether a request is refused without a try.
    fn refuse(&self, unit_id: u8) -> Result<(), ExceptionCode> {
        if self.state.unreachable.get().is_some_and(|pause| pause.lasts()) {
            return Err(ExceptionCode::GatewayPathUnavailable);
        }
        if self.state.silent.borrow().get(&unit_id).is_some_and(Pause::lasts) {
            return Err(ExceptionCode::GatewayTargetFailedToRespond);
        }
        Ok(())
    }

    /// Draws conclusions for the next requests.
    fn learn(&self, unit_id: u8, answered: &Answer) {
        let State { silent, unreachable, .. } = &self.state;
        if answered.is_err() && self.link.retry_at().is_some() {
            return unreachable.set(Some(Pause::longer(unreachable.get(), 0)));
        }
        unreachable.set(None);
        let mut silent = silent.borrow_mut();
        if *answered == Err(Fault::Timeout) {
            let pause = Pause::longer(silent.get(&unit_id).copied(), SILENT_AFTER - 1);
            silent.insert(unit_id, pause);
        } else {
            silent.remove(&unit_id);
        }
    }

    fn cached(&self, read: &Read) -> Option<Vec<u8>> {
        if self.keep.is_zero() {
            return None;
        }
        let cached = self.state.cached.borrow();
        let found = cached.get(read)?;
        let holds = found.changes == self.link.changes.get() && Instant::now() < found.until;
        holds.then(|| found.pdu.clone())
    }

    /// Keeps a reply for equal reads. A request that may have changed a device ends all that came
    /// before it.
    fn keep(&self, unit_id: u8, request: &EncodedRequest, pdu: &[u8], changes: u64) {
        let Some(read) = shareable(unit_id, request).filter(|_| !self.keep.is_zero()) else {
            return;
        };
        let now = Instant::now();
        let mut cached = self.state.cached.borrow_mut();
        if cached.len() >= MAX_CACHED {
            cached.retain(|_, kept| now < kept.until);
        }
        if cached.len() < MAX_CACHED {
            cached.insert(read, Cached { pdu: pdu.to_vec(), until: now + self.keep, changes });
        }
    }
}

/// A request that waits for its turn, and the replies to equal ones.
struct Joining<'r> {
    routing: &'r Routing,
    read: Option<Read>,
    first: Option<Reply>,
}

impl Joining<'_> {
    /// It is sent now: whoever asks from now on gets a later reply.
    fn leave(mut self) -> Vec<Reply> {
        let joined =
            self.read.take().and_then(|read| self.routing.state.waiting.borrow_mut().remove(&read));
        joined.unwrap_or_else(|| self.first.take().into_iter().collect())
    }
}

/// The key of a read whose reply can answer equal ones: functions 1 to 4.
fn shareable(unit_id: u8, request: &EncodedRequest) -> Option<Read> {
    let pdu = request.pdu();
    (matches!(pdu[0], 1..=4) && request.request().is_some()).then(|| (unit_id, pdu.into()))
}

fn answer(replies: Vec<Reply>, pdu: Vec<u8>) {
    let mut replies = replies.into_iter();
    let last = replies.next_back();
    for reply in replies {
        reply.send(pdu.clone());
    }
    if let Some(reply) = last {
        reply.send(pdu);
    }
}

fn exception(request: &EncodedRequest, code: ExceptionCode) -> Vec<u8> {
    let mut pdu = [0; pdu::MAX_LEN];
    let len = reply::exception(request.pdu()[0], code, &mut pdu);
    pdu[..len].to_vec()
}
