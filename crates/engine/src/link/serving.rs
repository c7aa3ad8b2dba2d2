//! Carries out the requests of listeners, on the thread of the link. Every failure becomes the exception
//! of a gateway (V1.1b3, 7).

use std::rc::Rc;
use std::sync::{Arc, Weak};

use holdfast_protocol::pdu::{self, EncodedRequest, ExceptionCode, reply};
use tokio::sync::mpsc;
use tokio::task::spawn_local;

use super::access::Link;
use super::fault::Fault;
use super::route::{Call, LinkSettings, Reply, SharedLink};
use super::shared_reads::{SharedReads, shareable};
use super::silence::Silence;

/// Carries out the requests of listeners until all routes to the link are dropped.
pub(crate) async fn serve(
    link: Rc<Link>,
    settings: LinkSettings,
    shared: Weak<SharedLink>,
    mut calls: mpsc::UnboundedReceiver<Call>,
) {
    let reads = SharedReads::new(settings.coalesce, settings.cache);
    let serving = Rc::new(Serving { link, reads, silence: Silence::default() });
    while let Some(call) = calls.recv().await {
        let Some(shared) = shared.upgrade() else { return };
        spawn_local(Rc::clone(&serving).carry_out(call, shared));
    }
}

struct Serving {
    link: Rc<Link>,
    reads: SharedReads,
    silence: Silence,
}

impl Serving {
    async fn carry_out(self: Rc<Self>, call: Call, shared: Arc<SharedLink>) {
        let Call { unit_id, request, timeout, source, priority, reply } = call;
        let counters = &shared.counters;
        let read = shareable(unit_id, &request);
        let changes = self.link.changes.get();
        if let Some(pdu) = read.as_ref().and_then(|read| self.reads.cached(read, changes)) {
            counters.cached.add();
            return reply.send(pdu);
        }
        if let Err(code) = self.silence.refuse(unit_id) {
            counters.refused_down.add();
            return reply.send(exception(&request, code));
        }
        let Some(joining) = self.reads.join(read.clone(), reply) else {
            return counters.coalesced.add();
        };
        let turn = self.link.turn(source, priority).await;
        let replies = joining.leave();
        if replies.iter().all(Reply::is_unwanted) {
            return counters.withdrawn.add();
        }
        // Others may have found out while this request waited.
        if let Err(code) = self.silence.refuse(unit_id) {
            counters.refused_down.add();
            return answer(replies, exception(&request, code));
        }
        let changes = self.link.changes.get();
        let answered = self.link.exchange(unit_id, &request, timeout, true).await;
        drop(turn);
        self.silence.learn(unit_id, &answered, self.link.retry_at().is_some());
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
                if let Some(read) = read {
                    self.reads.keep(read, &pdu, changes);
                }
                pdu
            }
            Err(Fault::Exception(code)) => vec![request.pdu()[0] | 0x80, code],
            Err(_) => exception(&request, self.silence.exception()),
        };
        answer(replies, pdu);
    }
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
