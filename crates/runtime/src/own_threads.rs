//! Threads that a value owns, which are joined at its end.

use std::mem;
use std::process;
use std::sync::{Mutex, PoisonError, TryLockError};
use std::thread::JoinHandle;

use crate::lock;

/// Threads of this process. In a child process that was forked, they do not exist.
#[derive(Debug)]
pub struct OwnThreads {
    process: u32,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

impl Default for OwnThreads {
    fn default() -> OwnThreads {
        OwnThreads { process: process::id(), threads: Mutex::default() }
    }
}

impl OwnThreads {
    pub fn push(&self, thread: JoinHandle<()>) {
        lock(&self.threads).push(thread);
    }

    /// Whether this is a forked child, which has no copies of the threads. It must not stop those of its
    /// parent, with which it shares sockets.
    pub fn are_of_another_process(&self) -> bool {
        self.process != process::id()
    }

    /// Whether there are threads that were not joined.
    pub fn are_running(&self) -> bool {
        match self.threads.try_lock() {
            Ok(threads) => !threads.is_empty(),
            Err(TryLockError::Poisoned(threads)) => !threads.into_inner().is_empty(),
            // Somebody waits for their end.
            Err(TryLockError::WouldBlock) => true,
        }
    }

    /// Waits for the end of all threads. A second call waits for the first.
    pub fn join(&self) {
        let mut threads = lock(&self.threads);
        for thread in threads.drain(..) {
            let ended = thread.join();
            debug_assert!(ended.is_ok() || std::thread::panicking(), "a thread panicked");
        }
    }
}

impl Drop for OwnThreads {
    fn drop(&mut self) {
        if self.are_of_another_process() {
            // Dropping a handle detaches its thread: that would use memory which may have been given to another.
            let threads = self.threads.get_mut().unwrap_or_else(PoisonError::into_inner);
            mem::forget(mem::take(threads));
        }
    }
}
