//! Observers: queues that receive every write to a memory, for code that reacts to writes.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::area::Area;
use crate::operation::{Access, Write};

/// The most writes, and the most bytes of values, that wait in a queue.
const MAX_QUEUED_WRITES: usize = 4096;
const MAX_QUEUED_BYTES: usize = 1024 * 1024;

/// A write that was carried out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Written {
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub bytes: Vec<u8>,
}

/// The writes to a memory, in its order. When the queue is full, the oldest writes are dropped.
#[derive(Debug, Default)]
pub struct WriteQueue {
    state: Mutex<State>,
    arrived: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Written>,
    bytes: usize,
    dropped: u64,
    closed: bool,
}

impl WriteQueue {
    /// Waits for the next write; `None` after `timeout`, and when the queue is closed.
    pub fn next(&self, timeout: Duration) -> Option<Written> {
        let is_idle = |state: &mut State| state.waiting.is_empty() && !state.closed;
        let waited = self.arrived.wait_timeout_while(self.state(), timeout, is_idle);
        let mut state = waited.unwrap_or_else(PoisonError::into_inner).0;
        let written = state.waiting.pop_front()?;
        state.bytes -= written.bytes.len();
        Some(written)
    }

    /// Closes the queue: nothing is queued any more, and what waits is dropped.
    pub fn close(&self) {
        let mut state = self.state();
        state.closed = true;
        state.waiting = VecDeque::new();
        state.bytes = 0;
        self.arrived.notify_all();
    }

    pub fn is_closed(&self) -> bool {
        self.state().closed
    }

    /// How many writes were dropped because the queue was full.
    pub fn dropped(&self) -> u64 {
        self.state().dropped
    }

    /// Queues a write, unless the queue is closed.
    fn push(&self, write: &Write<'_>) {
        let Write { area, address, count, bytes } = *write;
        let mut state = self.state();
        if state.closed {
            return;
        }
        state.bytes += bytes.len();
        state.waiting.push_back(Written { area, address, count, bytes: bytes.to_vec() });
        // One write alone is never too large: an area has 128 KiB at most.
        while state.waiting.len() > MAX_QUEUED_WRITES || state.bytes > MAX_QUEUED_BYTES {
            let oldest = state.waiting.pop_front().map_or(0, |oldest| oldest.bytes.len());
            state.bytes -= oldest;
            state.dropped += 1;
        }
        self.arrived.notify_one();
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The queues of one memory.
#[derive(Debug, Default)]
pub(crate) struct Observers(Vec<Observer>);

#[derive(Debug)]
struct Observer {
    queue: Arc<WriteQueue>,
    clients_only: bool,
}

impl Observers {
    pub(crate) fn add(&mut self, queue: Arc<WriteQueue>, clients_only: bool) {
        self.0.retain(|observer| !observer.queue.is_closed());
        self.0.push(Observer { queue, clients_only });
    }

    pub(crate) fn is_any(&self) -> bool {
        !self.0.is_empty()
    }

    /// Queues writes for all observers.
    #[cold]
    pub(crate) fn notify<'w>(
        &mut self,
        access: Access,
        writes: impl IntoIterator<Item = &'w Write<'w>>,
    ) {
        self.0.retain(|observer| !observer.queue.is_closed());
        for write in writes {
            for Observer { queue, clients_only } in &self.0 {
                if access == Access::Client || !clients_only {
                    queue.push(write);
                }
            }
        }
    }
}

impl Drop for Observer {
    fn drop(&mut self) {
        self.queue.close();
    }
}
