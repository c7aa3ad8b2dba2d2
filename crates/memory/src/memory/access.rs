//! Reads and writes of a memory, each in one step: under its lock, or by its journal.

use crate::area::Area;
use crate::error::{Refusal, Refused};
use crate::memory::checks::{Ranges, check_each};
use crate::memory::several_memories::write_across;
use crate::memory::{Memory, Writer};
use crate::operation::{Access, Read, Write};
use crate::step::{Action, Done, Operation, Step, StepWrite, Tenure, wait};

impl Memory {
    /// Reads one range.
    ///
    /// # Errors
    /// [`Refusal::Sealed`] (for a client), then `WrongLength`, `OutOfRange`, `Stale`. Then `out` is
    /// unchanged.
    // Inlined with what it calls: the callers that matter know the area.
    #[inline(always)]
    pub fn read(&self, access: Access, mut read: Read<'_>) -> Result<(), Refusal> {
        let offset = self.readable(&read);
        let content = self.shared();
        if !content.is_open_to(access) {
            self.judge_read(&content, access, (read.area, read.address, read.count), offset)?;
        }
        content.copy_out(offset?, &mut read);
        Ok(())
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
    /// Those of [`Journal::admit`](crate::Journal::admit), then `Stale`.
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
}
