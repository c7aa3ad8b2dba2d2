//! How much of the queue of a link one source may fill: no more than it leaves to others. All event loops
//! together are one source.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The requests that wait or are in flight, without those of the poller.
#[derive(Debug)]
pub(in crate::link) struct QueueShare {
    most: usize,
    waiting: AtomicUsize,
    /// Requests of event loops among those.
    of_event_loops: AtomicUsize,
}

/// A place in the queue, until it is dropped.
pub(in crate::link) struct Place {
    queue: Arc<QueueShare>,
    is_of_event_loop: bool,
}

impl QueueShare {
    pub(in crate::link) fn new(most: usize) -> Arc<QueueShare> {
        let (waiting, of_event_loops) = (AtomicUsize::new(0), AtomicUsize::new(0));
        Arc::new(QueueShare { most, waiting, of_event_loops })
    }

    pub(in crate::link) fn waiting(&self) -> usize {
        self.waiting.load(Ordering::Relaxed)
    }

    /// A place for a request of an event loop, unless the queue is full for them.
    pub(in crate::link) fn place_of_event_loop(self: &Arc<QueueShare>) -> Option<Place> {
        let own = self.of_event_loops.fetch_add(1, Ordering::Relaxed);
        self.place_beside(own, true)
    }

    /// A place for a request of a source that has so many others here, unless the queue is full for it.
    pub(in crate::link) fn place(self: &Arc<QueueShare>, own: usize) -> Option<Place> {
        self.place_beside(own, false)
    }

    fn place_beside(self: &Arc<QueueShare>, own: usize, is_of_event_loop: bool) -> Option<Place> {
        let before = self.waiting.fetch_add(1, Ordering::Relaxed);
        let place = Place { queue: Arc::clone(self), is_of_event_loop };
        (self.most.saturating_sub(before) > own).then_some(place)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.queue.waiting.fetch_sub(1, Ordering::Relaxed);
        self.queue.of_event_loops.fetch_sub(usize::from(self.is_of_event_loop), Ordering::Relaxed);
    }
}
