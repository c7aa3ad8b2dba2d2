//! What happens in the thread of a server, for an event loop in another thread.
//!
//! Whoever reports never waits for the event loop: events wait in a queue, and a byte in a socket wakes
//! the event loop when the queue was empty.

use std::io::{self, Write};
use std::mem;
use std::sync::{Mutex, PoisonError};

use crate::wake::{Wakes, pair};

#[derive(Debug)]
pub(super) struct Inbox<Event> {
    events: Mutex<Vec<Event>>,
    wake: Wakes,
}

impl<Event> Inbox<Event> {
    /// The second result becomes readable when there are events.
    pub(super) fn new() -> io::Result<(Inbox<Event>, Wakes)> {
        let (wake, wakes) = pair()?;
        Ok((Inbox { events: Mutex::default(), wake }, wakes))
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

    /// Takes all events.
    pub(super) fn take(&self) -> Vec<Event> {
        mem::take(&mut *self.events.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
