//! The turn of a device: it gets one request at a time, from polls and writes alike.

use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::time::Duration;

use holdfast_memory::Area;
use tokio::sync::{Mutex, MutexGuard};

use super::write_through::Change;
use crate::link::{Fence, Pass};

#[derive(Default)]
pub(super) struct Turn {
    lock: Mutex<()>,
    /// Held by a write that waits for a fence: later ones do not overtake it.
    writes: Mutex<()>,
    is_polling: Cell<bool>,
    /// What was written to the device since its current poll began.
    changes: RefCell<Vec<Change>>,
}

impl Turn {
    /// Waits for the turn, which lasts as long as the result.
    pub(super) async fn take(&self) -> MutexGuard<'_, ()> {
        self.lock.lock().await
    }

    /// Waits for the turn of a write, in the order of the calls. With a fence, it is not before what a former
    /// holder has sent has ended; `None` if the device may not be used.
    pub(super) async fn take_to_write(
        &self,
        fence: Option<&Arc<Fence>>,
        timeout: Duration,
    ) -> Option<(MutexGuard<'_, ()>, Option<Pass>)> {
        let Some(fence) = fence else { return Some((self.take().await, None)) };
        let _next = self.writes.lock().await;
        let pass = fence.admit_write(timeout).await?;
        Some((self.take().await, Some(pass)))
    }

    /// A poll begins or ends.
    pub(super) fn polls(&self, is_polling: bool) {
        self.is_polling.set(is_polling);
        self.changes.borrow_mut().clear();
    }

    /// Keeps what was written for the reads of the current poll that began before.
    pub(super) fn note(&self, change: Change) {
        if self.is_polling.get() {
            self.changes.borrow_mut().push(change);
        }
    }

    /// Puts what was written to the device into the parts of a read that were read before. `known` of the
    /// changes are in them already. Returns how many are in them now.
    ///
    /// What is read after a write must not be replaced by it: the device may have changed meanwhile.
    pub(super) fn amend(
        &self,
        known: usize,
        (area, address, count): (Area, u16, u32),
        bytes: &mut [u8],
    ) -> usize {
        let first = u32::from(address);
        let changes = self.changes.borrow();
        for change in changes.iter().skip(known).filter(|change| change.area == area) {
            let start = u32::from(change.address);
            let (at, end) = (start.max(first), (start + change.count).min(first + count));
            if at < end {
                let (from, to) = ((at - start) as usize, (at - first) as usize);
                area.copy(&change.bytes, from, bytes, to, (end - at) as usize);
            }
        }
        changes.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(area: Area, address: u16, count: u32, bytes: &[u8]) -> Change {
        Change { area, address, count, bytes: bytes.to_vec() }
    }

    #[test]
    fn what_was_written_during_a_poll_is_in_its_reads() {
        let turn = Turn::default();
        turn.note(change(Area::HoldingRegisters, 0, 1, &[9, 9]));
        turn.polls(true);
        turn.note(change(Area::HoldingRegisters, 9, 2, &[1, 2, 3, 4]));
        turn.note(change(Area::Coils, 8, 3, &[0b101]));
        let (holding, coils) = ((Area::HoldingRegisters, 10, 3), (Area::Coils, 1, 12));
        let mut registers = [0; 6];
        assert_eq!(turn.amend(0, holding, &mut registers), 2);
        assert_eq!(registers, [3, 4, 0, 0, 0, 0]);
        let mut bits = [0b1111_1111, 0b1111];
        turn.amend(0, coils, &mut bits);
        assert_eq!(bits, [0b1111_1111, 0b1110]);
        turn.note(change(Area::HoldingRegisters, 11, 1, &[5, 6]));
        assert_eq!(turn.amend(2, holding, &mut registers), 3);
        assert_eq!(registers, [3, 4, 5, 6, 0, 0]);
        let mut later = [7; 6];
        assert_eq!(turn.amend(3, holding, &mut later), 3);
        assert_eq!(later, [7; 6]);
        turn.polls(false);
        assert_eq!(turn.amend(0, holding, &mut later), 0);
        assert_eq!(later, [7; 6]);
    }
}
