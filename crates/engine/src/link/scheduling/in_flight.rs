//! How many requests are in flight on a link.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::time::Duration;

use holdfast_protocol::client::Failure;
use holdfast_protocol::pdu::ExceptionCode;
use tokio::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard, Semaphore, SemaphorePermit, oneshot};
use tokio::time::Instant;

use crate::link::scheduling::queue::{Priority, Queue};

/// The most requests that `auto` has in flight.
const MAX_AUTO_IN_FLIGHT: usize = 16;

/// Answers after which `auto` judges how many are in flight.
const ANSWERS_PER_DECISION: usize = 20;

/// Round trips may take so many times as long as that of a single request before the device is assumed
/// to answer one request after the other.
const MAX_FLAT_RATIO: f64 = 1.25;

/// `auto` tries more requests in flight again after this time.
const RETRY_AFTER: Duration = Duration::from_secs(300);

/// How many requests may be in flight on a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InFlight {
    Fixed(u16),
    /// One at first, more while round trips stay as short as those of single requests. One again after a
    /// timeout. One also after exception 05 or 06, a lost connection or an invalid reply while other
    /// requests were in flight: the device may accept no second request.
    Auto,
}

impl InFlight {
    pub const MAX: u16 = 1024;
}

/// Hands out the places of a link.
pub(in crate::link) struct Pace {
    places: Rc<Places>,
    doubtful: Semaphore,
    /// Shared by all requests in flight. A request that must be alone locks it for writing.
    in_flight: RwLock<()>,
    auto: Option<RefCell<Auto>>,
}

#[derive(Default)]
struct Places {
    free: Cell<usize>,
    waiting: RefCell<Queue<oneshot::Sender<PlaceGuard>>>,
    /// Places that are taken away as soon as they are given back.
    owed: Cell<usize>,
}

/// Lets a request be in flight while it lasts.
pub(in crate::link) type Place<'p> =
    (PlaceGuard, Option<SemaphorePermit<'p>>, RwLockReadGuard<'p, ()>);

/// While it lasts, no other request is in flight.
pub(in crate::link) type Alone<'p> = (PlaceGuard, RwLockWriteGuard<'p, ()>);

/// A taken place. Dropping it gives the place back.
pub(in crate::link) struct PlaceGuard(Option<Rc<Places>>);

/// When a request was sent, and whether it was the only one in flight.
pub(in crate::link) struct Began {
    at: Instant,
    is_alone: bool,
}

struct Auto {
    limit: usize,
    /// The round trips since the last judgement.
    answers: Vec<Duration>,
    /// The median round trip of single requests.
    alone: Option<Duration>,
    /// No places are added before this time.
    settled: Option<Instant>,
}

impl Pace {
    pub(in crate::link) fn new(in_flight: InFlight) -> Pace {
        let (limit, auto) = match in_flight {
            InFlight::Fixed(limit) => (usize::from(limit), None),
            InFlight::Auto => (1, Some(RefCell::new(Auto::new()))),
        };
        let places = Rc::<Places>::default();
        places.free.set(limit);
        let doubtful = Semaphore::new((limit / 2).max(1));
        Pace { places, doubtful, in_flight: RwLock::default(), auto }
    }

    /// Waits for a place, which is taken while the result lasts. Doubtful requests leave room for the
    /// others.
    pub(in crate::link) async fn place(&self, source: u64, priority: Priority) -> Place<'_> {
        let doubtful = match priority {
            Priority::Doubtful => Some(self.doubtful.acquire().await.expect("it is never closed")),
            _ => None,
        };
        (self.acquire(source, priority).await, doubtful, self.in_flight.read().await)
    }

    /// Waits for a place, and then until no other request is in flight.
    pub(in crate::link) async fn alone(&self, source: u64, priority: Priority) -> Alone<'_> {
        (self.acquire(source, priority).await, self.in_flight.write().await)
    }

    async fn acquire(&self, source: u64, priority: Priority) -> PlaceGuard {
        if let Some(place) = self.places.take() {
            return place;
        }
        let (sender, place) = oneshot::channel();
        let is_awaited = |sender: &oneshot::Sender<PlaceGuard>| !sender.is_closed();
        self.places.waiting.borrow_mut().push(source, priority, sender, is_awaited);
        place.await.expect("places outlive those who wait for one")
    }

    /// The start of a request, if its round trip matters.
    pub(in crate::link) fn began(&self) -> Option<Began> {
        self.auto.as_ref().map(|_| Began { at: Instant::now(), is_alone: self.is_alone() })
    }

    /// A request that has a place has ended.
    pub(in crate::link) fn ended(&self, began: Began, answer: &Result<Vec<u8>, Failure>) {
        const REFUSALS: [u8; 2] =
            [ExceptionCode::Acknowledge as u8, ExceptionCode::ServerDeviceBusy as u8];
        let now = Instant::now();
        let is_alone = began.is_alone && self.is_alone();
        match answer {
            Err(Failure::Timeout) => self.too_many(now),
            Err(Failure::Exception(code)) if is_alone || !REFUSALS.contains(code) => {
                self.answered(now - began.at, now);
            }
            Ok(_) => self.answered(now - began.at, now),
            Err(_) if is_alone => {}
            Err(_) => self.too_many(now),
        }
    }

    /// Whether no more than one place is taken.
    fn is_alone(&self) -> bool {
        let Some(auto) = &self.auto else { return false };
        let places = auto.borrow().limit + self.places.owed.get();
        places <= self.places.free.get() + 1
    }

    fn answered(&self, took: Duration, now: Instant) {
        let Some(auto) = &self.auto else { return };
        let was_full = self.places.free.get() == 0;
        match auto.borrow_mut().answered(took, was_full, now) {
            Change::None => {}
            Change::More => self.places.give(),
            Change::Fewer(places) => self.take_away(places),
        }
    }

    fn too_many(&self, now: Instant) {
        if let Some(auto) = &self.auto {
            let fewer = auto.borrow_mut().back_to(1, now);
            self.take_away(fewer);
        }
    }

    fn take_away(&self, places: usize) {
        let free = places.min(self.places.free.get());
        self.places.free.set(self.places.free.get() - free);
        self.places.owed.set(self.places.owed.get() + places - free);
    }
}

impl Places {
    fn take(self: &Rc<Places>) -> Option<PlaceGuard> {
        let free = self.free.get().checked_sub(1)?;
        self.free.set(free);
        Some(PlaceGuard(Some(Rc::clone(self))))
    }

    /// Gives a place to the next request.
    fn give(self: &Rc<Places>) {
        loop {
            let Some(next) = self.waiting.borrow_mut().pop() else { break };
            match next.send(PlaceGuard(Some(Rc::clone(self)))) {
                Ok(()) => return,
                // That request was cancelled. Its drop must not return the place a second time.
                Err(mut place) => place.0 = None,
            }
        }
        self.free.set(self.free.get() + 1);
    }
}

impl Drop for PlaceGuard {
    fn drop(&mut self) {
        let Some(places) = self.0.take() else { return };
        match places.owed.get().checked_sub(1) {
            Some(owed) => places.owed.set(owed),
            None => places.give(),
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
enum Change {
    None,
    More,
    Fewer(usize),
}

impl Auto {
    fn new() -> Auto {
        Auto {
            limit: 1,
            answers: Vec::with_capacity(ANSWERS_PER_DECISION),
            alone: None,
            settled: None,
        }
    }

    fn answered(&mut self, took: Duration, was_full: bool, now: Instant) -> Change {
        // While places are free, answers don't show whether more requests help.
        if !was_full {
            return Change::None;
        }
        self.answers.push(took);
        if self.answers.len() < ANSWERS_PER_DECISION {
            return Change::None;
        }
        // A few answers that were held up do not matter.
        let (_, &mut median, _) = self.answers.select_nth_unstable(ANSWERS_PER_DECISION / 2);
        self.answers.clear();
        if self.limit == 1 {
            self.alone = Some(median);
        }
        let alone = self.alone.unwrap_or(median);
        if median > alone.mul_f64(MAX_FLAT_RATIO) {
            return Change::Fewer(self.back_to(self.limit - 1, now));
        }
        if self.limit == MAX_AUTO_IN_FLIGHT || self.settled.is_some_and(|until| now < until) {
            return Change::None;
        }
        self.limit += 1;
        Change::More
    }

    /// Lowers the limit. Returns how many places are too many now.
    fn back_to(&mut self, limit: usize, now: Instant) -> usize {
        let fewer = self.limit - limit;
        *self = Auto { alone: self.alone, limit, ..Auto::new() };
        self.settled = Some(now + RETRY_AFTER);
        fewer
    }
}

#[cfg(test)]
mod tests {
    use holdfast_protocol::client::{Closed, InvalidResponse};

    use super::*;

    const MS: Duration = Duration::from_millis(1);

    /// Answers that all take this long, while all places are taken.
    fn answer(auto: &mut Auto, took: Duration, now: Instant) -> Change {
        for _ in 1..ANSWERS_PER_DECISION {
            assert_eq!(auto.answered(took, true, now), Change::None);
        }
        auto.answered(took, true, now)
    }

    #[test]
    fn there_are_more_while_round_trips_stay_short() {
        let (mut auto, now) = (Auto::new(), Instant::now());
        for limit in 2..=MAX_AUTO_IN_FLIGHT {
            assert_eq!(answer(&mut auto, 10 * MS, now), Change::More);
            assert_eq!(auto.limit, limit);
        }
        assert_eq!(answer(&mut auto, 10 * MS, now), Change::None);
    }

    #[test]
    fn a_device_that_answers_one_after_the_other_gets_one() {
        let (mut auto, now) = (Auto::new(), Instant::now());
        assert_eq!(answer(&mut auto, 10 * MS, now), Change::More);
        assert_eq!(answer(&mut auto, 20 * MS, now), Change::Fewer(1));
        assert_eq!(answer(&mut auto, 10 * MS, now), Change::None);
        assert_eq!(answer(&mut auto, 10 * MS, now + RETRY_AFTER), Change::More);
    }

    #[test]
    fn an_answer_that_was_held_up_changes_nothing() {
        let (mut auto, now) = (Auto::new(), Instant::now());
        assert_eq!(auto.answered(1000 * MS, true, now), Change::None);
        for _ in 2..ANSWERS_PER_DECISION {
            assert_eq!(auto.answered(10 * MS, true, now), Change::None);
        }
        assert_eq!(auto.answered(10 * MS, true, now), Change::More);
        assert_eq!(answer(&mut auto, 20 * MS, now), Change::Fewer(1));
    }

    #[test]
    fn free_places_show_nothing() {
        let (mut auto, now) = (Auto::new(), Instant::now());
        for _ in 0..3 * ANSWERS_PER_DECISION {
            assert_eq!(auto.answered(MS, false, now), Change::None);
        }
    }

    #[tokio::test]
    async fn a_timeout_takes_all_places_but_one_even_those_that_are_taken() {
        let (pace, now) = (Pace::new(InFlight::Auto), Instant::now());
        let mut taken = vec![pace.place(0, Priority::Usual).await];
        for _ in 0..3 {
            for _ in 0..ANSWERS_PER_DECISION {
                pace.answered(10 * MS, now);
            }
            taken.push(pace.place(0, Priority::Usual).await);
        }
        pace.too_many(now);
        drop(taken);
        assert_eq!((pace.places.free.get(), pace.places.owed.get()), (1, 0));
    }

    #[tokio::test]
    async fn failures_lower_the_limit_only_beside_other_requests() {
        let lost = Failure::Closed(Closed::ByPeer);
        let damaged = Failure::Invalid(InvalidResponse::ProtocolId(1));
        for failure in [Failure::Exception(5), Failure::Exception(6), lost, damaged] {
            let pace = Pace::new(InFlight::Auto);
            let limit = || pace.auto.as_ref().unwrap().borrow().limit;
            let first = pace.place(0, Priority::Usual).await;
            for _ in 0..ANSWERS_PER_DECISION {
                pace.answered(10 * MS, Instant::now());
            }
            for _ in 0..3 * ANSWERS_PER_DECISION {
                pace.ended(pace.began().unwrap(), &Err(failure));
            }
            assert_eq!(limit(), 2, "{failure}: it was alone");
            let second = pace.place(0, Priority::Usual).await;
            let began = pace.began().unwrap();
            drop(first);
            pace.ended(began, &Err(failure));
            assert_eq!(limit(), 1, "{failure}");
            drop(second);
            assert_eq!((pace.places.free.get(), pace.places.owed.get()), (1, 0));
        }
    }

    #[tokio::test]
    async fn urgent_requests_go_first_and_who_was_stopped_takes_no_place() {
        let pace = Pace::new(InFlight::Fixed(1));
        let taken = pace.place(0, Priority::Usual).await;
        let mut usual = Box::pin(pace.place(0, Priority::Usual));
        let mut stopped = Box::pin(pace.place(0, Priority::Urgent));
        let mut urgent = Box::pin(pace.place(0, Priority::Urgent));
        assert!(is_pending(&mut usual) && is_pending(&mut stopped));
        assert!(is_pending(&mut urgent));
        drop(stopped);
        drop(taken);
        assert!(is_pending(&mut usual));
        drop(urgent.await);
        drop(usual.await);
        assert_eq!(pace.places.free.get(), 1);
    }

    #[tokio::test]
    async fn who_is_alone_waits_for_the_others_and_they_wait_for_it() {
        let pace = Pace::new(InFlight::Fixed(3));
        let first = pace.place(0, Priority::Usual).await;
        let mut alone = Box::pin(pace.alone(0, Priority::Urgent));
        assert!(is_pending(&mut alone));
        let mut later = Box::pin(pace.place(0, Priority::Urgent));
        assert!(is_pending(&mut later));
        drop(first);
        let alone = alone.await;
        assert!(is_pending(&mut later));
        drop(alone);
        drop(later.await);
        assert_eq!(pace.places.free.get(), 3);
    }

    /// Whether a future waits still.
    fn is_pending<T>(future: &mut std::pin::Pin<Box<impl Future<Output = T>>>) -> bool {
        let mut context = std::task::Context::from_waker(std::task::Waker::noop());
        future.as_mut().poll(&mut context).is_pending()
    }
}
