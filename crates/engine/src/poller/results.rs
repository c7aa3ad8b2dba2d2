//! Results of polls and writes, for receivers in other threads. A receiver is woken once per batch,
//! not once per block.
//!
//! Each receiver has a bounded queue of its own, so a slow one loses nothing of the others. When it is
//! full, the oldest polls are dropped and counted. Results of writes are never dropped.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant, SystemTime};

use holdfast_memory::Area;
use holdfast_runtime::lock;

use crate::link::Fault;

/// The most polls in the queue.
const MAX_POLLS: usize = 16_384;

/// One poll of one device.
#[derive(Debug, Clone)]
pub struct Poll {
    /// [`super::DeviceSettings::reported_as`], or the name.
    pub device: Arc<str>,
    /// The scheduled time, counted from the start of the poller. A poll outside the schedule has
    /// the time when it began.
    pub due: Duration,
    /// In the order of their requests. Blocks after one without an answer are missing. There are none
    /// when the device begins to stand by.
    pub blocks: Vec<BlockResult>,
}

/// One block: its bytes, or the fault.
#[derive(Debug, Clone)]
pub struct BlockResult {
    pub area: Area,
    pub address: u16,
    pub count: u16,
    pub outcome: Result<Vec<u8>, Fault>,
    /// The time of the result.
    pub time: SystemTime,
}

/// The result of a write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Written {
    /// The number that [`super::Poller::write`] returned.
    pub ticket: u64,
    pub outcome: Result<(), Fault>,
}

/// All results that waited.
#[derive(Debug, Default)]
pub struct Batch {
    pub polls: VecDeque<Poll>,
    pub writes: Vec<Written>,
    /// Whether the poller has ended: no more results will come.
    pub ended: bool,
    /// Whether the receiver was woken.
    woken: bool,
}

impl Batch {
    fn is_empty(&self) -> bool {
        self.polls.is_empty() && self.writes.is_empty() && !self.ended && !self.woken
    }
}

/// The queue between the thread of the poller and the receiver.
#[derive(Debug)]
pub struct Results {
    began: Instant,
    queue: Mutex<Batch>,
    ready: Condvar,
    dropped: AtomicU64,
    has_withdrawn: AtomicBool,
}

impl Results {
    fn since(began: Instant) -> Results {
        Results {
            began,
            queue: Mutex::default(),
            ready: Condvar::default(),
            dropped: AtomicU64::default(),
            has_withdrawn: AtomicBool::default(),
        }
    }

    /// Converts a time to the clock of polls.
    pub(super) fn counted(&self, time: Instant) -> Duration {
        time.saturating_duration_since(self.began)
    }

    pub(super) fn push(&self, poll: Poll) {
        self.put(|batch| {
            debug_assert!(batch.polls.len() <= MAX_POLLS);
            if batch.polls.len() == MAX_POLLS {
                batch.polls.pop_front();
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
            batch.polls.push_back(poll);
        });
    }

    pub(super) fn push_write(&self, written: Written) {
        self.put(|batch| batch.writes.push(written));
    }

    fn end(&self) {
        self.put(|batch| batch.ended = true);
    }

    fn put(&self, put: impl FnOnce(&mut Batch)) {
        let mut batch = lock(&self.queue);
        debug_assert!(!batch.ended, "no result follows the end");
        let first = batch.is_empty();
        put(&mut batch);
        drop(batch);
        if first {
            self.ready.notify_one();
        }
    }

    /// Ends the current or the next wait of the receiver, without results.
    pub fn wake(&self) {
        // Not with `put`: that must not be called after the end.
        let mut batch = lock(&self.queue);
        batch.woken = true;
        drop(batch);
        self.ready.notify_one();
    }

    /// Gives up all writes whose results come here: those that were not sent yet are not sent.
    pub fn withdraw(&self) {
        self.has_withdrawn.store(true, Ordering::Relaxed);
    }

    pub(super) fn has_withdrawn(&self) -> bool {
        self.has_withdrawn.load(Ordering::Relaxed)
    }

    /// Takes all results that wait. If there are none, waits up to `timeout` for the first.
    pub fn take(&self, timeout: Duration) -> Batch {
        let batch = lock(&self.queue);
        let (mut batch, _) = self
            .ready
            .wait_timeout_while(batch, timeout, |batch| batch.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        let ended = batch.ended;
        std::mem::replace(&mut *batch, Batch { ended, ..Batch::default() })
    }

    /// The number of polls that were dropped because the queue was full.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// All receivers of a poller.
#[derive(Debug)]
pub(super) struct Receivers {
    /// The start of the poller, from which all receivers count.
    began: Instant,
    /// `None` when the poller has ended.
    all: Mutex<Option<Vec<Weak<Results>>>>,
}

impl Default for Receivers {
    fn default() -> Receivers {
        Receivers { began: Instant::now(), all: Mutex::new(Some(Vec::new())) }
    }
}

impl Receivers {
    pub(super) fn add(&self) -> Arc<Results> {
        let made = Arc::new(Results::since(self.began));
        match &mut *lock(&self.all) {
            Some(all) => {
                all.retain(|other| other.strong_count() > 0);
                all.push(Arc::downgrade(&made));
            }
            None => made.end(),
        }
        made
    }

    /// Tells all receivers, and those that come later, that no results will come.
    pub(super) fn end(&self) {
        for receiver in lock(&self.all).take().into_iter().flatten() {
            if let Some(receiver) = receiver.upgrade() {
                receiver.end();
            }
        }
    }
}
