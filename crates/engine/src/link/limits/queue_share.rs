//! How much of the queue of a link one source may fill: no more than it leaves to others. All event loops
//! together are one source, and so are all connections from one address: a client can't get another share
//! by connecting again.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use holdfast_runtime::lock;

/// Who asks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(in crate::link) enum Source {
    EventLoops,
    SerialLines,
    Address(IpAddr),
}

/// The requests that wait or are in flight, without those of the poller.
#[derive(Debug)]
pub(in crate::link) struct QueueShare {
    most: usize,
    waiting: Mutex<Waiting>,
}

#[derive(Debug, Default)]
struct Waiting {
    all: usize,
    /// Those of each source that has any.
    by_source: HashMap<Source, usize>,
}

/// A place in the queue, until it is dropped.
pub(in crate::link) struct Place {
    queue: Arc<QueueShare>,
    source: Source,
}

impl Source {
    /// A client of a listener; `None` on a serial line.
    pub(in crate::link) fn client(peer: Option<IpAddr>) -> Source {
        peer.map_or(Source::SerialLines, |peer| Source::Address(peer.to_canonical()))
    }
}

impl QueueShare {
    pub(in crate::link) fn new(most: usize) -> Arc<QueueShare> {
        Arc::new(QueueShare { most, waiting: Mutex::default() })
    }

    pub(in crate::link) fn waiting(&self) -> usize {
        lock(&self.waiting).all
    }

    /// A place for a request, unless the queue is full for its source.
    pub(in crate::link) fn place(self: &Arc<QueueShare>, source: Source) -> Option<Place> {
        let mut waiting = lock(&self.waiting);
        let own = waiting.by_source.get(&source).copied().unwrap_or_default();
        if self.most.saturating_sub(waiting.all) <= own {
            return None;
        }
        waiting.all += 1;
        waiting.by_source.insert(source, own + 1);
        Some(Place { queue: Arc::clone(self), source })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut waiting = lock(&self.queue.waiting);
        waiting.all -= 1;
        let own =
            waiting.by_source.get_mut(&self.source).expect("a source with a place is counted");
        *own -= 1;
        if *own == 0 {
            waiting.by_source.remove(&self.source);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_leaves_places_to_others_however_often_it_connects() {
        let queue = QueueShare::new(8);
        let [one, other] = [1, 2].map(|last| Source::client(Some(IpAddr::from([127, 0, 0, last]))));
        let mut places: Vec<_> = (0..9).map_while(|_| queue.place(one)).collect();
        assert_eq!(places.len(), 4);
        places.extend(queue.place(other));
        places.extend(queue.place(Source::EventLoops));
        assert_eq!(queue.waiting(), 6);
        assert!(queue.place(one).is_none());
        places.clear();
        assert_eq!(queue.waiting(), 0);
        assert!(lock(&queue.waiting).by_source.is_empty());
    }
}
