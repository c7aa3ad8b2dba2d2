//! What was read, for whoever takes it in another thread: woken once a batch, not once a block.
//!
//! The queue is bounded. When nobody takes what it holds, the oldest polls are dropped and counted.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use holdfast_memory::Area;

use super::status::Fault;

/// Polls that may wait to be taken.
const CAPACITY: usize = 16_384;

/// One poll of one device.
#[derive(Debug, Clone)]
pub struct Poll {
    pub device: Arc<str>,
    pub time: SystemTime,
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
}

/// The queue between the poller's thread and the taker's.
#[derive(Debug, Default)]
pub struct Results {
    queue: Mutex<VecDeque<Poll>>,
    ready: Condvar,
    dropped: AtomicU64,
}

impl Results {
    pub(super) fn push(&self, poll: Poll) {
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        if queue.len() == CAPACITY {
            queue.pop_front();
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
        let first = queue.is_empty();
        queue.push_back(poll);
        drop(queue);
        if first {
            self.ready.notify_one();
        }
    }

    /// All polls that wait; when there are none, waits up to `timeout` for the first.
    pub fn take(&self, timeout: Duration) -> Vec<Poll> {
        let queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut queue, _) = self
            .ready
            .wait_timeout_while(queue, timeout, |queue| queue.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        queue.drain(..).collect()
    }

    /// Polls that nobody took in time.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}
