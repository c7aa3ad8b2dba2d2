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
    tickets: Mutex<Tickets>,
}

#[derive(Default)]
struct Tickets {
    /// The number of the next caller.
    next: u64,
    /// The number of the caller inside, or of the next one to enter.
    current: u64,
    waiting: VecDeque<Thread>,
    /// The numbers of callers that have left before their turn.
    left: Vec<u64>,
}

/// The turn of one caller. It ends when it is dropped.
pub(super) struct Turn<'t>(&'t Turns);

impl Turns {
    /// Waits for a turn. `None` when the caller is interrupted before.
    pub(super) fn take(&self, interrupt: &mut Interrupt<'_>) -> Option<Turn<'_>> {
        let mut tickets = lock(&self.tickets);
        let mine = tickets.next;
        tickets.next += 1;
        if tickets.current != mine {
            tickets.waiting.push_back(thread::current());
        }
        while tickets.current != mine {
            drop(tickets);
            if interrupt.is_possible() {
                thread::park_timeout(SIGNAL_CHECK_INTERVAL);
            } else {
                thread::park();
            }
            let is_hit = interrupt.is_hit();
            tickets = lock(&self.tickets);
            if is_hit && tickets.current != mine {
                let me = thread::current().id();
                tickets.waiting.retain(|thread| thread.id() != me);
                tickets.left.push(mine);
                return None;
            }
        }
        drop(tickets);
        Some(Turn(self))
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        let mut tickets = lock(&self.0.tickets);
        tickets.current += 1;
        while let Some(at) = tickets.left.iter().position(|number| *number == tickets.current) {
            tickets.left.swap_remove(at);
            tickets.current += 1;
        }
        if let Some(thread) = tickets.waiting.pop_front() {
            thread.unpark();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::thread;

    use super::*;

    #[test]
    fn callers_enter_one_at_a_time_in_order() {
        let turns = Turns::default();
        let served = AtomicU64::new(0);
        thread::scope(|threads| {
            let first = turns.take(&mut Interrupt::new(None));
            for number in 1..=20 {
                let (turns, served) = (&turns, &served);
                threads.spawn(move || {
                    let _turn = turns.take(&mut Interrupt::new(None));
                    assert_eq!(served.fetch_add(1, Ordering::SeqCst) + 1, number);
                });
                while lock(&turns.tickets).next != number + 1 {
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
                let mut check = || lock(&turns.tickets).next == 3;
                turns.take(&mut Interrupt::new(Some(&mut check))).is_none()
            });
            while lock(&turns.tickets).next != 2 {
                thread::yield_now();
            }
            let stays = threads.spawn(|| turns.take(&mut Interrupt::new(None)).is_some());
            assert!(leaves.join().unwrap());
            drop(first);
            assert!(stays.join().unwrap());
        });
        assert!(turns.take(&mut Interrupt::new(None)).is_some());
        assert!(lock(&turns.tickets).left.is_empty());
    }
}
