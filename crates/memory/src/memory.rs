//! The memory: reads and writes under one lock.

use std::ops::Range;
use std::ptr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use crate::area::{Area, FILES, Layout, Span};
use crate::batch::{self, Run};
use crate::bits;
use crate::error::{LayoutError, Refusal, Refused};
use crate::mirrored::{Mirrored, MirroredRanges};
use crate::operation::{Access, Read, Write};
use crate::seal::{self, Gate};
use crate::step::{Action, Done, Journal, Operation, Step, StepWrite, Tenure, wait};
use crate::write_queue::{Observers, WriteQueue};

/// Which ranges may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ranges {
    /// Those that are not reserved for [`Access::Mirror`] and not stale, unless that is the access.
    Unreserved,
    /// All: where a step was checked before.
    All,
}

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

    /// Checks whether a range may be written, as far as mirrored ranges are concerned.
    fn unreserved(
        &self,
        access: Access,
        area: Area,
        address: u16,
        count: usize,
        ranges: Ranges,
    ) -> Result<(), Refusal> {
        if ranges == Ranges::All || access == Access::Mirror {
            return Ok(());
        }
        let mirrored = self.mirrored();
        if mirrored.touched(area, address, count).any(|range| range.is_reserved) {
            Err(Refusal::Mirrored)
        } else if mirrored.touched(area, address, count).any(Mirrored::is_stale) {
            Err(Refusal::Stale)
        } else {
            Ok(())
        }
    }

    /// Checks whether a range may be read, as far as mirrored ranges are concerned.
    fn fresh(
        &self,
        content: &Content,
        access: Access,
        (area, address, count): (Area, u16, usize),
    ) -> Result<(), Refusal> {
        let ages = content.access_flags & AGING != 0 && access != Access::Mirror;
        if ages && self.mirrored().touched(area, address, count).any(Mirrored::is_stale) {
            return Err(Refusal::Stale);
        }
        Ok(())
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

    /// Whether the seal and the journal admit an access.
    #[inline]
    fn admit(&self, content: &Content, access: Access) -> Result<(), Refusal> {
        if content.is_open_to(access) { Ok(()) } else { self.judge(content, access) }
    }

    #[inline(never)]
    fn judge(&self, content: &Content, access: Access) -> Result<(), Refusal> {
        content.admit(access)?;
        match self.journal.get() {
            Some((journal, _)) if content.access_flags & GUARDED != 0 => journal.admit(),
            _ => Ok(()),
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

    /// Gives a write to the journal, without waiting for it.
    ///
    /// # Errors
    /// As [`Memory::write`], [`Memory::mask_write`] and [`Memory::write_then_read`], if that is known
    /// already. Then `done` is not called.
    ///
    /// # Panics
    /// The memory has no journal.
    pub fn submit(
        &self,
        access: Access,
        operation: Operation<'_>,
        done: Done,
    ) -> Result<(), Refusal> {
        self.submit_under(None, access, operation, done)
    }

    /// As [`Memory::submit`], for a write under a lease.
    ///
    /// # Errors
    /// As [`Memory::submit`].
    ///
    /// # Panics
    /// As [`Memory::submit`].
    pub fn submit_under(
        &self,
        tenure: Option<Tenure>,
        access: Access,
        operation: Operation<'_>,
        done: Done,
    ) -> Result<(), Refusal> {
        let content = self.shared();
        self.admit(&content, access)?;
        let Some((journal, member)) = self.journal.get() else { panic!("there is no journal") };
        let member = *member;
        let action = match operation {
            Operation::Write(writes) => {
                for write in writes {
                    self.writable(access, write, Ranges::Unreserved)?;
                }
                Action::Write(writes.iter().map(|write| StepWrite::new(member, write)).collect())
            }
            Operation::Mask { area, address, and_mask, or_mask } => {
                self.maskable(access, area, address, Ranges::Unreserved)?;
                Action::Mask { member, area, address, and_mask, or_mask }
            }
            Operation::WriteThenRead { write, area, address, count } => {
                self.writable(access, &write, Ranges::Unreserved)?;
                self.holds(area, address, count)?;
                self.fresh(&content, access, (area, address, count))?;
                Action::WriteThenRead {
                    write: StepWrite::new(member, &write),
                    area,
                    address,
                    count,
                }
            }
        };
        drop(content);
        journal.submit(Step { access, tenure, action }, done);
        Ok(())
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

    /// Reads one range.
    ///
    /// # Errors
    /// [`Refusal::Sealed`] (for a client), then `WrongLength`, `OutOfRange`, `Stale`. Then `out` is
    /// unchanged.
    pub fn read(&self, access: Access, mut read: Read<'_>) -> Result<(), Refusal> {
        let offset = self.readable(&read);
        let content = self.shared();
        if !content.is_open_to(access) {
            self.judge_read(&content, access, (read.area, read.address, read.count), offset)?;
        }
        content.copy_out(offset?, &mut read);
        Ok(())
    }

    #[inline(never)]
    fn judge_read(
        &self,
        content: &Content,
        access: Access,
        range: (Area, u16, usize),
        offset: Result<usize, Refusal>,
    ) -> Result<(), Refusal> {
        self.judge(content, access)?;
        offset?;
        self.fresh(content, access, range)
    }

    /// Reads several ranges atomically: no write happens between them.
    ///
    /// # Errors
    /// As [`Memory::read`], with the index of the first range that was refused.
    pub fn read_many(&self, access: Access, reads: &mut [Read<'_>]) -> Result<(), Refused> {
        let content = self.shared();
        self.admit(&content, access).map_err(|refusal| Refused { index: 0, refusal })?;
        for (index, read) in reads.iter().enumerate() {
            let fresh = || self.fresh(&content, access, (read.area, read.address, read.count));
            let readable = self.readable(read).and_then(|_| fresh());
            readable.map_err(|refusal| Refused { index, refusal })?;
        }
        for read in reads {
            content.copy_out(self.layout.offset_inside(read.area, read.address), read);
        }
        Ok(())
    }

    /// Returns how many writes were carried out, and reads ranges, unless that number is `seen`. The
    /// seal is ignored. The ranges must have been checked by `holds`.
    ///
    /// # Errors
    /// Those of [`Journal::admit`], then `Stale`.
    pub(crate) fn read_since(
        &self,
        seen: Option<u64>,
        reads: &mut [Read<'_>],
    ) -> Result<u64, Refusal> {
        let content = self.shared();
        self.admit(&content, Access::Ingest)?;
        for read in &*reads {
            self.fresh(&content, Access::Ingest, (read.area, read.address, read.count))?;
        }
        if seen != Some(content.writes) {
            for read in reads {
                content.copy_out(self.layout.offset_inside(read.area, read.address), read);
            }
        }
        Ok(content.writes)
    }

    /// Checks a range, without the lock.
    pub(crate) fn holds(&self, area: Area, address: u16, count: usize) -> Result<(), Refusal> {
        match self.layout.offset(area, address, count) {
            _ if count == 0 => Err(Refusal::WrongLength),
            Some(_) => Ok(()),
            None => Err(Refusal::OutOfRange),
        }
    }

    /// Returns a queue of all writes from now on, or of those of clients. It is bounded, and ends
    /// with the memory.
    pub fn observe(&self, clients_only: bool) -> Arc<WriteQueue> {
        let queue = Arc::new(WriteQueue::default());
        self.exclusive().observers.add(Arc::clone(&queue), clients_only);
        queue
    }

    /// Writes one range atomically.
    ///
    /// # Errors
    /// [`Refusal::Sealed`] (for a client) or [`Refusal::Unsealed`] (for [`Access::Restore`]), then
    /// `WrongLength`, `OutOfRange`, `GateBit`, `Mirrored`, `Stale`. Nothing has changed then.
    pub fn write(&self, access: Access, write: Write<'_>) -> Result<(), Refusal> {
        self.write_many(access, &[write]).map_err(|refused| refused.refusal)
    }

    /// Writes several ranges, of any areas, atomically. Where two overlap, the later one wins.
    ///
    /// # Errors
    /// As [`Memory::write`], with the index of the first write that was refused.
    pub fn write_many(&self, access: Access, writes: &[Write<'_>]) -> Result<(), Refused> {
        if self.has_journal() {
            return self.write_many_by_journal(access, writes);
        }
        let each = writes.iter().map(|write| (self, write));
        let valid = check_each(access, each, Ranges::Unreserved);
        let mut content = self.exclusive();
        content.admit(access).map_err(|refusal| Refused { index: 0, refusal })?;
        valid?;
        self.apply(Writer::now(access), &mut content, writes);
        Ok(())
    }

    #[cold]
    fn write_many_by_journal(&self, access: Access, writes: &[Write<'_>]) -> Result<(), Refused> {
        self.admit(&self.shared(), access).map_err(|refusal| Refused { index: 0, refusal })?;
        let writes: Vec<(&Memory, Write)> = writes.iter().map(|write| (self, *write)).collect();
        write_across(access, &writes).map(drop)
    }

    /// Replaces a register by `(now AND and_mask) OR (or_mask AND NOT and_mask)`, atomically.
    ///
    /// # Errors
    /// [`Refusal::Sealed`] (for a client), then `NotRegisters`, `OutOfRange`, `Mirrored`, `Stale`.
    pub fn mask_write(
        &self,
        access: Access,
        area: Area,
        address: u16,
        and_mask: u16,
        or_mask: u16,
    ) -> Result<(), Refusal> {
        if self.has_journal() {
            let operation = Operation::Mask { area, address, and_mask, or_mask };
            return self.wait(access, operation).map(drop);
        }
        self.mask(access, (area, address), (and_mask, or_mask), Ranges::Unreserved)
    }

    /// As [`Memory::mask_write`], without a journal.
    pub(crate) fn mask(
        &self,
        access: Access,
        (area, address): (Area, u16),
        (and_mask, or_mask): (u16, u16),
        ranges: Ranges,
    ) -> Result<(), Refusal> {
        let offset = self.maskable(access, area, address, ranges);
        let mut content = self.exclusive();
        content.admit(access)?;
        let offset = offset? * 2;
        let register = &mut content.areas[area.index()][offset..offset + 2];
        let now = u16::from_be_bytes([register[0], register[1]]);
        let bytes = ((now & and_mask) | (or_mask & !and_mask)).to_be_bytes();
        register.copy_from_slice(&bytes);
        content.written(access, &[Write { area, address, count: 1, bytes: &bytes }]);
        Ok(())
    }

    /// Writes one range, then reads one, atomically.
    ///
    /// # Errors
    /// As [`Memory::write`], then as [`Memory::read`]. When either is refused, nothing has changed.
    pub fn write_then_read(
        &self,
        access: Access,
        write: Write<'_>,
        read: Read<'_>,
    ) -> Result<(), Refusal> {
        if self.has_journal() {
            let Read { area, address, count, out } = read;
            let bytes =
                self.wait(access, Operation::WriteThenRead { write, area, address, count })?;
            let fits = out.len() == bytes.len();
            return fits.then(|| out.copy_from_slice(&bytes)).ok_or(Refusal::WrongLength);
        }
        self.change_then_read(Writer::now(access), write, read, Ranges::Unreserved)
    }

    /// As [`Memory::write_then_read`], without a journal.
    pub(crate) fn change_then_read(
        &self,
        writer: Writer,
        write: Write<'_>,
        mut read: Read<'_>,
        ranges: Ranges,
    ) -> Result<(), Refusal> {
        let access = writer.access;
        let valid = self.writable(access, &write, ranges);
        let offset = self.readable(&read);
        let mut content = self.exclusive();
        content.admit(access)?;
        valid?;
        let offset = offset?;
        if ranges == Ranges::Unreserved {
            self.fresh(&content, access, (read.area, read.address, read.count))?;
        }
        self.apply(writer, &mut content, [&write]);
        content.copy_out(offset, &mut read);
        Ok(())
    }

    /// Lets the journal carry out a write, and waits for it.
    #[cold]
    fn wait(&self, access: Access, operation: Operation<'_>) -> Result<Vec<u8>, Refusal> {
        let alone = |refusal| Refused { index: 0, refusal };
        let done = wait(|done| self.submit(access, operation, done).map_err(alone));
        done.map(|done| done.read).map_err(Refused::alone)
    }

    /// Checks a mask write, without the lock. Returns the offset of the register.
    fn maskable(
        &self,
        access: Access,
        area: Area,
        address: u16,
        ranges: Ranges,
    ) -> Result<usize, Refusal> {
        match self.layout.offset(area, address, 1) {
            _ if area.is_bits() => Err(Refusal::NotRegisters),
            offset => {
                let offset = offset.ok_or(Refusal::OutOfRange)?;
                self.unreserved(access, area, address, 1, ranges).map(|()| offset)
            }
        }
    }

    /// Checks a read, without the lock.
    fn readable(&self, read: &Read<'_>) -> Result<usize, Refusal> {
        if read.count == 0 || read.out.len() != read.area.byte_len(read.count) {
            return Err(Refusal::WrongLength);
        }
        self.layout.offset(read.area, read.address, read.count).ok_or(Refusal::OutOfRange)
    }

    /// Checks a write, without the lock.
    fn writable(&self, access: Access, write: &Write<'_>, ranges: Ranges) -> Result<(), Refusal> {
        let Write { area, address, count, bytes } = *write;
        if count == 0 || bytes.len() != area.byte_len(count) {
            return Err(Refusal::WrongLength);
        }
        self.layout.offset(area, address, count).ok_or(Refusal::OutOfRange)?;
        if let Some(gate) = self.gate {
            gate.admit_write(access, write)?;
        }
        self.unreserved(access, area, address, count, ranges)
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

    /// Whether an access needs no further judgement.
    const fn is_open_to(&self, access: Access) -> bool {
        self.access_flags == 0 && !matches!(access, Access::Restore)
    }

    /// Whether the seal admits an access. Called with the lock under which the write is carried out, so
    /// no write is judged by a seal that has changed since.
    fn admit(&self, access: Access) -> Result<(), Refusal> {
        seal::admit(access, self.sealed())
    }

    /// Counts a write that was carried out, and passes it to the observers.
    fn written<'w>(&mut self, access: Access, writes: impl IntoIterator<Item = &'w Write<'w>>) {
        self.writes += 1;
        if self.observers.is_any() {
            self.observers.notify(access, writes);
        }
    }

    fn copy_out(&self, offset: usize, read: &mut Read<'_>) {
        let area = &self.areas[read.area.index()];
        debug_assert!(read.area.byte_len(offset + read.count) <= area.len(), "{read:?}");
        debug_assert_eq!(read.out.len(), read.area.byte_len(read.count));
        read.area.copy_out(area, offset, read.count, read.out);
    }
}

/// Writes to several memories atomically: no reader sees some of the writes without the others, and
/// when one write is refused, none is carried out. Several writes can name the same memory. Returns the
/// sequence of the step, if a log has carried it out.
///
/// # Errors
/// `WrongLength`, `OutOfRange` or `GateBit`, with the index of the first write that fails one of
/// these checks. Then [`Refusal::NotOneStep`] where a memory has another journal than the first, and
/// [`Refusal::Sealed`] (for a client), with the index of the first write to a sealed memory, or
/// [`Refusal::Unsealed`] (for [`Access::Restore`]), with that of the first one to another memory. Nothing
/// has changed then. If the memories have a journal, see also [`Journal::submit`].
pub fn write_across(
    access: Access,
    writes: &[(&Memory, Write<'_>)],
) -> Result<Option<u64>, Refused> {
    if writes.iter().any(|(memory, _)| memory.has_journal()) {
        let submit = |done| {
            submit_across(access, writes, done);
            Ok(())
        };
        return wait(submit).map(|done| done.sequence);
    }
    check_across(access, writes)?;
    write_checked(Writer::now(access), writes).map(|()| None)
}

/// As [`write_across`], by the journal of the memories, without waiting for it. `done` gets all errors. It
/// is called from any thread, also before this returns.
#[cold]
pub fn submit_across(access: Access, writes: &[(&Memory, Write<'_>)], done: Done) {
    match step_across(access, writes) {
        Ok((journal, step)) => journal.submit(step, done),
        Err(refused) => done(Err(refused)),
    }
}

/// As [`write_across`], by a journal.
pub(crate) fn carry_out_across(
    writer: Writer,
    writes: &[(&Memory, Write<'_>)],
) -> Result<(), Refused> {
    check_each(writer.access, writes.iter().map(|(memory, write)| (*memory, write)), Ranges::All)?;
    write_checked(writer, writes)
}

/// The writes as one step, and the journal that carries it out.
fn step_across<'m>(
    access: Access,
    writes: &[(&'m Memory, Write<'_>)],
) -> Result<(&'m dyn Journal, Step), Refused> {
    check_across(access, writes)?;
    let Some((journal, _)) = writes.first().and_then(|(memory, _)| memory.journal.get()) else {
        return Err(Refused { index: 0, refusal: Refusal::NotOneStep });
    };
    let mut step = Vec::with_capacity(writes.len());
    for (index, (memory, write)) in writes.iter().enumerate() {
        let place = memory.journal.get().filter(|(other, _)| Arc::ptr_eq(other, journal));
        let refused = |refusal| Refused { index, refusal };
        let (_, member) = place.ok_or(refused(Refusal::NotOneStep))?;
        memory.admit(&memory.shared(), access).map_err(refused)?;
        step.push(StepWrite::new(*member, write));
    }
    Ok((&**journal, Step { access, tenure: None, action: Action::Write(step) }))
}

fn write_checked(writer: Writer, writes: &[(&Memory, Write<'_>)]) -> Result<(), Refused> {
    let mut placed: Vec<Placed> = writes
        .iter()
        .enumerate()
        .map(|(index, &(memory, write))| Placed { index, memory, write })
        .collect();
    // The sort is stable: writes to one area of one memory keep their order.
    placed.sort_by_key(|placed| (placed.memory.rank, placed.write.area));
    if !batch::is_large(placed.iter().map(|placed| &placed.write)) {
        return apply_across(writer, &placed);
    }
    let flat: Vec<(&Placed, Vec<Run>)> = placed
        .chunk_by(|a, b| ptr::eq(a.memory, b.memory) && a.write.area == b.write.area)
        .map(|writes| (&writes[0], batch::flatten(writes.iter().map(|placed| &placed.write))))
        .collect();
    let runs: Vec<Placed> = flat
        .iter()
        .flat_map(|(first, runs)| {
            runs.iter().map(|run| Placed { write: run.writing(first.write.area), ..**first })
        })
        .collect();
    apply_across(writer, &runs)
}

/// Checks what [`write_across`] checks before it takes the locks: everything but seals and journals.
///
/// # Errors
/// As [`write_across`], without [`Refusal::Sealed`], [`Refusal::Unsealed`] and [`Refusal::NotOneStep`].
pub fn check_across(access: Access, writes: &[(&Memory, Write<'_>)]) -> Result<(), Refused> {
    check_each(access, writes.iter().map(|(memory, write)| (*memory, write)), Ranges::Unreserved)
}

/// Checks writes, without the locks.
fn check_each<'w>(
    access: Access,
    writes: impl Iterator<Item = (&'w Memory, &'w Write<'w>)>,
    ranges: Ranges,
) -> Result<(), Refused> {
    writes.enumerate().try_for_each(|(index, (memory, write))| {
        let valid = memory.writable(access, write, ranges);
        valid.map_err(|refusal| Refused { index, refusal })
    })
}

/// A write that has been checked, with the memory it was checked for.
struct Placed<'a> {
    /// The index in the batch. A run has the index of its first write.
    index: usize,
    memory: &'a Memory,
    write: Write<'a>,
}

/// A locked memory and the writes to it.
struct Target<'p, 'a> {
    memory: &'a Memory,
    content: RwLockWriteGuard<'a, Content>,
    writes: &'p [Placed<'a>],
}

/// Carries out writes to several memories. The writes are sorted by the rank of their memory.
fn apply_across(writer: Writer, placed: &[Placed<'_>]) -> Result<(), Refused> {
    debug_assert!(
        placed.is_sorted_by_key(|placed| placed.memory.rank),
        "locks are taken in rank order"
    );
    let by_memory = placed.chunk_by(|a, b| ptr::eq(a.memory, b.memory));
    let mut targets: Vec<Target> = by_memory
        .map(|writes| {
            let memory = writes[0].memory;
            Target { memory, content: memory.exclusive(), writes }
        })
        .collect();
    debug_assert!(
        targets.is_sorted_by(|a, b| a.memory.rank < b.memory.rank),
        "each lock is taken once"
    );
    let refused = targets.iter().filter_map(|target| {
        let refusal = target.content.admit(writer.access).err()?;
        let indexes = target.writes.iter().map(|placed| placed.index);
        Some(Refused { index: indexes.fold(usize::MAX, usize::min), refusal })
    });
    if let Some(first) = refused.min_by_key(|refused| refused.index) {
        return Err(first);
    }
    for Target { memory, content, writes } in &mut targets {
        memory.apply(writer, content, writes.iter().map(|placed| &placed.write));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::follower::Follower;
    use crate::mirrored::Freshness;
    use crate::seal::GateMode;

    const REGISTERS: Area = Area::HoldingRegisters;

    fn writing(area: Area, address: u16, bytes: &[u8]) -> Write<'_> {
        Write { area, address, count: if area.is_bits() { 1 } else { bytes.len() / 2 }, bytes }
    }

    fn mirroring() -> Memory {
        let span = Span::new(0, 20).unwrap();
        let layout = Layout::default().with(REGISTERS, span).with(Area::Coils, span);
        let memory = Memory::new(layout, None).unwrap();
        memory.mirror(vec![Mirrored::reserved(REGISTERS, 5, 3)]).unwrap();
        memory
    }

    #[test]
    fn only_the_mirror_writes_mirrored_ranges() {
        let memory = mirroring();
        for access in [Access::Client, Access::Ingest] {
            for (address, len, refused) in
                [(4, 1, false), (4, 2, true), (5, 1, true), (7, 9, true), (8, 1, false)]
            {
                let bytes = [1; 20];
                let done = memory.write(access, writing(REGISTERS, address, &bytes[..2 * len]));
                assert_eq!(done == Err(Refusal::Mirrored), refused, "{address} {len}");
            }
            memory.write(access, writing(Area::Coils, 5, &[1])).unwrap();
            let masked = memory.mask_write(access, REGISTERS, 6, 0, 0);
            assert_eq!(masked, Err(Refusal::Mirrored));
            let (write, mut out) = (writing(REGISTERS, 7, &[9, 9]), [0; 2]);
            let read = Read { area: REGISTERS, address: 0, count: 1, out: &mut out };
            assert_eq!(memory.write_then_read(access, write, read), Err(Refusal::Mirrored));
            let both = [(&memory, writing(REGISTERS, 0, &[7, 7])), (&memory, write)];
            let refused = Refused { index: 1, refusal: Refusal::Mirrored };
            assert_eq!(write_across(access, &both), Err(refused));
        }
        let mut out = [0; 6];
        let read = Read { area: REGISTERS, address: 5, count: 3, out: &mut out };
        memory.read(Access::Client, read).unwrap();
        assert_eq!(out, [0; 6]);
        memory.write(Access::Mirror, writing(REGISTERS, 4, &[1; 8])).unwrap();
    }

    #[test]
    fn ranges_outside_the_area_are_refused_and_change_nothing() {
        let memory = mirroring();
        for (address, count) in [(18, 3), (0, 0)] {
            let range = Mirrored::reserved(REGISTERS, address, count);
            assert_eq!(memory.mirror(vec![range]), Err(LayoutError::MirrorOutside { address }));
        }
        let write = writing(REGISTERS, 5, &[1, 1]);
        assert_eq!(memory.write(Access::Ingest, write), Err(Refusal::Mirrored));
        memory.mirror(Vec::new()).unwrap();
        memory.write(Access::Ingest, write).unwrap();
    }

    /// Is stale when a test says so, and fresh after a write.
    #[derive(Debug, Default)]
    struct Aged(std::sync::atomic::AtomicBool);

    impl Freshness for Aged {
        fn renew(&self, age: Duration, _: Option<u64>) {
            self.0.store(age > Duration::ZERO, Ordering::Relaxed);
        }

        fn is_stale(&self) -> bool {
            self.0.load(Ordering::Relaxed)
        }
    }

    /// A memory whose holding registers 5 to 7 are stale.
    fn aging(is_reserved: bool) -> (Memory, Arc<Aged>) {
        let memory = mirroring();
        let aged = Arc::new(Aged(true.into()));
        let freshness = Some(Arc::clone(&aged) as Arc<dyn Freshness>);
        let range = Mirrored { is_reserved, freshness, ..Mirrored::reserved(REGISTERS, 5, 3) };
        memory.mirror(vec![range]).unwrap();
        (memory, aged)
    }

    /// What each kind of access to registers is answered with.
    fn accesses(
        memory: &Arc<Memory>,
        access: Access,
        address: u16,
        count: usize,
    ) -> [Result<(), Refusal>; 6] {
        let bytes = [1; 40];
        let write = writing(REGISTERS, address, &bytes[..2 * count]);
        let mut out = [[0; 40]; 3];
        let [one, many, then] = out.each_mut().map(|out| Read {
            area: REGISTERS,
            address,
            count,
            out: &mut out[..2 * count],
        });
        let beside = writing(REGISTERS, 19, &[1, 1]);
        [
            memory.read(access, one),
            memory.read_many(access, &mut [many]).map_err(Refused::alone),
            memory.write_then_read(access, beside, then),
            memory.write(access, write),
            memory.mask_write(access, REGISTERS, address, 1, 1),
            write_across(access, &[(&**memory, write)]).map(drop).map_err(Refused::alone),
        ]
    }

    #[test]
    fn while_a_range_is_stale_only_the_mirror_uses_it() {
        for access in [Access::Client, Access::Ingest] {
            let memory = Arc::new(aging(false).0);
            for (address, count) in [(5, 1), (7, 9), (5, 3)] {
                assert_eq!(accesses(&memory, access, address, count), [Err(Refusal::Stale); 6]);
            }
            assert_eq!(accesses(&memory, access, 0, 5), [Ok(()); 6]);
            assert_eq!(accesses(&memory, access, 8, 4), [Ok(()); 6]);
            let own = Read { area: REGISTERS, address: 5, count: 3, out: &mut [0; 6] };
            assert_eq!(memory.read(Access::Mirror, own), Ok(()));
            let outside = Read { area: REGISTERS, address: 7, count: 20, out: &mut [0; 40] };
            assert_eq!(memory.read(access, outside), Err(Refusal::OutOfRange));
            memory.write(Access::Mirror, writing(REGISTERS, 6, &[1; 4])).unwrap();
            assert_eq!(
                accesses(&memory, access, 6, 2)[0],
                Err(Refusal::Stale),
                "a part is written"
            );
            memory.write(Access::Mirror, writing(REGISTERS, 4, &[1; 8])).unwrap();
            assert_eq!(accesses(&memory, access, 5, 3), [Ok(()); 6]);
        }
    }

    #[test]
    fn a_reserved_range_is_never_written_and_not_read_while_it_is_stale() {
        let (memory, aged) = aging(true);
        let memory = Arc::new(memory);
        let (stale, mirrored) = (Err(Refusal::Stale), Err(Refusal::Mirrored));
        let refused = [stale, stale, stale, mirrored, mirrored, mirrored];
        assert_eq!(accesses(&memory, Access::Client, 5, 3), refused);
        aged.renew(Duration::ZERO, None);
        let refused = [Ok(()), Ok(()), Ok(()), mirrored, mirrored, mirrored];
        assert_eq!(accesses(&memory, Access::Client, 5, 3), refused);
    }

    #[test]
    fn a_checked_write_can_be_refused_where_values_become_stale() {
        let (memory, _) = aging(true);
        for (address, count, can_refuse) in
            [(0, 5, false), (5, 1, true), (2, 9, true), (8, 3, false)]
        {
            assert_eq!(
                memory.can_refuse_checked(REGISTERS, address, count),
                can_refuse,
                "{address} {count}"
            );
            assert!(!memory.can_refuse_checked(Area::Coils, address, count));
        }
        assert!(!mirroring().can_refuse_checked(REGISTERS, 5, 3), "it is refused at once");
    }

    #[test]
    fn a_follower_of_a_stale_range_sees_all_of_it_when_it_is_fresh_again() {
        let (memory, aged) = aging(true);
        let memory = Arc::new(memory);
        let mut follower = Follower::new(Arc::clone(&memory), [(REGISTERS, 7, 2)]).unwrap();
        assert_eq!(follower.changes(), Err(Refusal::Stale));
        aged.renew(Duration::ZERO, None);
        let all = follower.changes().unwrap();
        assert!(follower.changes().unwrap().1.is_empty());
        aged.0.store(true, Ordering::Relaxed);
        assert_eq!(follower.changes(), Err(Refusal::Stale), "nothing was written since");
        aged.renew(Duration::ZERO, None);
        assert_eq!(follower.changes(), Ok(all));
    }

    #[test]
    fn a_stale_range_is_refused_before_the_journal_has_a_step_and_not_when_it_is_carried_out() {
        let (memory, _) = aging(false);
        let memory = Arc::new(memory);
        let members = Arc::downgrade(&memory);
        let guard = Guard { guards: false, refusal: std::sync::Mutex::default(), members };
        memory.keep_in(Arc::new(guard) as Arc<dyn Journal>, 0);
        assert_eq!(accesses(&memory, Access::Client, 5, 3), [Err(Refusal::Stale); 6]);
        let write = StepWrite::new(0, &writing(REGISTERS, 6, &[3, 4]));
        let action = Action::WriteThenRead { write, area: REGISTERS, address: 6, count: 1 };
        let step = Step { access: Access::Client, tenure: None, action };
        // Another node may know newer values.
        assert_eq!(step.carry_out(&[Arc::clone(&memory)]).unwrap().read, [3, 4]);
        memory.write(Access::Mirror, writing(REGISTERS, 5, &[1; 6])).unwrap();
        assert_eq!(accesses(&memory, Access::Client, 5, 3), [Ok(()); 6]);
    }

    #[test]
    fn a_step_makes_a_range_as_old_as_its_values_are() {
        let stale = || {
            let (memory, aged) = aging(false);
            (Arc::new(memory), aged)
        };
        let write = StepWrite::new(0, &writing(REGISTERS, 5, &[1; 6]));
        let then = write.clone();
        let then = Action::WriteThenRead { write: then, area: REGISTERS, address: 5, count: 1 };
        for action in [Action::Write(vec![write]), then] {
            let step = Step { access: Access::Mirror, tenure: None, action };
            let ages = [Some(Duration::ZERO), Some(Duration::from_secs(1)), None];
            let found = ages.map(|age| {
                let (memory, aged) = stale();
                step.carry_out_late(&[memory], age).unwrap();
                aged.is_stale()
            });
            assert_eq!(found, [false, true, true]);
            let (memory, aged) = aging(false);
            aged.renew(Duration::ZERO, None);
            step.carry_out_late(&[Arc::new(memory)], None).unwrap();
            assert!(!aged.is_stale(), "newer values are not older");
        }
    }

    /// Carries out each step at once, and refuses accesses while it has a refusal.
    #[derive(Debug)]
    struct Guard {
        guards: bool,
        refusal: std::sync::Mutex<Option<Refusal>>,
        members: std::sync::Weak<Memory>,
    }

    impl Journal for Guard {
        fn submit(&self, step: Step, done: Done) {
            done(step.carry_out(&[self.members.upgrade().unwrap()]));
        }

        fn guards(&self) -> bool {
            self.guards
        }

        fn admit(&self) -> Result<(), Refusal> {
            self.refusal.lock().unwrap().map_or(Ok(()), Err)
        }
    }

    #[test]
    fn a_journal_that_guards_is_asked_before_each_access_but_not_by_its_own_steps() {
        for guards in [true, false] {
            let memory = Arc::new(mirroring());
            memory.mirror(Vec::new()).unwrap();
            let (refusal, members) = (std::sync::Mutex::default(), Arc::downgrade(&memory));
            let guard = Arc::new(Guard { guards, refusal, members });
            assert!(!memory.is_replicated());
            memory.keep_in(Arc::clone(&guard) as Arc<dyn Journal>, 0);
            assert_eq!(memory.is_replicated(), guards);
            let write = writing(REGISTERS, 0, &[1, 2]);
            memory.write(Access::Client, write).unwrap();
            let mut follower = Follower::new(Arc::clone(&memory), [(REGISTERS, 0, 2)]).unwrap();
            let all = follower.changes().unwrap();
            *guard.refusal.lock().unwrap() = Some(Refusal::Behind);
            let expected = if guards { Err(Refusal::Behind) } else { Ok(()) };
            assert_eq!(follower.changes().map(drop), expected);
            for access in [Access::Client, Access::Ingest, Access::Mirror] {
                let mut out = [[0; 2]; 3];
                let [one, many, then] =
                    out.each_mut().map(|out| Read { area: REGISTERS, address: 0, count: 1, out });
                assert_eq!(memory.read(access, one), expected);
                let many = memory.read_many(access, &mut [many]).map_err(Refused::alone);
                assert_eq!(many, expected);
                assert_eq!(memory.write_then_read(access, write, then), expected);
                assert_eq!(memory.write(access, write), expected);
                assert_eq!(memory.mask_write(access, REGISTERS, 0, 1, 1), expected);
                let across = write_across(access, &[(&memory, write)]);
                let across = across.map(drop).map_err(Refused::alone);
                assert_eq!(across, expected);
            }
            let step = StepWrite::new(0, &writing(REGISTERS, 0, &[3, 4]));
            let action = Action::Write(vec![step]);
            let step = Step { access: Access::Client, tenure: None, action };
            if guards {
                *guard.refusal.lock().unwrap() = None;
                assert_eq!(follower.changes(), Ok(all), "after a refusal, all is new");
            }
            step.carry_out(&[Arc::clone(&memory)]).unwrap();
            *guard.refusal.lock().unwrap() = None;
            let mut out = [0; 2];
            let read = Read { area: REGISTERS, address: 0, count: 1, out: &mut out };
            memory.read(Access::Client, read).unwrap();
            assert_eq!(out, [3, 4]);
        }
    }

    #[test]
    fn a_journal_that_does_not_guard_is_not_asked_for_a_sealed_memory_either() {
        let layout = Layout::default().with(Area::Coils, Span::new(0, 20).unwrap());
        let gate = Gate { area: Area::Coils, address: 3, mode: GateMode::Level };
        let memory = Arc::new(Memory::new(layout, Some(gate)).unwrap());
        let refusal = std::sync::Mutex::new(Some(Refusal::Behind));
        let guard = Guard { guards: false, refusal, members: Arc::downgrade(&memory) };
        memory.keep_in(Arc::new(guard) as Arc<dyn Journal>, 0);
        let mut out = [0];
        let read = Read { area: Area::Coils, address: 0, count: 1, out: &mut out };
        assert_eq!(memory.read(Access::Ingest, read), Ok(()));
        assert_eq!(memory.write(Access::Restore, writing(Area::Coils, 4, &[1])), Ok(()));
    }

    #[test]
    fn the_seal_of_a_guarded_memory_still_opens_and_closes() {
        let span = Span::new(0, 20).unwrap();
        let layout = Layout::default().with(Area::Coils, span);
        let gate = Gate { area: Area::Coils, address: 3, mode: GateMode::Level };
        let memory = Arc::new(Memory::new(layout, Some(gate)).unwrap());
        let (refusal, members) = (std::sync::Mutex::default(), Arc::downgrade(&memory));
        let guard = Arc::new(Guard { guards: true, refusal, members });
        memory.keep_in(Arc::clone(&guard) as Arc<dyn Journal>, 0);
        let read = || {
            let mut out = [0];
            let read = Read { area: Area::Coils, address: 0, count: 1, out: &mut out };
            memory.read(Access::Client, read)
        };
        assert_eq!(read(), Err(Refusal::Sealed));
        memory.write(Access::Ingest, writing(Area::Coils, 3, &[1])).unwrap();
        assert_eq!((read(), memory.sealed()), (Ok(()), false));
        *guard.refusal.lock().unwrap() = Some(Refusal::Differs);
        assert_eq!(read(), Err(Refusal::Differs));
        *guard.refusal.lock().unwrap() = None;
        memory.write(Access::Ingest, writing(Area::Coils, 3, &[0])).unwrap();
        assert_eq!((read(), memory.sealed()), (Err(Refusal::Sealed), true));
    }
}
