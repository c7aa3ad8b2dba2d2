//! What happens to requests, for an event loop in another thread.
//!
//! Whoever reports never waits for the event loop: events wait in a queue, and a byte in a socket wakes
//! the event loop when the queue was empty.

use std::io::{self, Write};
use std::mem;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use tokio::sync::Notify;

use super::exchange::{Exchange, RequestHead};
use crate::wake::{Wakes, pair};

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
    /// The client has taken the data before: the stream has room.
    Room { number: u64 },
}

#[derive(Debug)]
pub(super) struct Inbox {
    events: Mutex<Vec<Event>>,
    wake: Wakes,
    /// Exchanges with a response that their connections do not know of yet. Waking another thread for each
    /// response costs more than the response: a batch is handed over at once.
    answered: Mutex<Vec<Arc<Exchange>>>,
    has_answered: Notify,
}

impl Inbox {
    /// The second result becomes readable when there are events.
    pub(super) fn new() -> io::Result<(Inbox, Wakes)> {
        let (wake, wakes) = pair()?;
        let (answered, has_answered) = (Mutex::default(), Notify::new());
        Ok((Inbox { events: Mutex::default(), wake, answered, has_answered }, wakes))
    }

    pub(super) fn push(&self, event: Event) {
        let mut events = self.events.lock().unwrap_or_else(PoisonError::into_inner);
        let was_empty = events.is_empty();
        events.push(event);
        drop(events);
        if was_empty {
            self.wake();
        }
    }

    /// Wakes the event loop.
    pub(super) fn wake(&self) {
        // A full socket wakes the event loop too, and a closed one has no event loop.
        let _ = (&self.wake).write(&[0]);
    }

    /// Notes a response. It is sent after the next `flush`.
    pub(super) fn note_answered(&self, exchange: Arc<Exchange>) {
        self.answered.lock().unwrap_or_else(PoisonError::into_inner).push(exchange);
    }

    pub(super) fn flush(&self) {
        self.has_answered.notify_one();
    }

    /// Tells connections of their responses. Runs in their thread, so that it is woken once for many.
    pub(super) async fn deliver(&self) {
        loop {
            self.has_answered.notified().await;
            let answered =
                mem::take(&mut *self.answered.lock().unwrap_or_else(PoisonError::into_inner));
            answered.iter().for_each(|exchange| exchange.wake());
        }
    }

    /// Takes all events.
    pub(super) fn take(&self) -> Vec<Event> {
        mem::take(&mut *self.events.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
