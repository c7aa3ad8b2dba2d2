//! What is checked before an access, and in which order. Clients see the first refusal.
//!
//! 1. the seal ([`seal::admit`]), under the lock of the access
//! 2. the journal, if it guards its memories
//! 3. form and range of each read and write: known without the lock, as the layout never changes
//! 4. the gate bit, for writes
//! 5. ranges that mirror a device: reserved, then stale
//!
//! A write to several memories alone is checked for 3 to 5 first, because it takes the locks of all of
//! them only for a write that is valid.

use crate::area::Area;
use crate::error::{Refusal, Refused};
use crate::memory::{AGING, Content, GUARDED, Memory};
use crate::mirrored::Mirrored;
use crate::operation::{Access, Read, Write};
use crate::seal;

/// Which ranges may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ranges {
    /// Those that are not reserved for [`Access::Mirror`] and not stale, unless that is the access.
    Unreserved,
    /// All: where a step was checked before.
    All,
}

impl Memory {
    /// Refuses an access that the seal or the journal does not admit.
    #[inline]
    pub(super) fn admit(&self, content: &Content, access: Access) -> Result<(), Refusal> {
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

    #[inline(never)]
    pub(super) fn judge_read(
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

    /// Checks a read, without the lock.
    #[inline(always)]
    pub(super) fn readable(&self, read: &Read<'_>) -> Result<usize, Refusal> {
        if read.count == 0 || read.out.len() != read.area.byte_len(read.count) {
            return Err(Refusal::WrongLength);
        }
        self.layout.offset(read.area, read.address, read.count).ok_or(Refusal::OutOfRange)
    }

    /// Checks a write, without the lock.
    pub(super) fn writable(
        &self,
        access: Access,
        write: &Write<'_>,
        ranges: Ranges,
    ) -> Result<(), Refusal> {
        let Write { area, address, count, bytes } = *write;
        if count == 0 || bytes.len() != area.byte_len(count) {
            return Err(Refusal::WrongLength);
        }
        self.layout.offset(area, address, count).ok_or(Refusal::OutOfRange)?;
        self.admit_at_gate(access, (area, address, count))?;
        self.unreserved(access, area, address, count, ranges)
    }

    /// Checks what of a write does not depend on who carries it out, for one that a device carries out in
    /// place of the memory.
    ///
    /// # Errors
    /// [`Refusal::Sealed`] or [`Refusal::Unsealed`], then [`Refusal::GateBit`].
    pub fn check_passed(&self, access: Access, range: (Area, u16, usize)) -> Result<(), Refusal> {
        self.shared().admit(access)?;
        self.admit_at_gate(access, range)
    }

    /// Checks whether a range may be written, as far as the gate bit is concerned.
    #[inline]
    fn admit_at_gate(&self, access: Access, range: (Area, u16, usize)) -> Result<(), Refusal> {
        self.gate.map_or(Ok(()), |gate| gate.admit_write(access, range))
    }

    /// Checks a mask write, without the lock. Returns the offset of the register.
    pub(super) fn maskable(
        &self,
        access: Access,
        area: Area,
        address: u16,
        ranges: Ranges,
    ) -> Result<usize, Refusal> {
        if area.is_bits() {
            return Err(Refusal::NotRegisters);
        }
        let offset = self.layout.offset(area, address, 1).ok_or(Refusal::OutOfRange)?;
        self.unreserved(access, area, address, 1, ranges).map(|()| offset)
    }

    /// Checks a range, without the lock.
    pub(crate) fn holds(&self, area: Area, address: u16, count: usize) -> Result<(), Refusal> {
        if count == 0 {
            return Err(Refusal::WrongLength);
        }
        self.layout.offset(area, address, count).map(drop).ok_or(Refusal::OutOfRange)
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
        } else if mirrored.touched(area, address, count).any(Mirrored::must_refuse) {
            Err(Refusal::Stale)
        } else {
            Ok(())
        }
    }

    /// Checks whether a range may be read, as far as mirrored ranges are concerned.
    pub(super) fn fresh(
        &self,
        content: &Content,
        access: Access,
        (area, address, count): (Area, u16, usize),
    ) -> Result<(), Refusal> {
        let ages = content.access_flags & AGING != 0 && access != Access::Mirror;
        if ages && self.mirrored().touched(area, address, count).any(Mirrored::must_refuse) {
            return Err(Refusal::Stale);
        }
        Ok(())
    }
}

impl Content {
    /// Whether an access needs no further judgement.
    pub(super) const fn is_open_to(&self, access: Access) -> bool {
        self.access_flags == 0 && !matches!(access, Access::Restore)
    }

    /// Refuses an access that the seal does not admit. Called with the lock under which the write is carried out, so
    /// no write is judged by a seal that has changed since.
    pub(super) fn admit(&self, access: Access) -> Result<(), Refusal> {
        seal::admit(access, self.sealed())
    }
}

/// Checks what [`write_across`](crate::write_across) checks before it takes the locks: everything but
/// seals and journals.
///
/// # Errors
/// As [`write_across`](crate::write_across), without [`Refusal::Sealed`], [`Refusal::Unsealed`] and
/// [`Refusal::NotOneStep`].
pub fn check_across(access: Access, writes: &[(&Memory, Write<'_>)]) -> Result<(), Refused> {
    check_each(access, writes.iter().map(|(memory, write)| (*memory, write)), Ranges::Unreserved)
}

/// Checks writes, without the locks.
pub(super) fn check_each<'w>(
    access: Access,
    writes: impl Iterator<Item = (&'w Memory, &'w Write<'w>)>,
    ranges: Ranges,
) -> Result<(), Refused> {
    writes.enumerate().try_for_each(|(index, (memory, write))| {
        let valid = memory.writable(access, write, ranges);
        valid.map_err(|refusal| Refused { index, refusal })
    })
}
