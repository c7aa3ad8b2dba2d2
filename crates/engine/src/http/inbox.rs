//! What happens in the thread of a server, for an event loop in another thread.
//!
//! Whoever reports never waits for the event loop: events wait in a queue, and a byte in a socket wakes
//! the event loop when the queue was empty.

use std::io::{self, Write};
use std::mem;
use std::sync::Mutex;
use std::task::Waker;

use holdfast_runtime::lock;
use tokio::sync::Notify;
use tokio::task::yield_now;

use crate::wake::{Wakes, pair};

#[derive(Debug)]
pub(super) struct Inbox<Event> {
    events: Mutex<Vec<Event>>,
    wake: Wakes,
    /// Tasks of connections that have a response. Waking their thread for each response costs more than
    /// the response, so they are woken together.
    answered: Mutex<Vec<Waker>>,
    has_answered: Notify,
    has_events: Notify,
}

impl<Event> Inbox<Event> {
    /// The second result becomes readable when there are events.
    pub(super) fn new() -> io::Result<(Inbox<Event>, Wakes)> {
        let (wake, wakes) = pair()?;
        let inbox = Inbox {
            events: Mutex::default(),
            wake,
            answered: Mutex::default(),
            has_answered: Notify::new(),
            has_events: Notify::new(),
        };
        Ok((inbox, wakes))
    }

    pub(super) fn push(&self, event: Event) {
        let mut events = lock(&self.events);
        let was_empty = events.is_empty();
        events.push(event);
        drop(events);
        if was_empty {
            self.wake();
        }
    }

    /// Wakes the event loop soon.
    pub(super) fn wake(&self) {
        self.has_events.notify_one();
    }

    /// Wakes a task that has a response, after the next `flush`.
    pub(super) fn wake_later(&self, task: Waker) {
        lock(&self.answered).push(task);
    }

    pub(super) fn flush(&self) {
        self.has_answered.notify_one();
    }

    /// Wakes the event loop for events, and tasks for their responses. Runs in the thread of the tasks,
    /// behind those that are ready: so each side wakes the other once for all that it has.
    pub(super) async fn deliver(&self) {
        loop {
            tokio::select! {
                () = self.has_answered.notified() => {
                    let mut answered = lock(&self.answered);
                    mem::take(&mut *answered).into_iter().for_each(Waker::wake);
                }
                () = self.has_events.notified() => {
                    yield_now().await;
                    // A full socket wakes the event loop too, and a closed one has no event loop.
                    let _ = (&self.wake).write(&[0]);
                }
            }
        }
    }

    /// Takes all events.
    pub(super) fn take(&self) -> Vec<Event> {
        mem::take(&mut *lock(&self.events))
    }
}
