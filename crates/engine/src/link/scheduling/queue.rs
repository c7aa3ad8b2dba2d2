//! Which request is next on a link: writes in the order of their arrival, then requests of preferred sources,
//! then all others. Sources of the same rank take turns, however many requests one of them has. A
//! rank that was skipped [`MAX_PASSED_OVER`] times is served next, so that no rank starves.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};

use holdfast_protocol::pdu::EncodedRequest;

/// How often a rank is skipped in favour of higher ones.
const MAX_PASSED_OVER: u32 = 4;

const RANKS: usize = 3;

/// Numbers the sources of requests. 0 is the poller.
static SOURCES: AtomicU64 = AtomicU64::new(1);

/// The number of a new source of requests.
pub(crate) fn new_source() -> u64 {
    SOURCES.fetch_add(1, Ordering::Relaxed)
}

/// How much a request matters beside others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Priority {
    Usual,
    /// To a unit that was silent the last time: it leaves room for the others.
    Doubtful,
    /// A read of a preferred source.
    Preferred,
    /// A request that may change a device, or a read that is a part of one.
    Urgent,
}

impl Priority {
    /// The priority of a request of `peer`: `None` on a serial line and for an event loop.
    pub(in crate::link) fn of(
        request: &EncodedRequest,
        peer: Option<IpAddr>,
        preferred: &[IpAddr],
    ) -> Priority {
        let is_preferred = |peer: IpAddr| preferred.contains(&peer.to_canonical());
        match peer {
            _ if !request.is_read() => Priority::Urgent,
            Some(peer) if !preferred.is_empty() && is_preferred(peer) => Priority::Preferred,
            _ => Priority::Usual,
        }
    }

    fn rank(self) -> usize {
        match self {
            Priority::Urgent => 0,
            Priority::Preferred => 1,
            Priority::Usual | Priority::Doubtful => 2,
        }
    }
}

/// Sources that take turns. Every source has at least one item.
type RoundRobin<T> = VecDeque<(u64, VecDeque<T>)>;

pub(in crate::link) struct Queue<T> {
    ranks: [RoundRobin<T>; RANKS],
    passed_over: [u32; RANKS],
}

impl<T> Default for Queue<T> {
    fn default() -> Queue<T> {
        Queue { ranks: Default::default(), passed_over: [0; RANKS] }
    }
}

impl<T> Queue<T> {
    /// Items of the source that are not `awaited` any more may be dropped.
    pub(in crate::link) fn push(
        &mut self,
        source: u64,
        priority: Priority,
        item: T,
        awaited: impl Fn(&T) -> bool,
    ) {
        // Writes go in the order of their arrival: as if all came from one source.
        let source = if priority == Priority::Urgent { 0 } else { source };
        let sources = &mut self.ranks[priority.rank()];
        match sources.iter_mut().find(|(other, _)| *other == source) {
            Some((_, items)) => {
                if items.len() == items.capacity() {
                    items.retain(awaited);
                    // Room for as many more: they are not looked at for each item.
                    items.reserve(items.len() + 1);
                }
                items.push_back(item);
            }
            None => sources.push_back((source, VecDeque::from([item]))),
        }
    }

    pub(in crate::link) fn pop(&mut self) -> Option<T> {
        let waits = |rank: &usize| !self.ranks[*rank].is_empty();
        let starved = |rank: &usize| self.passed_over[*rank] >= MAX_PASSED_OVER;
        let next = (0..RANKS).filter(waits).find(starved).or((0..RANKS).find(waits))?;
        for lower in (next + 1..RANKS).filter(|rank| !self.ranks[*rank].is_empty()) {
            self.passed_over[lower] += 1;
        }
        self.passed_over[next] = 0;
        let sources = &mut self.ranks[next];
        let (source, mut items) = sources.pop_front()?;
        let item = items.pop_front();
        if !items.is_empty() {
            sources.push_back((source, items));
        }
        item
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn all(queue: &mut Queue<&'static str>) -> Vec<&'static str> {
        std::iter::from_fn(|| queue.pop()).collect()
    }

    #[test]
    fn sources_take_turns() {
        let mut queue = Queue::default();
        for (source, item) in [(1, "a1"), (1, "a2"), (1, "a3"), (2, "b1"), (3, "c1"), (2, "b2")] {
            queue.push(source, Priority::Usual, item, |_| true);
        }
        assert_eq!(all(&mut queue), ["a1", "b1", "c1", "a2", "b2", "a3"]);
    }

    #[test]
    fn writes_go_first_in_the_order_of_their_arrival() {
        let mut queue = Queue::default();
        queue.push(1, Priority::Usual, "read", |_| true);
        queue.push(2, Priority::Preferred, "preferred read", |_| true);
        for (source, item) in [(1, "w1"), (1, "w2"), (2, "w3")] {
            queue.push(source, Priority::Urgent, item, |_| true);
        }
        assert_eq!(all(&mut queue), ["w1", "w2", "w3", "preferred read", "read"]);
    }

    #[test]
    fn no_rank_starves() {
        let mut queue = Queue::default();
        queue.push(1, Priority::Usual, "read", |_| true);
        queue.push(2, Priority::Preferred, "preferred read", |_| true);
        for _ in 0..20 {
            queue.push(3, Priority::Urgent, "write", |_| true);
        }
        let order = all(&mut queue);
        assert_eq!(order.iter().position(|item| *item == "preferred read"), Some(4));
        assert_eq!(order.iter().position(|item| *item == "read"), Some(5));
    }

    #[test]
    fn items_that_nobody_waits_for_do_not_add_up() {
        let mut queue = Queue::default();
        for item in 0..1000 {
            queue.push(1, Priority::Usual, item, |waiting| item - waiting < 10);
        }
        let (_, items) = &queue.ranks[Priority::Usual.rank()][0];
        assert!(items.len() < 100);
        assert!((990..1000).all(|item| items.contains(&item)));
    }

    proptest! {
        #[test]
        fn nothing_is_lost_and_each_source_keeps_its_order(
            pushed in prop::collection::vec((0u64..5, 0usize..3, any::<bool>()), 0..200)
        ) {
            let ranks = [Priority::Usual, Priority::Preferred, Priority::Urgent];
            let mut queue = Queue::default();
            let mut popped = Vec::new();
            for (number, (source, rank, pop)) in pushed.iter().enumerate() {
                queue.push(*source, ranks[*rank], (*source, *rank, number), |_| true);
                popped.extend(pop.then(|| queue.pop()).flatten());
            }
            popped.extend(std::iter::from_fn(|| queue.pop()));
            prop_assert_eq!(popped.len(), pushed.len());
            for source in 0..5 {
                for rank in 0..3 {
                    let of = |each: &&(u64, usize, usize)| (each.0, each.1) == (source, rank);
                    prop_assert!(popped.iter().filter(of).is_sorted_by_key(|each| each.2));
                }
            }
        }
    }
}
