//! Threads that a value owns, which are joined at its end.

use std::process;
use std::sync::{Mutex, TryLockError};
use std::thread::JoinHandle;

use holdfast_runtime::lock;

/// Threads of this process. In a child process that was forked, they do not exist.
#[derive(Debug)]
pub(crate) struct OwnThreads {
    process: u32,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

impl Default for OwnThreads {
    fn default() -> OwnThreads {
        OwnThreads { process: process::id(), threads: Mutex::default() }
    }
}

impl OwnThreads {
    pub(crate) fn push(&self, thread: JoinHandle<()>) {
        lock(&self.threads).push(thread);
    }

    /// Whether this is a forked child, which has no copies of the threads. It must not stop those of its
    /// parent, with which it shares sockets.
    pub(crate) fn are_of_another_process(&self) -> bool {
        self.process != process::id()
    }

    /// Whether there are threads that were not joined.
    pub(crate) fn are_running(&self) -> bool {
        match self.threads.try_lock() {
            Ok(threads) => !threads.is_empty(),
            Err(TryLockError::Poisoned(threads)) => !threads.into_inner().is_empty(),
            // Somebody waits for their end.
            Err(TryLockError::WouldBlock) => true,
        }
    }

    /// Waits for the end of all threads. A second call waits for the first.
    pub(crate) fn join(&self) {
        let mut threads = lock(&self.threads);
        for thread in threads.drain(..) {
            let ended = thread.join();
            debug_assert!(ended.is_ok() || std::thread::panicking(), "a thread panicked");
        }
    }
}
