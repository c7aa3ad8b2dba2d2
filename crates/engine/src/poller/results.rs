//! What was read and written, for whoever takes it in another thread: woken once a batch, not once a
//! block.
//!
//! The queue is bounded. When nobody takes what it holds, the oldest polls are dropped and counted;
//! what became of a write never is.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use holdfast_memory::Area;

use super::status::Fault;

/// Polls that may wait to be taken.
const CAPACITY: usize = 16_384;

/// One poll of one device.
#[derive(Debug, Clone)]
pub struct Poll {
    pub device: Arc<str>,
    /// When the schedule wanted it, counted from the poller's start; a poll beside the schedule has
    /// the time when it began.
    pub due: Duration,
    /// In the order in which they were asked; those behind one that was not answered are missing.
    pub blocks: Vec<BlockResult>,
}

/// One block: its bytes, or why there are none.
#[derive(Debug, Clone)]
pub struct BlockResult {
    pub area: Area,
    pub address: u16,
    pub count: u16,
    pub outcome: Result<Vec<u8>, Fault>,
    /// When that was known.
    pub time: SystemTime,
}

/// What became of a write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Written {
    /// The number that it was given.
    pub ticket: u64,
    pub outcome: Result<(), Fault>,
}

/// What is taken at once.
#[derive(Debug, Default)]
pub struct Batch {
    pub polls: VecDeque<Poll>,
    pub writes: Vec<Written>,
    /// Nothing will come any more.
    pub ended: bool,
}

impl Batch {
    fn is_empty(&self) -> bool {
        self.polls.is_empty() && self.writes.is_empty() && !self.ended
    }
}

/// The queue between the poller's thread and the taker's.
#[derive(Debug)]
pub struct Results {
    began: Instant,
    queue: Mutex<Batch>,
    ready: Condvar,
    dropped: AtomicU64,
}

impl Default for Results {
    fn default() -> Results {
        Results {
            began: Instant::now(),
            queue: Mutex::default(),
            ready: Condvar::default(),
            dropped: AtomicU64::default(),
        }
    }
}

impl Results {
    /// A time as polls tell it.
    pub(super) fn counted(&self, time: Instant) -> Duration {
        time.saturating_duration_since(self.began)
    }

    pub(super) fn push(&self, poll: Poll) {
        self.put(|batch| {
            debug_assert!(batch.polls.len() <= CAPACITY);
            if batch.polls.len() == CAPACITY {
                batch.polls.pop_front();
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
            batch.polls.push_back(poll);
        });
    }

    pub(super) fn push_write(&self, written: Written) {
        self.put(|batch| batch.writes.push(written));
    }

    pub(super) fn end(&self) {
        self.put(|batch| batch.ended = true);
    }

    fn put(&self, put: impl FnOnce(&mut Batch)) {
        let mut batch = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        debug_assert!(!batch.ended, "nothing comes after the end");
        let first = batch.is_empty();
        put(&mut batch);
        drop(batch);
        if first {
            self.ready.notify_one();
        }
    }

    /// All that waits; when nothing does, waits up to `timeout` for the first.
    pub fn take(&self, timeout: Duration) -> Batch {
        let batch = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut batch, _) = self
            .ready
            .wait_timeout_while(batch, timeout, |batch| batch.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        let ended = batch.ended;
        std::mem::replace(&mut *batch, Batch { ended, ..Batch::default() })
    }

    /// Polls that nobody took in time.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}
