//! Requests of a connection whose replies come later. Replies keep the order of their requests, and
//! only requests that devices answer over routes, or steps of journals, are on their way at the same time.
//!
//! A request that can be answered here waits until all before it are answered: its client expects the
//! effects of those. All behind it wait too. The connection is read meanwhile: its end, a repetition or a newer
//! request may mean that those that wait are not sent.
//!
//! No reply may come to a request that its client has given up (`given_up.rs`).

use std::collections::VecDeque;
use std::mem::{Discriminant, discriminant};
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use holdfast_memory::Memory;
use holdfast_protocol::frame::mbap;
use holdfast_protocol::pdu::ExceptionCode;
use tokio::sync::watch;

use crate::link::{Asker, PendingReply, Reply, exception, new_source};
use crate::server::connections::listener::ListenerContext;
use crate::server::connections::peer::Peer;
use crate::server::reports::audit::{Forwarded, Permit};
use crate::server::reports::refused_request::RefusedRequest;
use crate::server::requests::unit_server::UnitServer;
use crate::server::rights::functions::only_reads;
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::rule::RequestDestination;

/// The most requests of a connection that wait for replies.
pub(in crate::server) const MAX_WAITING: usize = 16;

pub(in crate::server) struct Deferred {
    source: u64,
    waiting: VecDeque<Waiting>,
    /// Requests that are not on their way yet, in whatever framing they came: as frames with an MBAP header.
    behind: Vec<u8>,
}

/// A request without its reply.
pub(in crate::server) struct Waiting {
    asked: Asked,
    reply: Expected,
    /// How often it was sent. Each time is answered, as by a device.
    times: usize,
    /// Whether no other request with its transaction id has come after it.
    is_newest: bool,
    /// What answers it, and keeps the order of what it is asked. Whatever others answer waits.
    answered_by: Discriminant<RequestDestination>,
}

/// A request that is answered elsewhere.
pub(in crate::server) struct Asked {
    pub(in crate::server) tag: u16,
    pub(in crate::server) unit_id: u8,
    /// The name of the memory of the unit; `None` if it is a device.
    memory: Option<Arc<str>>,
    /// The device that the request was passed on to; `None` if it was refused, or is of a memory.
    route: Option<Arc<str>>,
    request: Vec<u8>,
    /// `None` if it was refused.
    permit: Option<Permit>,
}

pub(in crate::server) enum Expected {
    Pending(PendingReply),
    /// It was refused.
    Known(Reply),
}

/// When a request is answered.
pub(in crate::server) enum Deferral {
    /// Its reply comes later. It may already be refused.
    Later(Option<RefusedRequest>),
    /// It can be answered now.
    Now,
}

impl Default for Deferred {
    fn default() -> Deferred {
        Deferred { source: new_source(), waiting: VecDeque::new(), behind: Vec::new() }
    }
}

impl Deferred {
    pub(in crate::server) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// The bytes of requests that are not on their way yet. While there are any, others are.
    pub(in crate::server) fn behind(&self) -> usize {
        self.behind.len()
    }

    /// Whether a request is the newest one of its transaction id, sent again before its reply: then it gets
    /// the same reply. Passed on, it could undo a later write of another client. Reads are harmless. An older
    /// one does not count: a client may use one id for all requests, and return to an earlier value.
    fn repeats(&mut self, (tag, unit_id, request): (u16, u8, &[u8])) -> bool {
        let has_room = self.has_room();
        let newest = self.waiting.iter_mut().rev().find(|waiting| waiting.asked.tag == tag);
        let Some(Waiting { asked, times, is_newest, .. }) = newest else { return false };
        *is_newest &= asked.unit_id == unit_id && asked.request == request && !only_reads(request);
        if *is_newest && has_room {
            *times += 1;
        }
        *is_newest
    }

    fn has_room(&self) -> bool {
        self.waiting.iter().map(|waiting| waiting.times).sum::<usize>() < MAX_WAITING
    }

    /// Sends a request on its way, if its unit is elsewhere and there is room. Keeps it if it must wait until
    /// others are answered.
    pub(in crate::server) fn defer(
        &mut self,
        (unit_server, rights, context): (&UnitServer, &PeerRights, &ListenerContext),
        destination: Option<&RequestDestination>,
        peer: IpAddr,
        has_ids: bool,
        (tag, unit_id, request): (u16, u8, &[u8]),
    ) -> Deferral {
        if has_ids && self.repeats((tag, unit_id, request)) {
            return Deferral::Later(None);
        }
        let destination = match destination.filter(|_| self.behind.is_empty()) {
            // Without a request before it, nothing can reorder its effects.
            None if self.is_empty() => return Deferral::Now,
            // A write to a mirror also changes the memory, which requests before it may read or write.
            Some(destination @ RequestDestination::Mirror(_)) if self.is_empty() => destination,
            Some(
                destination @ (RequestDestination::Device(_) | RequestDestination::Journal(_)),
            ) if self.has_room()
                && self
                    .waiting
                    .iter()
                    .all(|other| other.answered_by == discriminant(destination)) =>
            {
                destination
            }
            _ => {
                self.behind.extend_from_slice(&mbap::header(tag, unit_id, request.len()));
                self.behind.extend_from_slice(request);
                return Deferral::Later(None);
            }
        };
        let asker = Asker { source: self.source, peer: Some(peer) };
        let (asked, reply, refused) =
            Asked::send(context, destination, (tag, unit_id, request), |can_record| {
                unit_server.forward(rights, destination, &asker, unit_id, request, can_record)
            });
        let answered_by = discriminant(destination);
        self.waiting.push_back(Waiting { asked, reply, times: 1, is_newest: true, answered_by });
        Deferral::Later(refused)
    }

    /// The client has disconnected, or waits no longer. Requests that wait for their turn are not sent,
    /// except broadcasts to unit id 0, which have no reply to wait for. Returns the others, whose replies
    /// still come.
    pub(in crate::server) fn give_up(&mut self, has_broadcasts: bool) -> VecDeque<Waiting> {
        for Waiting { asked, reply, .. } in &self.waiting {
            if let Expected::Pending(pending) = reply
                && !(has_broadcasts && asked.unit_id == 0)
            {
                pending.give_up();
            }
        }
        self.behind = Vec::new();
        std::mem::take(&mut self.waiting)
    }

    /// Takes the requests that are not on their way yet, as frames with an MBAP header.
    pub(in crate::server) fn resume(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.behind)
    }

    /// The next reply, once it is there, and how often it is sent.
    pub(in crate::server) fn poll_next(
        &mut self,
        unit_server: &UnitServer,
        context: &mut Context<'_>,
    ) -> Poll<(Asked, Reply, usize)> {
        let Some(first) = self.waiting.front_mut() else { return Poll::Pending };
        let reply = match &mut first.reply {
            Expected::Known(reply) => std::mem::take(reply),
            Expected::Pending(pending) => match Pin::new(pending).poll(context) {
                Poll::Ready(reply) => first.asked.count(unit_server, reply.ok()),
                Poll::Pending => return Poll::Pending,
            },
        };
        let first = self.waiting.pop_front().expect("there is a first request");
        Poll::Ready((first.asked, reply, first.times))
    }
}

impl Waiting {
    /// Waits for the reply. `None` if the request was not sent.
    pub(in crate::server) async fn complete(
        self,
        unit_server: &UnitServer,
    ) -> Option<(Asked, Reply)> {
        let reply = match self.reply {
            Expected::Known(reply) => reply,
            Expected::Pending(pending) => self.asked.count(unit_server, Some(pending.await.ok()?)),
        };
        Some((self.asked, reply))
    }
}

impl Asked {
    /// Sends a request on its way by `forward`, which asks for a permit before. It may be refused at once.
    pub(in crate::server) fn send(
        context: &ListenerContext,
        destination: &RequestDestination,
        (tag, unit_id, request): (u16, u8, &[u8]),
        forward: impl FnOnce(
            &mut dyn FnMut() -> bool,
        ) -> Result<(Option<Arc<str>>, PendingReply), ExceptionCode>,
    ) -> (Asked, Expected, Option<RefusedRequest>) {
        let mut permit = None;
        let sent = forward(&mut || {
            permit = context.permit_forwarded(request);
            permit.is_some()
        });
        let permit = permit.filter(|_| sent.is_ok());
        let refused = RefusedRequest::before_sending(destination, unit_id, request, &sent);
        let (route, reply) = match sent {
            Ok((route, pending)) => (route, Expected::Pending(pending)),
            Err(code) => {
                let pdu = exception(request, code.code());
                (None, Expected::Known(Reply { pdu, ..Reply::default() }))
            }
        };
        let memory = destination.memory().and_then(Memory::name).cloned();
        (Asked { tag, unit_id, memory, route, request: request.to_vec(), permit }, reply, refused)
    }

    /// Waits for the reply, and counts and records it: in a task of its own, which goes on if the caller does not.
    /// A caller that drops the result has given up: a request that waits for its turn is not sent. The engine waits
    /// until `running` is dropped.
    pub(in crate::server) fn answered(
        self,
        pending: PendingReply,
        (unit_server, context): (Arc<UnitServer>, Arc<ListenerContext>),
        peer: Option<Peer>,
        running: watch::Receiver<bool>,
    ) -> impl Future<Output = Reply> + use<> {
        let gives_up = pending.give_up_on_drop();
        let answering = tokio::spawn(async move {
            let reply = self.count(&unit_server, pending.await.ok());
            self.record(&context, peer.as_ref(), &reply);
            drop(running);
            reply
        });
        async move {
            let _gives_up = gives_up;
            answering.await.unwrap_or_default()
        }
    }

    /// Counts the reply, and returns it. `None` means that the link has ended.
    pub(in crate::server) fn count(&self, unit_server: &UnitServer, reply: Option<Reply>) -> Reply {
        let ended = || exception(&self.request, ExceptionCode::GatewayPathUnavailable.code());
        let reply = reply.unwrap_or_else(|| Reply { pdu: ended(), ..Reply::default() });
        unit_server.forwarded(&self.request, &reply.pdu);
        reply
    }

    /// Records the request with its reply.
    pub(in crate::server) fn record(
        self,
        context: &ListenerContext,
        peer: Option<&Peer>,
        reply: &Reply,
    ) {
        if let Some(auditor) = &context.auditor {
            let forwarded = Forwarded {
                memory: self.memory.as_ref(),
                route: self.route.as_ref(),
                request: &self.request,
                reply: &reply.pdu,
                log_sequence: reply.log_sequence,
            };
            auditor.note_forwarded(&context.name, peer, self.unit_id, forwarded, self.permit);
        }
    }
}
