//! With `sync` 0: steps are stored before they are answered.
//!
//! All steps that wait are carried out on shadows: memories that only this thread sees. That shows what they
//! do and in which order. What differs then is stored in one transaction. After it, the same steps are
//! carried out on the memories, and answered.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use holdfast_memory::{Action, Area, Memory, Outcome, Refusal, Step};

use super::error::FileError;
use super::image::{Changes, PAGE_BYTES, Page};
use super::queue::{Next, Queue, QueuedStep};
use super::store::Store;

pub(super) struct BeforeReply {
    store: Store,
    memories: Vec<Arc<Memory>>,
    shadows: Vec<Arc<Memory>>,
    /// The numbers of the memories in the file.
    ids: Vec<u16>,
    queue: Arc<Queue>,
    retry: Duration,
}

impl BeforeReply {
    pub fn new(
        store: Store,
        memories: Vec<Arc<Memory>>,
        ids: Vec<u16>,
        queue: Arc<Queue>,
        retry: Duration,
    ) -> BeforeReply {
        let shadows = memories.iter().map(|memory| Arc::new(memory.blank())).collect();
        BeforeReply { store, memories, shadows, ids, queue, retry }
    }

    pub fn run(mut self) -> Result<(), FileError> {
        self.restore_shadows();
        loop {
            match self.queue.next(self.retry) {
                Next::Steps(steps) => self.carry_out(steps),
                // The file may be gone, or in doubt. The status has the error of an attempt.
                Next::Idle => drop(self.store.store(Changes::default())),
                Next::Stop => return self.store.close(),
            }
        }
    }

    fn carry_out(&mut self, steps: Vec<QueuedStep>) {
        let mut touched = BTreeSet::new();
        let mut outcomes: Vec<Outcome> = Vec::with_capacity(steps.len());
        for QueuedStep { step, .. } in &steps {
            let outcome = step.carry_out(&self.shadows);
            // A refused step has changed nothing.
            if outcome.is_ok() {
                self.touch(step, &mut touched);
            }
            outcomes.push(outcome);
        }
        let pages = touched.into_iter().filter_map(|page| self.changed(page)).collect();
        // The memories have not changed yet: only the shadows are ahead.
        let stored = self.store.store(Changes { pages, ..Changes::default() });
        self.queue.stored();
        if stored.is_err() {
            self.restore_shadows();
            return self.queue.refuse(steps.into_iter().map(|each| each.done), Refusal::NotStored);
        }
        for (QueuedStep { step, done }, expected) in steps.into_iter().zip(outcomes) {
            let outcome = step.carry_out(&self.memories);
            debug_assert_eq!(outcome, expected, "a step does the same to equal memories");
            done(outcome);
        }
    }

    /// Notes the pages that a step writes.
    fn touch(&self, step: &Step, touched: &mut BTreeSet<MemberPage>) {
        let mut note = |member: u16, area: Area, address: u16, count: usize| {
            let written = self.shadows[usize::from(member)].layout().bytes(area, address, count);
            let (area, bytes) = written.expect("a step is valid for its memories");
            let numbers = bytes.start / PAGE_BYTES..=(bytes.end - 1) / PAGE_BYTES;
            touched.extend(numbers.map(|number| MemberPage { member, area, number }));
        };
        match &step.action {
            Action::Write(writes) => {
                for write in writes {
                    note(write.member, write.area, write.address, write.count);
                }
            }
            &Action::Mask { member, area, address, .. } => note(member, area, address, 1),
            Action::WriteThenRead { write, .. } => {
                note(write.member, write.area, write.address, write.count);
            }
        }
    }

    /// A page of a shadow, unless it is in the file already.
    fn changed(&self, MemberPage { member, area, number }: MemberPage) -> Option<Page> {
        let (shadow, memory) = (&self.shadows[usize::from(member)], self.ids[usize::from(member)]);
        let (first, len) = (number * PAGE_BYTES, shadow.layout().byte_lens()[area]);
        let bytes = shadow.bytes(area, first..len.min(first + PAGE_BYTES));
        let page = Page { memory, area, number, bytes };
        (!self.store.image().has(&page)).then_some(page)
    }

    fn restore_shadows(&mut self) {
        for (shadow, contents) in self.shadows.iter().zip(Memory::contents(&self.memories)) {
            shadow.restore(&contents);
        }
    }
}

/// A page of a member.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct MemberPage {
    member: u16,
    area: usize,
    number: usize,
}
