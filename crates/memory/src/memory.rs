//! What a memory consists of, and what one write changes in it.

mod access;
mod carry_out_step;
pub(crate) mod checks;
pub(crate) mod several_memories;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use crate::area::{Area, FILES, Layout, Span};
use crate::bits;
use crate::error::LayoutError;
use crate::mirrored::{Mirrored, MirroredRanges};
use crate::operation::{Access, Read, Write};
use crate::seal::{Gate, GateMode};
use crate::step::Journal;
use crate::write_queue::{Observers, WriteQueue};

/// Four areas and any number of files, of fixed size, behind one lock.
#[derive(Debug)]
pub struct Memory {
    /// Locks of several memories are taken in the order of their ranks, so that two writers cannot
    /// deadlock.
    rank: u64,
    name: Option<Arc<str>>,
    layout: Layout,
    gate: Option<Gate>,
    mirrored: RwLock<MirroredRanges>,
    /// What carries out the writes in place of the memory, and the number of the memory in it.
    journal: OnceLock<(Arc<dyn Journal>, u16)>,
    content: RwLock<Content>,
}

/// A copy of what a memory contains.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Contents {
    /// The bytes of the areas, in the order of [`Area::ALL`]; then, if there are files, those of all of
    /// them, in the order of their numbers.
    pub areas: Vec<Box<[u8]>>,
    pub sealed: bool,
}

#[derive(Debug)]
struct Content {
    /// As those of [`Contents`]; without files, the last is empty.
    areas: [Box<[u8]>; FILES + 1],
    /// Any of [`SEALED`], [`GUARDED`] and [`AGING`]. With none of them, an access needs no further checks.
    access_flags: u8,
    /// How many times the seal opened, and how many times it closed again.
    seal_changes: (u64, u64),
    /// How many writes were carried out, each in one step.
    writes: u64,
    observers: Observers,
}

/// A flag of access: clients are refused.
const SEALED: u8 = 1;

/// A flag of access: the journal is asked before each.
const GUARDED: u8 = 2;

/// A flag of access: mirrored ranges can be stale.
const AGING: u8 = 4;

/// With which access a write is carried out, how old its values are, if that is known, and under which lease
/// they were read from a device.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Writer {
    pub(crate) access: Access,
    pub(crate) age: Option<Duration>,
    pub(crate) lease: Option<u64>,
}

impl Writer {
    /// Writes values at once.
    const fn now(access: Access) -> Writer {
        Writer { access, age: Some(Duration::ZERO), lease: None }
    }
}

static NEXT_RANK: AtomicU64 = AtomicU64::new(0);

impl Memory {
    /// Creates a memory with all items 0. It is sealed if it has a gate.
    ///
    /// # Errors
    /// [`LayoutError`] when the gate is not a bit of this memory.
    pub fn new(layout: Layout, gate: Option<Gate>) -> Result<Memory, LayoutError> {
        if let Some(Gate { area, address, .. }) = gate {
            if !area.is_bits() {
                return Err(LayoutError::GateNotABit);
            }
            if !layout.span(area).holds(address, 1) {
                return Err(LayoutError::GateOutside { address });
            }
        }
        let mut areas: [Box<[u8]>; FILES + 1] = Default::default();
        for (area, len) in areas.iter_mut().zip(layout.byte_lens()) {
            *area = vec![0; len].into_boxed_slice();
        }
        Ok(Memory {
            rank: NEXT_RANK.fetch_add(1, Ordering::Relaxed),
            name: None,
            layout,
            gate,
            mirrored: RwLock::default(),
            journal: OnceLock::new(),
            content: RwLock::new(Content {
                areas,
                access_flags: if gate.is_some() { SEALED } else { 0 },
                seal_changes: (0, 0),
                writes: 0,
                observers: Observers::default(),
            }),
        })
    }

    /// Names the memory in records of writes.
    #[must_use]
    pub fn named(self, name: &str) -> Memory {
        Memory { name: Some(name.into()), ..self }
    }

    pub const fn name(&self) -> Option<&Arc<str>> {
        self.name.as_ref()
    }

    /// Creates a memory of the same layout and gate, with all items 0.
    pub fn blank(&self) -> Memory {
        let blank = Memory::new(self.layout.clone(), self.gate);
        blank.expect("this memory has the layout and the gate")
    }

    pub fn span(&self, area: Area) -> Span {
        self.layout.span(area)
    }

    pub const fn layout(&self) -> &Layout {
        &self.layout
    }

    pub const fn gate(&self) -> Option<Gate> {
        self.gate
    }

    /// Sets the ranges that [`Access::Mirror`] writes, in place of those of an earlier call.
    ///
    /// # Errors
    /// [`LayoutError`] for a range outside its area. Nothing has changed then.
    pub fn mirror(&self, ranges: Vec<Mirrored>) -> Result<(), LayoutError> {
        for &Mirrored { area, address, count, .. } in &ranges {
            if count == 0 || !self.span(area).holds(address, count) {
                return Err(LayoutError::MirrorOutside { address });
            }
        }
        let ranges = MirroredRanges::new(ranges);
        let ages = ranges.can_be_stale();
        // Accesses take the two locks in the other order, so they are not held together here.
        *self.mirrored.write().unwrap_or_else(PoisonError::into_inner) = ranges;
        let mut content = self.exclusive();
        content.access_flags = content.access_flags & !AGING | if ages { AGING } else { 0 };
        Ok(())
    }

    fn mirrored(&self) -> RwLockReadGuard<'_, MirroredRanges> {
        self.mirrored.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes which mirrored ranges were written as a whole, with values of this age and lease.
    #[inline(never)]
    fn renew<'w>(
        &self,
        (age, lease): (Duration, Option<u64>),
        writes: impl IntoIterator<Item = &'w Write<'w>>,
    ) {
        let mirrored = self.mirrored();
        for write in writes {
            let touched = mirrored.touched(write.area, write.address, write.count);
            let written = touched.filter(|range| range.is_in(write));
            let freshness = written.filter_map(|range| range.freshness.as_deref());
            freshness.for_each(|freshness| freshness.renew(age, lease));
        }
    }

    /// Lets a journal carry out all writes from now on. Writes wait for it; [`Memory::submit`] does not.
    ///
    /// # Panics
    /// The memory has a journal already.
    pub fn keep_in(&self, journal: Arc<dyn Journal>, member: u16) {
        let guards = journal.guards();
        assert!(self.journal.set((journal, member)).is_ok(), "a memory has one journal");
        if guards {
            self.exclusive().access_flags |= GUARDED;
        }
    }

    /// Whether writes are carried out by a journal.
    #[inline]
    pub fn has_journal(&self) -> bool {
        self.journal.get().is_some()
    }

    /// Whether other nodes have the same contents: the journal carries out their writes too.
    pub fn is_replicated(&self) -> bool {
        self.journal.get().is_some_and(|(journal, _)| journal.guards())
    }

    /// Whether a write that was checked can still be refused: a journal carries it out, or its values can
    /// become stale.
    pub fn can_refuse_checked(&self, area: Area, address: u16, count: usize) -> bool {
        let ages = |range: &Mirrored| range.freshness.is_some();
        self.has_journal() || self.mirrored().touched(area, address, count).any(ages)
    }

    /// Copies the contents of several memories at one moment.
    pub fn contents(memories: &[Arc<Memory>]) -> Vec<Contents> {
        let mut ranked: Vec<(usize, &Arc<Memory>)> = memories.iter().enumerate().collect();
        ranked.sort_by_key(|(_, memory)| memory.rank);
        let locked: Vec<_> =
            ranked.iter().map(|(at, memory)| (*at, memory, memory.shared())).collect();
        let mut copies: Vec<(usize, Contents)> = locked
            .iter()
            .map(|(at, memory, content)| {
                let areas = if memory.layout.has_files() { FILES + 1 } else { FILES };
                let areas = content.areas[..areas].to_vec();
                (*at, Contents { areas, sealed: content.sealed() })
            })
            .collect();
        copies.sort_by_key(|(at, _)| *at);
        copies.into_iter().map(|(_, copy)| copy).collect()
    }

    /// How many writes were carried out: equal numbers mean equal contents.
    pub fn writes(&self) -> u64 {
        self.shared().writes
    }

    /// Copies some of the bytes of an area, by its index.
    ///
    /// # Panics
    /// There are no such bytes.
    pub fn bytes(&self, area: usize, range: Range<usize>) -> Vec<u8> {
        self.shared().areas[area][range].to_vec()
    }

    /// Puts other contents in place of the present ones. Observers don't see it.
    ///
    /// # Panics
    /// The length of an area differs, or the contents are sealed and the memory has no gate.
    pub fn restore(&self, contents: &Contents) {
        let mut content = self.exclusive();
        assert!(self.gate.is_some() || !contents.sealed, "a memory without a gate is never sealed");
        for (area, restored) in content.areas.iter_mut().zip(&contents.areas) {
            area.copy_from_slice(restored);
        }
        content.seal(contents.sealed);
        content.writes += 1;
    }

    pub fn sealed(&self) -> bool {
        self.shared().sealed()
    }

    /// How many times the seal opened, and how many times it closed again.
    pub fn seal_changes(&self) -> (u64, u64) {
        self.shared().seal_changes
    }

    /// Whether the memory has a seal that opens once, and it is open.
    pub fn is_open_once(&self) -> bool {
        self.gate.is_some_and(|gate| gate.mode == GateMode::Once) && !self.sealed()
    }

    /// Closes a seal that opens once, as a restart does: its gate bit becomes 0. Returns whether it was open.
    pub fn close_seal(&self) -> bool {
        let Some(Gate { area, address, mode: GateMode::Once }) = self.gate else { return false };
        let mut content = self.exclusive();
        if content.sealed() {
            return false;
        }
        let closed = Write { area, address, count: 1, bytes: &[0] };
        self.copy_in(&mut content, &closed);
        content.written(Access::Ingest, [&closed]);
        content.seal(true);
        content.seal_changes.1 += 1;
        true
    }

    /// Returns a queue of all writes from now on, or of those of clients. It is bounded, and ends
    /// with the memory.
    pub fn observe(&self, clients_only: bool) -> Arc<WriteQueue> {
        let queue = Arc::new(WriteQueue::default());
        self.exclusive().observers.add(Arc::clone(&queue), clients_only);
        queue
    }

    /// Carries out writes that have been checked, then updates the seal. Without an age, mirrored ranges
    /// stay as old as they were.
    fn apply<'w>(
        &self,
        Writer { access, age, lease }: Writer,
        content: &mut Content,
        writes: impl IntoIterator<Item = &'w Write<'w>> + Clone,
    ) {
        for write in writes.clone() {
            self.copy_in(content, write);
        }
        content.written(access, writes.clone());
        if access == Access::Mirror
            && content.access_flags & AGING != 0
            && let Some(age) = age
        {
            self.renew((age, lease), writes);
        }
        self.update_seal(access, content);
    }

    fn copy_in(&self, content: &mut Content, write: &Write<'_>) {
        let span = self.span(write.area);
        debug_assert!(span.holds(write.address, write.count), "{write:?} is outside {span:?}");
        let offset = self.layout.offset_inside(write.area, write.address);
        let area = &mut content.areas[write.area.index()];
        write.area.copy_in(area, offset, write.count, write.bytes);
    }

    /// Updates the seal from the gate bit. Called once, after all writes of an access.
    fn update_seal(&self, access: Access, content: &mut Content) {
        if access != Access::Client
            && let Some(gate) = self.gate
        {
            let offset = usize::from(gate.address - self.span(gate.area).start());
            let bit = bits::get(&content.areas[gate.area.index()], offset);
            let was_sealed = content.sealed();
            let is_sealed = gate.seals(was_sealed, bit);
            match (was_sealed, is_sealed) {
                (true, false) => content.seal_changes.0 += 1,
                (false, true) => content.seal_changes.1 += 1,
                _ => {}
            }
            content.seal(is_sealed);
        }
    }

    // Code under the lock cannot panic in the middle of a write, because ranges and lengths are
    // checked before. So the content behind a poisoned lock is consistent.
    fn shared(&self) -> RwLockReadGuard<'_, Content> {
        self.content.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn exclusive(&self) -> RwLockWriteGuard<'_, Content> {
        self.content.write().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Content {
    const fn sealed(&self) -> bool {
        self.access_flags & SEALED != 0
    }

    const fn seal(&mut self, sealed: bool) {
        self.access_flags = self.access_flags & !SEALED | if sealed { SEALED } else { 0 };
    }

    /// Counts a write that was carried out, and passes it to the observers.
    fn written<'w>(&mut self, access: Access, writes: impl IntoIterator<Item = &'w Write<'w>>) {
        self.writes += 1;
        if self.observers.is_any() {
            self.observers.notify(access, writes);
        }
    }

    #[inline(always)]
    fn copy_out(&self, offset: usize, read: &mut Read<'_>) {
        let area = &self.areas[read.area.index()];
        debug_assert!(read.area.byte_len(offset + read.count) <= area.len(), "{read:?}");
        debug_assert_eq!(read.out.len(), read.area.byte_len(read.count));
        read.area.copy_out(area, offset, read.count, read.out);
    }
}
