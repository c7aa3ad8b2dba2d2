//! Fair shares of a worker thread among the sources of its connections: deficit round robin.
//!
//! A source that has used its share of a round waits until the next one, which begins as soon as all
//! others that had something to do were served. There is no limit and no time: while no other source waits,
//! rounds follow each other immediately, and a source that is alone has no rounds at all.
//!
//! A source is an address. All its connections on the worker share what it has, in the order in which
//! they began to wait.

use std::cell::RefCell;
use std::collections::{HashMap, VecDeque};
use std::future::poll_fn;
use std::net::IpAddr;
use std::task::{Context, Poll, Waker};

use tokio::task::yield_now;

use crate::server::connections::peer::Peer;

/// The work of one source in a round. A read of a socket that brings one request is about a sixteenth of
/// it: so much takes about 100 µs.
const WORK_PER_ROUND: i64 = 1024;

/// The work of one read of a socket, and of the write that answers it. It takes as long as answering so
/// many requests that arrive together.
pub(crate) const WORK_OF_READ: u32 = 64;

/// The bytes of a long packet that take as long as a request.
const BYTES_PER_WORK: usize = 256;

/// The most short packets of one source in a round.
#[cfg(test)]
pub(crate) const PACKETS_PER_ROUND: u16 = (WORK_PER_ROUND / WORK_OF_READ as i64) as u16;

thread_local! {
    static WORKER: RefCell<Worker> = RefCell::default();
}

/// The work of a read that brings a packet of this length.
pub(crate) fn packet(len: usize) -> u32 {
    WORK_OF_READ + u32::try_from(len / BYTES_PER_WORK).unwrap_or(u32::MAX)
}

/// The sources with connections on one worker thread.
#[derive(Debug, Default)]
struct Worker {
    places: HashMap<IpAddr, usize>,
    sources: Vec<Source>,
    free: Vec<usize>,
    /// Those with connections that wait, and some that had.
    waiting: Vec<usize>,
    round: u64,
    /// Whether a task begins the next round.
    has_rounds: bool,
}

#[derive(Debug)]
struct Source {
    address: IpAddr,
    connections: usize,
    /// The work that is left in `round`. Negative: more was done than that, which the next rounds pay.
    left: i64,
    round: u64,
    /// Connections that wait, by number, in order.
    queue: VecDeque<(u64, Waker)>,
    /// Whether it is among those of the worker that wait.
    is_listed: bool,
    /// The number of the next connection that has to wait.
    next: u64,
    /// Connections with lower numbers have waited long enough.
    called: u64,
}

/// The share of a connection. It stays on the thread where it was made.
#[derive(Debug)]
pub(crate) struct Share {
    place: usize,
    /// The number of this connection among those that wait.
    number: Option<u64>,
}

impl Share {
    pub(crate) fn of(peer: &Peer) -> Share {
        let place = WORKER.with_borrow_mut(|worker| worker.join(peer.ip()));
        Share { place, number: None }
    }

    /// Whether the connection waits for the next round.
    #[inline]
    pub(crate) fn is_waiting(&self) -> bool {
        self.number.is_some()
    }

    /// Ready when the connection may work. After it has done so, it calls `pass_on`.
    #[inline]
    pub(crate) fn poll(&mut self, context: &mut Context<'_>) -> Poll<()> {
        WORKER.with_borrow_mut(|worker| worker.poll(self, context))
    }

    /// Notes work that was done.
    #[inline]
    pub(crate) fn charge(&self, work: u32) {
        WORKER.with_borrow_mut(|worker| worker.charge(self.place, work));
    }

    /// Lets the next connection of the source go on, if this one has waited.
    #[inline]
    pub(crate) fn pass_on(&mut self) {
        if self.number.take().is_some() {
            WORKER.with_borrow_mut(|worker| worker.sources[self.place].call());
        }
    }

    /// Waits until the connection may work.
    pub(crate) async fn come(&mut self) {
        poll_fn(|context| self.poll(context)).await;
        self.pass_on();
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        // At the end of the thread there may be no table any more.
        let _ = WORKER.try_with(|worker| worker.borrow_mut().leave(self));
    }
}

impl Worker {
    fn join(&mut self, address: IpAddr) -> usize {
        if let Some(place) = self.places.get(&address) {
            self.sources[*place].connections += 1;
            return *place;
        }
        let source = Source {
            address,
            connections: 1,
            left: WORK_PER_ROUND,
            round: self.round,
            queue: VecDeque::new(),
            is_listed: false,
            next: 0,
            called: 0,
        };
        let place = match self.free.pop() {
            Some(place) => {
                self.sources[place] = source;
                place
            }
            None => {
                self.sources.push(source);
                self.sources.len() - 1
            }
        };
        self.places.insert(address, place);
        place
    }

    fn leave(&mut self, share: &Share) {
        let source = &mut self.sources[share.place];
        source.connections -= 1;
        if let Some(number) = share.number {
            source.queue.retain(|(other, _)| *other != number);
            // It may have been called, and is not going to call the next one.
            source.call();
        }
        if source.connections == 0 {
            debug_assert!(source.queue.is_empty(), "a connection waits that does not exist");
            self.places.remove(&source.address);
            self.free.push(share.place);
            self.waiting.retain(|place| *place != share.place);
            if self.places.len() == 1 {
                self.sources.iter_mut().for_each(Source::call_all);
            }
        }
    }

    #[inline]
    fn poll(&mut self, share: &mut Share, context: &mut Context<'_>) -> Poll<()> {
        let source = &mut self.sources[share.place];
        match share.number {
            Some(number) if number < source.called => Poll::Ready(()),
            // The task of a connection has the same waker all the time.
            Some(_) => Poll::Pending,
            None if self.places.len() == 1 => Poll::Ready(()),
            None => self.poll_among_others(share, context),
        }
    }

    // Inlined, a source that is alone would save the registers for it.
    #[inline(never)]
    fn poll_among_others(&mut self, share: &mut Share, context: &mut Context<'_>) -> Poll<()> {
        let source = &mut self.sources[share.place];
        source.replenish(self.round);
        if source.left > 0 && source.queue.is_empty() {
            return Poll::Ready(());
        }
        if !source.is_listed {
            source.is_listed = true;
            self.waiting.push(share.place);
        }
        share.number = Some(source.next);
        source.queue.push_back((source.next, context.waker().clone()));
        source.next += 1;
        if !self.has_rounds {
            self.has_rounds = true;
            tokio::spawn(rounds());
        }
        Poll::Pending
    }

    #[inline]
    fn charge(&mut self, place: usize, work: u32) {
        if self.places.len() > 1 {
            let source = &mut self.sources[place];
            source.replenish(self.round);
            source.left -= i64::from(work);
        }
    }

    /// Begins a round. Returns whether there is a next one.
    fn begin_round(&mut self) -> bool {
        self.round += 1;
        let Worker { waiting, sources, round, .. } = self;
        waiting.retain(|place| {
            let source = &mut sources[*place];
            source.replenish(*round);
            // One that was called in the last round, and does something else, does not hold up the others.
            source.call();
            source.is_listed = !source.queue.is_empty();
            source.is_listed
        });
        !self.waiting.is_empty()
    }
}

impl Source {
    /// Adds the work of the rounds that have begun. What is not used in a round is not kept.
    fn replenish(&mut self, round: u64) {
        let rounds = i64::try_from(round - self.round).unwrap_or(i64::MAX);
        self.left =
            self.left.saturating_add(rounds.saturating_mul(WORK_PER_ROUND)).min(WORK_PER_ROUND);
        self.round = round;
    }

    /// Lets the connection go on that has waited longest, if there is work left for it.
    fn call(&mut self) {
        if self.left > 0
            && let Some((number, waker)) = self.queue.pop_front()
        {
            self.called = number + 1;
            waker.wake();
        }
    }

    fn call_all(&mut self) {
        self.called = self.next;
        self.queue.drain(..).for_each(|(_, waker)| waker.wake());
    }
}

/// Begins rounds while a connection waits. Others that have something to do run before each of them: the
/// runtime looks for new input before it continues a task that yields.
async fn rounds() {
    let _end = End;
    loop {
        yield_now().await;
        if !WORKER.with_borrow_mut(Worker::begin_round) {
            return;
        }
    }
}

/// The end of the task that begins rounds, also when its runtime ends.
struct End;

impl Drop for End {
    fn drop(&mut self) {
        let _ = WORKER.try_with(|worker| worker.borrow_mut().has_rounds = false);
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;
    use std::sync::{Arc, Mutex};

    use proptest::prelude::*;
    use tokio::runtime::Builder;
    use tokio::task::{JoinHandle, JoinSet};

    use super::*;

    fn address(last: u8) -> Peer {
        Peer::from(SocketAddr::from(([192, 0, 2, last], 1)))
    }

    /// The sources in the order in which they worked: the last byte of each address.
    type Log = Arc<Mutex<Vec<u8>>>;

    /// A connection that never waits for its peer.
    fn flood(last: u8, steps: usize, work: u32, log: &Log) -> JoinHandle<()> {
        let (log, mut share) = (Arc::clone(log), Share::of(&address(last)));
        tokio::spawn(async move {
            for _ in 0..steps {
                share.come().await;
                log.lock().unwrap().push(last);
                share.charge(work);
            }
        })
    }

    /// A connection whose next request comes when the runtime has looked for input.
    fn polite(last: u8, steps: usize, log: &Log) -> JoinHandle<()> {
        let (log, mut share) = (Arc::clone(log), Share::of(&address(last)));
        tokio::spawn(async move {
            for _ in 0..steps {
                yield_now().await;
                share.come().await;
                log.lock().unwrap().push(last);
                share.charge(WORK_OF_READ + 1);
            }
        })
    }

    fn run(tasks: impl FnOnce(&Log) -> Vec<JoinHandle<()>>) -> Vec<u8> {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        let log = Log::default();
        runtime.block_on(async {
            for task in tasks(&log) {
                task.await.unwrap();
            }
        });
        WORKER.with_borrow(|worker| assert_eq!(worker.places.len(), 0));
        let log = log.lock().unwrap();
        log.clone()
    }

    /// The steps of others before each step of one.
    fn before_each(log: &[u8], one: u8) -> Vec<usize> {
        let mut parts: Vec<usize> = log.split(|last| *last == one).map(<[u8]>::len).collect();
        parts.pop();
        parts
    }

    #[test]
    fn others_work_at_most_one_share_between_two_requests() {
        for connections in [1, 64] {
            let work = WORK_OF_READ + 16;
            let log = run(|log| {
                let mut tasks: Vec<_> =
                    (0..connections).map(|_| flood(1, 6400 / connections, work, log)).collect();
                tasks.push(polite(2, 100, log));
                tasks
            });
            assert_eq!(log.len(), 6500, "everything is done");
            let most = WORK_PER_ROUND as usize / work as usize + 1;
            let before = before_each(&log, 2);
            // A request that comes in the middle of a round may wait for the rest of it and, if its own
            // source has used its share, for the next.
            assert!(before.iter().all(|steps| *steps <= 2 * most), "{before:?}");
        }
    }

    #[test]
    fn sources_that_never_pause_get_the_same_however_many_connections_they_have() {
        let log = run(|log| {
            let mut tasks: Vec<_> = (0..32).map(|_| flood(1, 100, WORK_OF_READ, log)).collect();
            tasks.push(flood(2, 1000, WORK_OF_READ, log));
            tasks
        });
        let end = log.iter().rposition(|last| *last == 2).unwrap();
        let others = log[..end].iter().filter(|last| **last == 1).count();
        assert!(others <= 1000 + 2 * WORK_PER_ROUND as usize / WORK_OF_READ as usize, "{others}");
    }

    #[test]
    fn connections_of_a_source_take_turns() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let _other = Share::of(&address(2));
            let order = Log::default();
            let mut tasks = JoinSet::new();
            for number in 0..8 {
                let (order, mut share) = (Arc::clone(&order), Share::of(&address(1)));
                tasks.spawn(async move {
                    for _ in 0..10 {
                        share.come().await;
                        order.lock().unwrap().push(number);
                        share.charge(WORK_PER_ROUND as u32);
                    }
                });
            }
            while tasks.join_next().await.is_some() {}
            let order = order.lock().unwrap();
            // The first one works before the others begin to wait.
            for turn in order[1..].chunks_exact(8) {
                assert_eq!(turn, [0, 1, 2, 3, 4, 5, 6, 7]);
            }
        });
    }

    #[test]
    fn a_source_that_is_alone_never_waits() {
        let mut shares = [1, 1].map(|last| Share::of(&address(last)));
        let mut context = Context::from_waker(Waker::noop());
        for _ in 0..1000 {
            for share in &mut shares {
                assert!(share.poll(&mut context).is_ready());
                share.pass_on();
                share.charge(WORK_PER_ROUND as u32);
            }
        }
        assert!(!WORKER.with_borrow(|worker| worker.has_rounds));
    }

    #[test]
    fn nobody_waits_for_a_source_that_has_left() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let other = Share::of(&address(2));
            let mut shares = [1; 3].map(|last| Share::of(&address(last)));
            shares[0].charge(100 * WORK_PER_ROUND as u32);
            let mut context = Context::from_waker(Waker::noop());
            assert!(shares.iter_mut().all(|share| share.poll(&mut context).is_pending()));
            drop(other);
            assert!(shares.iter_mut().all(|share| share.poll(&mut context).is_ready()));
        });
    }

    #[test]
    fn work_above_a_share_is_paid_in_the_next_rounds() {
        let mut worker = Worker::default();
        let place = worker.join(address(1).ip());
        worker.join(address(2).ip());
        worker.charge(place, 3 * WORK_PER_ROUND as u32 + 1);
        for left in [
            -2 * WORK_PER_ROUND - 1,
            -WORK_PER_ROUND - 1,
            -1,
            WORK_PER_ROUND - 1,
            WORK_PER_ROUND,
            WORK_PER_ROUND,
        ] {
            worker.sources[place].replenish(worker.round);
            assert_eq!(worker.sources[place].left, left);
            worker.begin_round();
        }
    }

    #[test]
    fn ipv4_addresses_within_ipv6_are_the_same_source() {
        let shares = ["192.0.2.1:1", "[::ffff:192.0.2.1]:2"]
            .map(|at| Share::of(&Peer::from(at.parse::<SocketAddr>().unwrap())));
        assert_eq!(shares[0].place, shares[1].place);
    }

    proptest! {
        /// Connections come, work, wait for their peers and end in any order: every one ends.
        #[test]
        fn no_connection_waits_for_ever(
            connections in prop::collection::vec((0_u8..4, 0_usize..20, 0_u32..3000, any::<bool>(), any::<bool>()), 1..40)
        ) {
            let runtime = Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let mut tasks = JoinSet::new();
                for (last, steps, work, pauses, is_dropped) in connections {
                    let mut share = Share::of(&address(last));
                    tasks.spawn(async move {
                        for _ in 0..steps {
                            share.come().await;
                            share.charge(work);
                            if pauses {
                                yield_now().await;
                            }
                        }
                        if is_dropped {
                            // It ends while it waits, or just when it was called.
                            tokio::select! {
                                biased;
                                () = share.come() => {}
                                () = yield_now() => {}
                            }
                        }
                    });
                }
                while let Some(ended) = tasks.join_next().await {
                    ended.unwrap();
                }
            });
            WORKER.with_borrow(|worker| {
                prop_assert_eq!(worker.places.len(), 0);
                prop_assert!(worker.waiting.is_empty());
                Ok(())
            })?;
        }
    }
}
