//! One request and its response, between the thread of its connection and the thread of its handler.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::task::{Context, Poll, Waker};

use bytes::Bytes;
use holdfast_runtime::lock;
use hyper::header::{CONTENT_LENGTH, HeaderName, HeaderValue};
use hyper::http::request::Parts;
use hyper::{HeaderMap, StatusCode};

use super::inbox::Inbox;
use crate::server::Peer;

/// A request without its body.
#[derive(Debug)]
pub struct RequestHead {
    pub parts: Parts,
    pub peer: Peer,
    /// The length of the body, if the head says it.
    pub len: Option<u64>,
}

/// A response without its body.
#[derive(Debug)]
pub struct ResponseHead {
    pub status: StatusCode,
    pub headers: HeaderMap,
}

impl ResponseHead {
    /// # Errors
    /// The name or value of a header, or the status, is invalid.
    pub fn new<'a>(
        status: u16,
        headers: impl Iterator<Item = (&'a [u8], &'a [u8])>,
    ) -> Result<ResponseHead, hyper::http::Error> {
        let mut head =
            ResponseHead { status: StatusCode::from_u16(status)?, headers: HeaderMap::new() };
        for (name, value) in headers {
            let name = HeaderName::from_bytes(name)?;
            head.headers.append(name, HeaderValue::from_bytes(value)?);
        }
        Ok(head)
    }
}

/// What a handler asks of the connection.
#[derive(Debug)]
pub(super) enum Order {
    /// The body of the request, of at most this many bytes.
    Receive(usize),
    /// To answer with this response. The connection ends after it if `closes`.
    Respond { head: ResponseHead, body: Bytes, closes: bool },
    /// To answer with a stream.
    Begin(ResponseHead),
    /// Nothing more: there will be no response.
    Abandon,
    /// From the connection itself: the rest of the request did not arrive in time.
    Late,
}

/// What happened to a request. Later events name it by its number.
#[derive(Debug)]
pub enum Event {
    /// A request, with its body if all of it has arrived.
    Request { exchange: Arc<Exchange>, head: Box<RequestHead>, body: Option<Bytes> },
    /// The body that the handler has asked for.
    Body { number: u64, body: Bytes },
    /// The body is longer than the handler allows.
    TooLarge { number: u64 },
    /// The body has not arrived in time. This many bytes of it have.
    Late { number: u64, received: usize },
    /// The body is not HTTP.
    Broken { number: u64 },
    /// The client is gone, before it had its response.
    Gone { number: u64 },
    /// The socket has taken the data before: the stream has room.
    Room { number: u64 },
}

/// The bytes of a connection, for any thread.
pub(super) trait LooksForEnd: Send {
    /// Reads ahead. Returns whether the client sends no more.
    fn look_for_end(&mut self) -> bool;
}

pub(super) type WeakConnection = Weak<Mutex<dyn LooksForEnd>>;

#[derive(Debug)]
pub struct Exchange {
    pub number: u64,
    inbox: Arc<Inbox<Event>>,
    connection: WeakConnection,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    orders: VecDeque<Order>,
    /// Data of a stream that hyper has not taken.
    data: Option<Bytes>,
    /// Whether hyper has taken data that the socket has not.
    is_unsent: bool,
    /// Whether the handler waits for room.
    is_awaited: bool,
    /// Whether the stream is complete, once it has ended.
    end: Option<bool>,
    /// Whether a peer that sends no more is gone.
    leaves: bool,
    /// Whether the connection has ended, or has sent the response.
    is_over: bool,
    waker: Option<Waker>,
}

/// The result of sending data of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sent {
    Taken,
    /// The data before is not sent yet: `Event::Room` reports when it is.
    Full,
    /// The client is gone.
    Gone,
}

impl Exchange {
    pub(super) fn new(
        number: u64,
        inbox: Arc<Inbox<Event>>,
        connection: WeakConnection,
    ) -> Arc<Exchange> {
        Arc::new(Exchange { number, inbox, connection, state: Mutex::default() })
    }

    /// Asks for the body of the request.
    pub fn receive(&self, most: usize) {
        self.order(Order::Receive(most));
    }

    /// Answers the request, after the next [`super::HttpServer::flush`].
    pub fn respond(&self, mut head: ResponseHead, body: Bytes, closes: bool) {
        let has_body = !matches!(head.status, StatusCode::NO_CONTENT | StatusCode::NOT_MODIFIED);
        if has_body && !head.headers.contains_key(CONTENT_LENGTH) {
            head.headers.insert(CONTENT_LENGTH, HeaderValue::from(body.len()));
        }
        let mut state = lock(&self.state);
        state.orders.push_back(Order::Respond { head, body, closes });
        let waker = state.waker.take();
        drop(state);
        if let Some(waker) = waker {
            self.inbox.wake_later(waker);
        }
    }

    /// Whether the client is still there, by what the system has received until now: the thread of the connection
    /// may notice an end later, as after a standstill. From now on, a client that sends no more counts as gone: a
    /// full close looks the same.
    pub fn watch_client(&self) -> bool {
        lock(&self.state).leaves = true;
        let is_there = match self.connection.upgrade() {
            Some(connection) => !lock(&connection).look_for_end(),
            None => false,
        };
        let state = lock(&self.state);
        let is_there = is_there && !state.is_over;
        wake(state);
        is_there
    }

    /// Answers the request with a stream. From now on, a client that sends no more counts as gone: a
    /// stream may have no other end.
    pub fn begin(&self, head: ResponseHead) {
        lock(&self.state).leaves = true;
        self.order(Order::Begin(head));
    }

    /// Sends data of a stream.
    pub fn send(&self, data: Bytes) -> Sent {
        let mut state = lock(&self.state);
        if state.is_over {
            return Sent::Gone;
        }
        if state.data.is_some() || state.is_unsent {
            state.is_awaited = true;
            return Sent::Full;
        }
        state.data = Some(data);
        wake(state);
        Sent::Taken
    }

    /// Ends a stream. One that is not complete is cut off, so that its client notices.
    pub fn end(&self, is_complete: bool) {
        let mut state = lock(&self.state);
        state.end.get_or_insert(is_complete);
        wake(state);
    }

    /// There will be no response: the connection is cut off, unless there has been one.
    pub fn abandon(&self) {
        self.order(Order::Abandon);
    }

    pub(super) fn leaves(&self) -> bool {
        lock(&self.state).leaves
    }

    pub(super) fn order(&self, order: Order) {
        let mut state = lock(&self.state);
        state.orders.push_back(order);
        wake(state);
    }

    /// The next order of the handler.
    pub(super) async fn next(&self) -> Order {
        poll_fn(|context| {
            let mut state = lock(&self.state);
            match state.orders.pop_front() {
                Some(order) => Poll::Ready(order),
                None => {
                    state.waker = Some(context.waker().clone());
                    Poll::Pending
                }
            }
        })
        .await
    }

    pub(super) fn notify(&self, event: Event) {
        self.inbox.push(event);
    }

    /// The socket has taken all that hyper has.
    pub(super) fn flushed(&self) {
        let mut state = lock(&self.state);
        state.is_unsent = false;
        if state.is_awaited && state.data.is_none() {
            state.is_awaited = false;
            drop(state);
            self.notify(Event::Room { number: self.number });
        }
    }

    /// The connection is done with it. If the response is not complete, the client is gone.
    pub(super) fn finish(&self, is_complete: bool) {
        let mut state = lock(&self.state);
        if !std::mem::replace(&mut state.is_over, true) && !is_complete {
            drop(state);
            self.notify(Event::Gone { number: self.number });
        }
    }

    /// The next data of a stream.
    pub(super) fn poll_data(
        &self,
        context: &Context<'_>,
    ) -> Poll<Option<Result<Bytes, Abandoned>>> {
        let mut state = lock(&self.state);
        if let Some(data) = state.data.take() {
            state.is_unsent = true;
            return Poll::Ready(Some(Ok(data)));
        }
        // A handler may be dropped without `end`.
        let is_abandoned = matches!(state.orders.front(), Some(Order::Abandon));
        match state.end {
            Some(true) => return Poll::Ready(None),
            Some(false) => return Poll::Ready(Some(Err(Abandoned))),
            None if is_abandoned => return Poll::Ready(Some(Err(Abandoned))),
            None => {}
        }
        state.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

/// Wakes the task of the connection.
fn wake(mut state: MutexGuard<'_, State>) {
    let waker = state.waker.take();
    drop(state);
    if let Some(waker) = waker {
        waker.wake();
    }
}

/// The handler has left its request without a response, or with half of one.
#[derive(Debug, thiserror::Error)]
#[error("the response is cut off")]
pub(super) struct Abandoned;
