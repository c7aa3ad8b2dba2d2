//! Requests of a connection whose replies come later. Replies keep the order of their requests, and
//! only requests that are answered elsewhere overtake each other on their way.
//!
//! A request that can be answered here waits until all before it are answered: its client expects the
//! effects of those. A connection with too many such requests is not read for a while.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use holdfast_protocol::pdu::ExceptionCode;

use super::audit::Permit;
use super::listener::ListenerContext;
use super::policy::{Elsewhere, PeerRights};
use super::refused_request::RefusedRequest;
use super::unit_server::UnitServer;
use crate::link::{Asker, PendingReply, Reply, exception, source};

/// The most requests of a connection that wait for replies.
pub(super) const MAX_WAITING: usize = 16;

pub(super) struct Deferred {
    source: u64,
    waiting: VecDeque<Waiting>,
    /// Received bytes that are read as requests when there is room again.
    unread: Vec<u8>,
}

/// A request without its reply.
pub(super) struct Waiting {
    tag: u16,
    unit_id: u8,
    route: Option<Arc<str>>,
    request: Vec<u8>,
    reply: Expected,
    permit: Option<Permit>,
    /// Whether a journal carries it out. Those of a connection are carried out in their order.
    is_step: bool,
}

enum Expected {
    Pending(PendingReply),
    Known(Reply),
}

/// A request with its reply.
pub(super) struct Completed {
    pub(super) tag: u16,
    pub(super) unit_id: u8,
    /// The device that the request was passed on to; `None` if it was refused, or is of a memory.
    pub(super) route: Option<Arc<str>>,
    pub(super) request: Vec<u8>,
    pub(super) reply: Reply,
    pub(super) permit: Option<Permit>,
}

/// When a request is answered.
pub(super) enum Deferral {
    /// Its reply comes later. It may already be refused.
    Later(Option<RefusedRequest>),
    /// It must wait until others are answered.
    Wait,
    /// It can be answered now.
    Now,
}

impl Default for Deferred {
    fn default() -> Deferred {
        Deferred { source: source(), waiting: VecDeque::new(), unread: Vec::new() }
    }
}

impl Deferred {
    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Whether received bytes wait until there is room.
    pub(super) fn is_full(&self) -> bool {
        !self.unread.is_empty()
    }

    /// Sends a request on its way, if its unit is elsewhere and there is room.
    pub(super) fn defer(
        &mut self,
        (unit_server, rights, context): (&UnitServer, &PeerRights, &ListenerContext),
        place: Option<&Elsewhere>,
        peer: IpAddr,
        (tag, unit_id, request): (u16, u8, &[u8]),
    ) -> Deferral {
        let place = match place {
            // Without a request before it, nothing can reorder its effects.
            None if self.is_empty() => return Deferral::Now,
            Some(place @ Elsewhere::Device(_)) if self.waiting.len() < MAX_WAITING => place,
            // A write to a mirror also changes the memory, which requests before it may read or write.
            Some(place @ Elsewhere::Mirror(_)) if self.is_empty() => place,
            Some(place @ Elsewhere::Journal(_))
                if self.waiting.len() < MAX_WAITING
                    && self.waiting.iter().all(|waiting| waiting.is_step) =>
            {
                place
            }
            _ => return Deferral::Wait,
        };
        let asker = Asker { source: self.source, peer: Some(peer), waiting: self.waiting.len() };
        let permit = context.permit_forwarded(request);
        let permitted = permit.is_some();
        let sent = unit_server.forward(rights, place, &asker, unit_id, request, permitted);
        let refused = RefusedRequest::before_device(unit_id, request, &sent);
        let (route, reply) = match sent {
            Ok((route, pending)) => (route, Expected::Pending(pending)),
            Err(code) => {
                let pdu = exception(request, code.code());
                (None, Expected::Known(Reply { pdu, ..Reply::default() }))
            }
        };
        let is_step = matches!(place, Elsewhere::Journal(_));
        let request = request.to_vec();
        self.waiting.push_back(Waiting { tag, unit_id, route, request, reply, permit, is_step });
        Deferral::Later(refused)
    }

    /// The client has disconnected. Requests that wait for their turn are not sent. Returns the others, whose
    /// replies still come.
    pub(super) fn give_up(self) -> VecDeque<Waiting> {
        for waiting in &self.waiting {
            if let Expected::Pending(pending) = &waiting.reply {
                pending.give_up();
            }
        }
        self.waiting
    }

    /// Keeps received bytes until there is room.
    pub(super) fn leave(&mut self, bytes: &[u8]) {
        debug_assert!(self.unread.is_empty() && !bytes.is_empty());
        self.unread.extend_from_slice(bytes);
    }

    /// Moves those bytes to the start of `input`, and returns their length.
    pub(super) fn resume(&mut self, input: &mut [u8]) -> usize {
        let unread = std::mem::take(&mut self.unread);
        input[..unread.len()].copy_from_slice(&unread);
        unread.len()
    }

    /// The next reply, once it is there.
    pub(super) fn poll_next(
        &mut self,
        unit_server: &UnitServer,
        context: &mut Context<'_>,
    ) -> Poll<Completed> {
        let Some(first) = self.waiting.front_mut() else { return Poll::Pending };
        if let Expected::Pending(pending) = &mut first.reply {
            let Poll::Ready(reply) = Pin::new(pending).poll(context) else { return Poll::Pending };
            first.reply = Expected::Known(count_reply(unit_server, &first.request, reply.ok()));
        }
        let Some(Waiting { tag, unit_id, route, request, reply, permit, .. }) =
            self.waiting.pop_front()
        else {
            unreachable!("there is a first request")
        };
        let Expected::Known(reply) = reply else { unreachable!("its reply is known") };
        Poll::Ready(Completed { tag, unit_id, route, request, reply, permit })
    }
}

impl Waiting {
    /// Waits for the reply. `None` if the request was not sent.
    pub(super) async fn complete(self, unit_server: &UnitServer) -> Option<Completed> {
        let Waiting { tag, unit_id, route, request, reply, permit, .. } = self;
        let reply = match reply {
            Expected::Pending(pending) => {
                count_reply(unit_server, &request, Some(pending.await.ok()?))
            }
            Expected::Known(reply) => reply,
        };
        Some(Completed { tag, unit_id, route, request, reply, permit })
    }
}

/// Counts a reply, and returns it. `None` means that the link has ended.
pub(super) fn count_reply(unit_server: &UnitServer, request: &[u8], reply: Option<Reply>) -> Reply {
    let ended = || exception(request, ExceptionCode::GatewayPathUnavailable.code());
    let reply = reply.unwrap_or_else(|| Reply { pdu: ended(), ..Reply::default() });
    unit_server.forwarded(request, &reply.pdu);
    reply
}
