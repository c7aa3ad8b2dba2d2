//! A fair lock: callers enter one at a time, in the order in which they asked.
//!
//! A mutex alone is not fair: a thread that calls without a pause would lock it again before the
//! waiting threads wake up.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::thread::{self, Thread};

use holdfast_runtime::lock;

use super::interrupt::{Interrupt, SIGNAL_CHECK_INTERVAL};

#[derive(Default)]
pub(super) struct Turns {
    /// In the order in which they asked. The first one is inside, or about to enter.
    callers: Mutex<VecDeque<Thread>>,
}

/// The turn of one caller. It ends when it is dropped.
pub(super) struct Turn<'t>(&'t Turns);

impl Turns {
    /// Waits for a turn. `None` when the caller is interrupted before. A thread has one turn at a time.
    pub(super) fn take(&self, interrupt: &mut Interrupt<'_>) -> Option<Turn<'_>> {
        let caller = thread::current();
        let me = caller.id();
        let mut callers = lock(&self.callers);
        callers.push_back(caller);
        while callers[0].id() != me {
            drop(callers);
            if interrupt.is_possible() {
                thread::park_timeout(SIGNAL_CHECK_INTERVAL);
            } else {
                thread::park();
            }
            let is_hit = interrupt.is_hit();
            callers = lock(&self.callers);
            if is_hit && callers[0].id() != me {
                callers.retain(|other| other.id() != me);
                return None;
            }
        }
        drop(callers);
        Some(Turn(self))
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        let mut callers = lock(&self.0.callers);
        callers.pop_front();
        if let Some(next) = callers.front() {
            next.unpark();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::thread;

    use super::*;

    #[test]
    fn callers_enter_one_at_a_time_in_order() {
        let turns = Turns::default();
        let served = AtomicUsize::new(0);
        thread::scope(|threads| {
            let first = turns.take(&mut Interrupt::new(None));
            for number in 1..=20 {
                let (turns, served) = (&turns, &served);
                threads.spawn(move || {
                    let _turn = turns.take(&mut Interrupt::new(None));
                    assert_eq!(served.fetch_add(1, Ordering::SeqCst) + 1, number);
                });
                while lock(&turns.callers).len() != number + 1 {
                    thread::yield_now();
                }
            }
            assert_eq!(served.load(Ordering::SeqCst), 0);
            drop(first);
        });
        assert_eq!(served.load(Ordering::SeqCst), 20);
    }

    #[test]
    fn a_caller_that_leaves_does_not_stop_those_behind_it() {
        let turns = Turns::default();
        thread::scope(|threads| {
            let first = turns.take(&mut Interrupt::new(None));
            let leaves = threads.spawn(|| {
                let mut check = || lock(&turns.callers).len() == 3;
                turns.take(&mut Interrupt::new(Some(&mut check))).is_none()
            });
            while lock(&turns.callers).len() != 2 {
                thread::yield_now();
            }
            let stays = threads.spawn(|| turns.take(&mut Interrupt::new(None)).is_some());
            assert!(leaves.join().unwrap());
            drop(first);
            assert!(stays.join().unwrap());
        });
        assert!(turns.take(&mut Interrupt::new(None)).is_some());
        assert!(lock(&turns.callers).is_empty());
    }
}
